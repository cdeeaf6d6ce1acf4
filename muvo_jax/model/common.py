"""What several parts of the model derive from its configuration."""

from __future__ import annotations

from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.nn import layers, mobilevit, pyramid, resnet

_BACKBONES: dict[str, type[resnet.ResNet18] | type[mobilevit.MobileVit]] = {
    "resnet18": resnet.ResNet18, "mobilevitv2_100": mobilevit.MobileVit}


def compute(config: ModelConfig) -> layers.Compute:
    """How the parts of this model do their matrix work."""
    return layers.Compute(config.compute_dtype, config.convolution)


def measurement_channels(config: ModelConfig) -> int:
    """Channels of an encoded measurement: a token's where it becomes one."""
    return config.token_channels if config.latent == "2d" else config.measurement_channels


def map_channels(config: ModelConfig) -> int:
    """Channels of the sensors' maps as fusion takes them."""
    return config.token_channels if config.fusion == "tr" else config.map_channels


def backbone(config: ModelConfig, levels: tuple[int, ...], name: str) -> linen.Module:
    """The feature pyramid of an image or a range view."""
    return _BACKBONES[config.backbone](config.backbone_width, levels, compute(config), name=name)


def neck(config: ModelConfig, name: str) -> linen.Module:
    """Brings a pyramid's maps together: at the coarsest size, at the finest where fusion has no tokens or many."""
    coarse = config.fusion == "tr" and not config.many_tokens
    kind = pyramid.DownsamplingPyramid if coarse else pyramid.UpsamplingPyramid
    return kind(map_channels(config), compute(config), name=name)
