"""Camera encoders: image -> map of tokens. WOB (without bird's eye view, paper Table I) keeps the image plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common
from muvo_jax.nn import norm, pyramid, resnet

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalise_image(image: jax.Array) -> jax.Array:
    """uint8 [..., 3] -> float32 [..., 3], ImageNet statistics."""
    mean = jnp.asarray(IMAGENET_MEAN, jnp.float32).reshape((1,) * (image.ndim - 1) + (3,))
    std = jnp.asarray(IMAGENET_STD, jnp.float32).reshape((1,) * (image.ndim - 1) + (3,))
    return (image.astype(jnp.float32) / 255.0 - mean) / std


class PlaneCamera(linen.Module):
    """WOB: image uint8 [N, H, W, 3] -> [N, H/32, W/32, token_channels]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, image: jax.Array, mode: norm.Mode) -> jax.Array:
        compute = common.compute(self.config)
        maps = resnet.ResNet18(self.config.backbone_width, (2, 3, 4), compute, name="backbone")(
            normalise_image(image).astype(compute.dtype), mode)
        return pyramid.DownsamplingPyramid(self.config.token_channels, compute, name="neck")(maps, mode)


REGISTRY = {"wob": PlaneCamera}
