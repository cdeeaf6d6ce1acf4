"""Points to pillars (PointPillars, Lang et al., 2019): which pillar a point is in, how it lies there, and pooling.

All shapes are static: padding and points outside the grid belong to a pillar that is cut off.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from muvo_jax.geometry import PillarGrid


def pillar_indices(points_m: jax.Array, count: jax.Array, grid: PillarGrid) -> tuple[jax.Array, jax.Array]:
    """Which pillar each point is in.

    Args:
      points_m: float32 [F, N, 3], ego frame.
      count: int32 [F], how many of the N rows are points.

    Returns:
      index: int32 [F, N], the pillar among those of all F frames, frame * cells**2 + x cell * cells + y cell;
        F * cells**2 where there is none.
      cell: int32 [F, N, 2], x cell and y cell.
    """
    frames, rows, _ = points_m.shape
    inside = jnp.arange(rows, dtype=jnp.int32)[None] < count[:, None]
    for axis in (0, 1):
        inside &= (points_m[..., axis] >= -grid.half_side_m) & (points_m[..., axis] < grid.half_side_m)
    # In float32, as the reference computes it: in float64 one point in 10,000 falls into the next cell.
    scaled = (points_m[..., :2] + jnp.float32(grid.half_side_m)) * jnp.float32(grid.cells_per_m)
    cell = jnp.clip(scaled.astype(jnp.int32), 0, grid.cells - 1)
    frame = jnp.arange(frames, dtype=jnp.int32)[:, None]
    index = (frame * grid.cells + cell[..., 0]) * grid.cells + cell[..., 1]
    return jnp.where(inside, index, frames * grid.cells**2), cell


def decorate(points_m: jax.Array, index: jax.Array, cell: jax.Array, grid: PillarGrid, *,
             swapped_corners: bool = False) -> jax.Array:
    """What the network sees of a point: x, y, z; the same minus the pillar's mean; x, y minus the cell's centre.

    Padding and points outside the grid count as (0, 0, 0): whatever they hold, even NaN, reaches no gradient.

    Args:
      points_m, index, cell: of `pillar_indices`.
      swapped_corners: measure from the cell's lower corner, and with the two axes of the cell mixed up, as the
        reference does.

    Returns:
      float32 [F, N, 8].
    """
    nowhere = points_m.shape[0] * grid.cells**2
    points_m = jnp.where(jnp.expand_dims(index < nowhere, -1), points_m, jnp.zeros((), points_m.dtype))
    flat, flat_index = points_m.reshape(-1, 3), index.reshape(-1)
    counted = jnp.concatenate([flat, jnp.ones_like(flat[:, :1])], axis=1)
    total = jax.ops.segment_sum(counted, flat_index, nowhere + 1)[flat_index]
    mean = (total[:, :3] / jnp.maximum(total[:, 3:], 1.0)).reshape(points_m.shape)
    if swapped_corners:
        place = cell[..., ::-1].astype(jnp.float32)
    else:
        place = cell.astype(jnp.float32) + 0.5
    centre = place / jnp.float32(grid.cells_per_m) - jnp.float32(grid.half_side_m)
    return jnp.concatenate([points_m, points_m - mean, points_m[..., :2] - centre], axis=-1)


def canvas(features: jax.Array, index: jax.Array, grid: PillarGrid) -> jax.Array:
    """The largest value of each channel in each pillar, 0 where it is empty.

    Args:
      features: [F, N, C], not negative.
      index: int32 [F, N], of `pillar_indices`.

    Returns:
      [F, cells, cells, C]; rows grow backward (the first is farthest ahead), columns with y, to the left.
    """
    frames, channels = features.shape[0], features.shape[-1]
    flat = features.reshape(-1, channels)
    empty = jnp.zeros((math.prod((frames, grid.cells, grid.cells)) + 1, channels), features.dtype)
    pooled = empty.at[index.reshape(-1)].max(flat)[:-1]
    return jnp.flip(pooled.reshape(frames, grid.cells, grid.cells, channels), axis=1)
