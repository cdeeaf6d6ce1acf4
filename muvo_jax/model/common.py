"""What several parts of the model derive from its configuration."""

from __future__ import annotations

from muvo_jax.config import ModelConfig
from muvo_jax.nn import layers


def compute(config: ModelConfig) -> layers.Compute:
    """How the parts of this model do their matrix work."""
    return layers.Compute(config.compute_dtype, config.convolution)


def feature_channels(config: ModelConfig) -> int:
    """Size of what decoders read: deterministic and stochastic state side by side."""
    return config.deterministic_channels + config.stochastic_channels
