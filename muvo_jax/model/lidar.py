"""Lidar encoders: points -> map of tokens. RV (paper Table I) reads the range view as a four-channel image."""

from __future__ import annotations

import jax
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common
from muvo_jax.nn import norm, pyramid, resnet


class RangeViewLidar(linen.Module):
    """Range view float32 [N, Hr, Wr, 4] in metres -> [N, Hr/32, Wr/32, token_channels]; for the 2D latent /16."""

    config: ModelConfig

    @linen.compact
    def __call__(self, range_view: jax.Array, mode: norm.Mode) -> jax.Array:
        compute = common.compute(self.config)
        scaled = (range_view / self.config.range_scale_m).astype(compute.dtype)
        levels = (1, 2, 3) if self.config.latent == "2d" else (2, 3, 4)
        maps = resnet.ResNet18(self.config.backbone_width, levels, compute, name="backbone")(scaled, mode)
        return pyramid.DownsamplingPyramid(self.config.token_channels, compute, name="neck")(maps, mode)


REGISTRY = {"rv": RangeViewLidar}
