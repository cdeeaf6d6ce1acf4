"""Encoders: what the sensors and the car say -> maps and vectors that fusion takes.

Cameras and lidars give maps of fusion's channels. WOB (without bird's-eye view, paper Table I) keeps the image plane,
BEV lifts it to the ground ahead; RV reads the range view as a four-channel image, PP the points themselves as pillars
on the ground. The planned route, the speed and what the navigation says become one vector each, of as many channels as
a token where it becomes one.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax.config import ModelConfig, TokenLatent, TransformerFusion
from muvo_jax.geometry import PillarGrid
from muvo_jax.model import tokens
from muvo_jax.nn import layers, mobilevit, norm, pyramid, resnet
from muvo_jax.ops import conv_cpu, frustum, pillars

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
COMMANDS = 6
_BACKBONES: dict[str, type[resnet.ResNet18] | type[mobilevit.MobileVit]] = {
    "resnet18": resnet.ResNet18, "mobilevitv2_100": mobilevit.MobileVit}
_LEVELS = (2, 3, 4)
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
        compute = layers.Compute.of(self.config)
        image = normalise_image(frames["image"]).astype(compute.dtype)
        maps = _backbone(self.config, _LEVELS, name="backbone")(image, mode)
        return _neck(self.config, name="neck")(maps, mode)


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
        config, compute = self.config, layers.Compute.of(self.config)
        grid = config_lib.as_kind(config.camera, config_lib.BirdsEyeCamera).grid
        image = normalise_image(frames["image"]).astype(compute.dtype)
        maps = _backbone(config, _LEVELS, name="backbone")(image, mode)
        channels = _map_channels(config)
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
        if tokens.fine_maps(config):
            return lifted
        x = jax.nn.relu(layers.Conv(grid.hidden_channels, (5, 5), compute, 2, name="shrink0")(lifted))
        return layers.Conv(channels, (5, 5), compute, 2, name="shrink1")(x)


class RangeViewEncoder(linen.Module):
    """RV: [N, Hr/32, Wr/32, C]; for the 2D latent /16; /8 for fusions without tokens and with many of them (2D: /4)."""

    config: ModelConfig

    @staticmethod
    def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
        """Name of a Batch field -> its shape for one frame."""
        return {"range_view": (config.range_view.rows, config.range_view.columns, 4)}

    @linen.compact
    def __call__(self, frames: Mapping[str, jax.Array], mode: norm.Mode) -> jax.Array:
        compute = layers.Compute.of(self.config)
        scaled = (frames["range_view"] / self.config.range_scale_m).astype(compute.dtype)
        levels = (1, 2, 3) if isinstance(self.config.latent, TokenLatent) else _LEVELS
        maps = _backbone(self.config, levels, name="backbone")(scaled, mode)
        return _neck(self.config, name="neck")(maps, mode)


class PillarNet(linen.Module):
    """Points [N, P, 3] -> [N, cells, cells, channels]: two dense layers for each point, their maximum in each pillar.

    BatchNorm's moments are those of the points inside the grid. Differs from the reference where that measures a point
    from the cell's corner, with x and y mixed up (numerics="reference").
    """

    config: ModelConfig
    grid: PillarGrid

    @linen.compact
    def __call__(self, points_m: jax.Array, count: jax.Array, mode: norm.Mode) -> jax.Array:
        grid, compute = self.grid, layers.Compute.of(self.config)
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
        maps = resnet.ResNet18(self.config.backbone_width, _LEVELS, layers.Compute.of(self.config),
                               name="pillar_backbone")(canvas, mode)
        return _neck(self.config, name="pillar_neck")(maps, mode)


class RouteEncoder(linen.Module):
    """Route map uint8 [N, 64, 64] -> [N, C]: a ResNet-18 on three equal channels."""

    config: ModelConfig

    @linen.compact
    def __call__(self, route_map: jax.Array, mode: norm.Mode) -> jax.Array:
        compute = layers.Compute.of(self.config)
        image = normalise_image(jnp.repeat(jnp.expand_dims(route_map, -1), 3, axis=-1)).astype(compute.dtype)
        (deepest,) = resnet.ResNet18(self.config.backbone_width, (4,), compute, name="backbone")(image, mode)
        channels = _measured_channels(self.config)
        return layers.Dense(channels, compute, name="linear")(jnp.mean(deepest, axis=(1, 2)))


class SmallRouteEncoder(linen.Module):
    """The same by two convolutions on blocks of 4x4 pixels, whose cells stay apart: where the route turns matters."""

    config: ModelConfig

    @linen.compact
    def __call__(self, route_map: jax.Array, mode: norm.Mode) -> jax.Array:
        del mode
        compute = layers.Compute.of(self.config)
        x = jnp.expand_dims(route_map, -1).astype(compute.dtype) / 255.0
        x = jax.nn.relu(layers.Dense(16, compute, name="blocks")(conv_cpu.space_to_depth(x, (4, 4))))
        x = jax.nn.relu(layers.Conv(32, (3, 3), compute, 2, name="conv")(x))
        return layers.Dense(_measured_channels(self.config), compute, name="linear")(
            x.reshape(x.shape[0], -1))


class SpeedEncoder(linen.Module):
    """Speed float32 [N] in m/s -> [N, C]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, speed_mps: jax.Array) -> jax.Array:
        scaled = jnp.expand_dims(speed_mps / self.config.speed_scale_mps, -1)
        widths = (self.config.measurement_channels, _measured_channels(self.config))
        return jax.nn.relu(layers.Mlp(widths, layers.Compute.of(self.config), name="mlp")(scaled))


