"""Left and right exchanged: training windows as if world, car and sensors were seen in a mirror along the road.

Unlike augmentation.py this changes targets too, all fields of a window alike, so it happens to the whole batch before
anything else. Fields that are drawn from above or around the car are flipped, which is exact only where the car stands
in their middle; `check` says so before anything is compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.model import world_model

_SITE = 0x3D1F  # separates these draws from all others made with the same sample key
_EGO = np.array([1.0, -1.0, 1.0, 1.0])  # x forward, y left, z up, and 1 or a range
_CAMERA = np.array([-1.0, 1.0, 1.0, 1.0])  # x right, y down, z forward
# Left, right, straight, follow the lane, change to the left, change to the right (the reference's order).
_OTHER_COMMAND = np.array([1, 0, 2, 3, 5, 4], np.int32)
_SYMMETRIC_M = 1e-6


def _flip(axis: int) -> Callable[[types.Array], types.Array]:
    return lambda value: jnp.flip(value, axis)


def _signs(*signs: float) -> Callable[[types.Array], types.Array]:
    return lambda value: _times(value, np.array(signs))


def _times(value: types.Array, factors: np.ndarray) -> types.Array:
    """Multiplies the last axes."""
    return value * factors.astype(np.float32).reshape((1,) * (value.ndim - factors.ndim) + factors.shape)


def _same(value: types.Array) -> types.Array:
    return value


def _other_command(value: types.Array) -> types.Array:
    return jnp.asarray(_OTHER_COMMAND)[value]


# Every field of types.Batch but the intrinsics, which need the width of the image.
_MIRRORED: dict[str, Callable[[types.Array], types.Array]] = {
    "action": _signs(1.0, -1.0), "is_first": _same, "speed_mps": _same, "reward": _same, "is_terminal": _same,
    "image": _flip(-2), "depth_m": _flip(-1), "image_classes": _flip(-1), "image_instance_mask": _flip(-1),
    "image_moving_mask": _flip(-1), "occupancy_moving_mask": _flip(-2),
    "range_view": lambda value: _times(jnp.flip(value, -2), _EGO),
    "range_view_classes": _flip(-1), "points": _signs(1.0, -1.0, 1.0), "point_count": _same,
    "occupancy": _flip(-2), "birds_eye_classes": _flip(-1), "birds_eye_instances": _flip(-1),
    "route_map": _flip(-1),  # the car stands on the line between the two middle columns
    "command": _other_command, "next_command": _other_command,
    "target_m": _signs(1.0, -1.0), "next_target_m": _signs(1.0, -1.0),
    "ego_motion": _signs(1.0, -1.0, -1.0, 1.0),
    "camera_to_ego": lambda value: _times(value, np.outer(_EGO, _CAMERA)),
}


def mirrored(batch: types.Batch) -> types.Batch:
    """All windows of a batch with left and right exchanged, of the same shapes and dtypes; see `check`."""
    fields = {name: _MIRRORED[name](jnp.asarray(value)) for name, value in vars(batch).items()
              if value is not None and name != "intrinsics"}
    if batch.intrinsics is not None:
        fields["intrinsics"] = _intrinsics(jnp.asarray(batch.intrinsics), _width_px(batch))
    return dataclasses.replace(batch, **fields)


def randomly(batch: types.Batch, keys: types.Array) -> types.Batch:
    """Each window mirrored with probability 1/2.

    Args:
      batch: windows [B, T, ...].
      keys: typed keys [B], one per window.
    """
    coin = jax.vmap(lambda key: jax.random.bernoulli(jax.random.fold_in(key, _SITE)))(keys)
    pick = lambda other, own: jnp.where(coin.reshape(-1, *(1,) * (own.ndim - 1)), other, own)
    return jax.tree.map(pick, mirrored(batch), batch)


def check(config: config_lib.Config) -> None:
    """Raises ValueError where a sensor, grid or map of the model has the car beside its middle: a flip is no mirror."""
    model, scale, aside = config.model, config.data.route_map, None
    grid = model.voxels
    drawn = {head_lib.get(name).tokens for name in model.heads}
    middle_m = grid.origin_m[1] + 0.5 * grid.shape[1] * grid.voxel_size_m
    if "occupancy" in drawn and abs(middle_m) > _SYMMETRIC_M:
        aside = f"the middle of model.voxels lies at y = {middle_m:g} m"
    lidar_m = model.range_view.position_m[1]
    if (model.lidar is not None or "range_view" in drawn) and abs(lidar_m) > _SYMMETRIC_M:
        aside = f"the lidar (model.range_view.position_m) lies at y = {lidar_m:g} m"
    middle_px = world_model.ROUTE_MAP_SIZE[1] / 2
    if model.route and abs(scale.ego_column - middle_px) * scale.metres_per_px > _SYMMETRIC_M:
        aside = (f"in its route maps it stands at column {scale.ego_column:g} (data.route_map.ego_column), not at the "
                 f"middle, {middle_px:g}")
    if aside:
        raise ValueError(f"augmentation.mirror=true exchanges left and right about the middle of the car, but {aside}. "
                         f"Train without it (--set augmentation.mirror=false), or record with sensors, grids and route "
                         f"maps that are symmetric about y = 0.")


def _intrinsics(matrix: types.Array, width_px: int) -> types.Array:
    """Of the flipped image: pixel i covers [i, i + 1), so a place at u comes to width - u."""
    signs = np.array([[1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    return _times(matrix, signs).at[:, 0, 2].add(width_px)


def _width_px(batch: types.Batch) -> int:
    if batch.image is not None:
        return batch.image.shape[-2]
    for name in ("depth_m", "image_classes", "image_instance_mask"):
        if getattr(batch, name) is not None:
            return getattr(batch, name).shape[-1]
    raise ValueError("a batch has intrinsics but no image that they belong to; leave them out.")
