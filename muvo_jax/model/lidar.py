"""Lidar encoders: points -> map of features.

RV (paper Table I) reads the range view as a four-channel image, PP the points themselves as pillars on the ground. Both
end in fusion.token_channels or fusion.map_channels.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax.config import ModelConfig
from muvo_jax.geometry import PillarGrid
from muvo_jax.model import common
from muvo_jax.nn import layers, norm, resnet
from muvo_jax.ops import pillars


class RangeViewEncoder(linen.Module):
    """RV: [N, Hr/32, Wr/32, C]; for the 2D latent /16; /8 for fusions without tokens and with many of them (2D: /4)."""

    config: ModelConfig

    @staticmethod
    def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
        """Name of a Batch field -> its shape for one frame."""
        return {"range_view": (config.range_view.rows, config.range_view.columns, 4)}

    @linen.compact
    def __call__(self, frames: Mapping[str, jax.Array], mode: norm.Mode) -> jax.Array:
        compute = common.compute(self.config)
        scaled = (frames["range_view"] / self.config.range_scale_m).astype(compute.dtype)
        levels = (1, 2, 3) if isinstance(self.config.latent, config_lib.TokenLatent) else (2, 3, 4)
        maps = common.backbone(self.config, levels, name="backbone")(scaled, mode)
        return common.neck(self.config, name="neck")(maps, mode)


class PillarNet(linen.Module):
    """Points [N, P, 3] -> [N, cells, cells, channels]: two dense layers for each point, their maximum in each pillar.

    BatchNorm's moments are those of the points inside the grid. Differs from the reference where that measures a point
    from the cell's corner, with x and y mixed up (numerics="reference").
    """

    config: ModelConfig
    grid: PillarGrid

    @linen.compact
    def __call__(self, points_m: jax.Array, count: jax.Array, mode: norm.Mode) -> jax.Array:
        grid, compute = self.grid, common.compute(self.config)
        index, cell = pillars.pillar_indices(points_m, count, grid)
        x = pillars.decorate(points_m, index, cell, grid, swapped_corners=self.config.numerics == "reference")
        inside = index < points_m.shape[0] * grid.cells**2
        for layer in range(2):
            x = layers.Dense(grid.channels, compute, name=f"linear{layer}")(x)
            x = jax.nn.relu(norm.BatchNorm(name=f"norm{layer}")(x, mode, inside))
        return pillars.canvas(x, index, grid)


class PillarEncoder(linen.Module):
    """PP: [N, cells/32, cells/32, C]; /8 for fusions without tokens and with many of them.

    Rows grow backward, columns to the left.
    """

    config: ModelConfig

    @staticmethod
    def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
        """Name of a Batch field -> its shape for one frame."""
        return {"points": (config_lib.as_kind(config.lidar, config_lib.PillarLidar).grid.points, 3), "point_count": ()}

    @linen.compact
    def __call__(self, frames: Mapping[str, jax.Array], mode: norm.Mode) -> jax.Array:
        points_m = jnp.asarray(frames["points"], jnp.float32)
        grid = config_lib.as_kind(self.config.lidar, config_lib.PillarLidar).grid
        canvas = PillarNet(self.config, grid, name="pillars")(points_m, frames["point_count"], mode)
        maps = resnet.ResNet18(self.config.backbone_width, (2, 3, 4), common.compute(self.config),
                               name="pillar_backbone")(canvas, mode)
        return common.neck(self.config, name="pillar_neck")(maps, mode)


REGISTRY: dict[type, type[RangeViewEncoder] | type[PillarEncoder]] = {
    config_lib.RangeViewLidar: RangeViewEncoder, config_lib.PillarLidar: PillarEncoder}