class CommandEncoder(linen.Module):
    """A navigation command int32 [N], 0 to 5 -> [N, C]; another counts as the nearest of these."""

    config: ModelConfig

    @linen.compact
    def __call__(self, command: jax.Array) -> jax.Array:
        channels = self.config.measurement_channels // 2
        embedding = self.param("embedding", layers.shape_only, (COMMANDS, channels))
        out = channels if isinstance(self.config.latent, config_lib.VectorLatent) else _measured_channels(self.config)
        return jax.nn.relu(layers.Mlp((channels, out), layers.Compute.of(self.config), name="mlp")(
            jnp.take(embedding, jnp.clip(command, 0, COMMANDS - 1), axis=0)))


class TargetEncoder(linen.Module):
    """The places of both commands, float32 [N, 2] each, m -> [N, C]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, target_m: jax.Array, next_target_m: jax.Array) -> jax.Array:
        widths = (self.config.measurement_channels, _measured_channels(self.config))
        both = jnp.concatenate([target_m, next_target_m], axis=-1)
        return jax.nn.relu(layers.Mlp(widths, layers.Compute.of(self.config), name="mlp")(both))


CAMERAS: dict[type, type[PlaneEncoder] | type[BirdsEyeEncoder]] = {
    config_lib.PlaneCamera: PlaneEncoder, config_lib.BirdsEyeCamera: BirdsEyeEncoder}
LIDARS: dict[type, type[RangeViewEncoder] | type[PillarEncoder]] = {
    config_lib.RangeViewLidar: RangeViewEncoder, config_lib.PillarLidar: PillarEncoder}
ROUTE_ENCODERS: dict[str, type[RouteEncoder] | type[SmallRouteEncoder]] = {
    "resnet18": RouteEncoder, "small": SmallRouteEncoder}


def _backbone(config: ModelConfig, levels: tuple[int, ...], name: str) -> linen.Module:
    """The feature pyramid of an image or a range view."""
    return _BACKBONES[config.backbone](config.backbone_width, levels, layers.Compute.of(config), name=name)


def _neck(config: ModelConfig, name: str) -> linen.Module:
    """Brings a pyramid's maps together: at the coarsest size, at the finest where fusion has no tokens or many."""
    kind = pyramid.UpsamplingPyramid if tokens.fine_maps(config) else pyramid.DownsamplingPyramid
    return kind(_map_channels(config), layers.Compute.of(config), name=name)


def _map_channels(config: ModelConfig) -> int:
    """Channels of the sensors' maps as fusion takes them."""
    fusion = config.fusion
    return fusion.token_channels if isinstance(fusion, TransformerFusion) else fusion.map_channels


def _measured_channels(config: ModelConfig) -> int:
    """C of an encoded measurement: a token's where it becomes one."""
    if isinstance(config.latent, TokenLatent):
        return tokens.fusion(config).token_channels
    return config.measurement_channels
