"""What several parts of the model derive from its configuration."""

from __future__ import annotations

from flax import linen

from muvo_jax.config import ModelConfig, TokenLatent, TransformerFusion, as_kind
from muvo_jax.nn import layers, mobilevit, pyramid, resnet

_BACKBONES: dict[str, type[resnet.ResNet18] | type[mobilevit.MobileVit]] = {
    "resnet18": resnet.ResNet18, "mobilevitv2_100": mobilevit.MobileVit}


def compute(config: ModelConfig) -> layers.Compute:
    """How the parts of this model do their matrix work."""
    return layers.Compute(config.compute_dtype, config.convolution)


def measurement_channels(config: ModelConfig) -> int:
    """Channels of an encoded measurement: a token's where it becomes one."""
    if isinstance(config.latent, TokenLatent):
        return token_fusion(config).token_channels
    return config.measurement_channels


def map_channels(config: ModelConfig) -> int:
    """Channels of the sensors' maps as fusion takes them."""
    fusion = config.fusion
    return fusion.token_channels if isinstance(fusion, TransformerFusion) else fusion.map_channels


def token_fusion(config: ModelConfig) -> TransformerFusion:
    """The fusion of a model that has tokens: every model with the 2D latent, and some others."""
    return as_kind(config.fusion, TransformerFusion)


def fine_maps(config: ModelConfig) -> bool:
    """Whether fusion takes the sensors' finest maps: where it has no tokens, or many of them."""
    return not isinstance(config.fusion, TransformerFusion) or config.fusion.many_tokens


def backbone(config: ModelConfig, levels: tuple[int, ...], name: str) -> linen.Module:
    """The feature pyramid of an image or a range view."""
    return _BACKBONES[config.backbone](config.backbone_width, levels, compute(config), name=name)


def neck(config: ModelConfig, name: str) -> linen.Module:
    """Brings a pyramid's maps together: at the coarsest size, at the finest where fusion has no tokens or many."""
    kind = pyramid.UpsamplingPyramid if fine_maps(config) else pyramid.DownsamplingPyramid
    return kind(map_channels(config), compute(config), name=name)
