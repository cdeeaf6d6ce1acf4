"""Camera encoders: image -> map of features.

WOB (without bird's-eye view, paper Table I) keeps the image plane, BEV lifts it to the ground ahead. Both end in
fusion.token_channels or fusion.map_channels.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax.config import ModelConfig
from muvo_jax.model import common
from muvo_jax.nn import layers, norm, pyramid
from muvo_jax.ops import frustum

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
LEVELS = (2, 3, 4)
_FINEST_STRIDE = 8  # of level 2


def normalise_image(image: jax.Array) -> jax.Array:
    """uint8 [..., 3] -> float32 [..., 3], ImageNet statistics."""
    mean = jnp.asarray(IMAGENET_MEAN, jnp.float32).reshape((1,) * (image.ndim - 1) + (3,))
    std = jnp.asarray(IMAGENET_STD, jnp.float32).reshape((1,) * (image.ndim - 1) + (3,))
    return (image.astype(jnp.float32) / 255.0 - mean) / std


class PlaneEncoder(linen.Module):
    """WOB: [N, H/32, W/32, C], or /8 for fusions without tokens and with many of them."""

    config: ModelConfig

    @staticmethod
    def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
        """Name of a Batch field -> its shape for one frame."""
        return {"image": (*config.image_size, 3)}

    @linen.compact
    def __call__(self, frames: Mapping[str, jax.Array], mode: norm.Mode) -> jax.Array:
        compute = common.compute(self.config)
        image = normalise_image(frames["image"]).astype(compute.dtype)
        maps = common.backbone(self.config, LEVELS, name="backbone")(image, mode)
        return common.neck(self.config, name="neck")(maps, mode)


class BirdsEyeEncoder(linen.Module):
    """BEV: lift and splat; [N, cells/4, cells/4, C], or [N, cells, cells, C] without tokens and with many of them.

    Rows grow to the right, columns forward. Differs from the reference where its rays and cells are half a cell off:
    it spreads the rays from the first to the last pixel and rounds towards zero (numerics="reference").
    """

    config: ModelConfig

    @staticmethod
    def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
        """Name of a Batch field -> its shape for one frame."""
        return {"image": (*config.image_size, 3), "intrinsics": (3, 3), "camera_to_ego": (4, 4)}

    @linen.compact
    def __call__(self, frames: Mapping[str, jax.Array], mode: norm.Mode) -> jax.Array:
        config, compute = self.config, common.compute(self.config)
        grid = config_lib.as_kind(config.camera, config_lib.BirdsEyeCamera).grid
        image = normalise_image(frames["image"]).astype(compute.dtype)
        maps = common.backbone(config, LEVELS, name="backbone")(image, mode)
        channels = common.map_channels(config)
        features = pyramid.UpsamplingPyramid(channels, compute, name="neck")(maps, mode)
        logits = layers.Dense(grid.depth_bins, compute, name="depth")(
            pyramid.UpsamplingPyramid(channels, compute, name="depth_neck")(maps, mode))
        probabilities = jnp.moveaxis(jax.nn.softmax(logits.astype(jnp.float32), axis=-1), -1, 1)
        (count, rows, columns), bins = features.shape[:3], grid.depth_bins
        quirks = config.numerics == "reference"
        points_m = frustum.frustum_points(frames["intrinsics"], frames["camera_to_ego"], (rows, columns),
                                          _FINEST_STRIDE, bins, corners=quirks)
        cells = frustum.cell_indices(points_m, grid, truncate=quirks).reshape(count, bins, rows * columns)
        chosen = frustum.most_probable(probabilities.reshape(cells.shape), cells, grid.lifted_bins)
        lifted = frustum.lift_splat(features.reshape(count, -1, channels), *chosen, grid)
        if common.fine_maps(config):
            return lifted
        x = jax.nn.relu(layers.Conv(grid.hidden_channels, (5, 5), compute, 2, name="shrink0")(lifted))
        return layers.Conv(channels, (5, 5), compute, 2, name="shrink1")(x)


REGISTRY: dict[type, type[PlaneEncoder] | type[BirdsEyeEncoder]] = {
    config_lib.PlaneCamera: PlaneEncoder, config_lib.BirdsEyeCamera: BirdsEyeEncoder}
