"""What several parts of the model derive from its configuration."""

from __future__ import annotations

from muvo_jax.config import ModelConfig
from muvo_jax.nn import layers


def compute(config: ModelConfig) -> layers.Compute:
    """How the parts of this model do their matrix work."""
    return layers.Compute(config.compute_dtype, config.convolution)


def measurement_channels(config: ModelConfig) -> int:
    """Channels of an encoded measurement: a token's where it becomes one."""
    return config.token_channels if config.latent == "2d" else config.measurement_channels
