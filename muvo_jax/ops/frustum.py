"""From the image plane to the ground (lift, splat; Philion and Fidler, 2020): where pixels lie, and pooling into cells.

A pixel's features are spread over distances by a depth distribution and summed in the cells of a bird's-eye grid. All
shapes are static: what falls outside the grid is added to a cell that is cut off. The sums are plain float32 sums, in
which nothing cancels, unlike differences of a running sum.

Row r, column c of a bird's-eye map: columns grow forward, rows grow to the right.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from muvo_jax.geometry import BirdsEyeGrid
from muvo_jax.ops import precision

HEIGHT_RANGE_M = (-30.0, 10.0)  # the reference's: practically everything


def frustum_points(intrinsics: jax.Array, camera_to_ego: jax.Array, map_size: tuple[int, int], stride: int, bins: int,
                   *, corners: bool = False) -> jax.Array:
    """Points on the rays of a feature map's cells, at 1, 2, ... `bins` metres along the optical axis.

    Args:
      intrinsics: [B, 3, 3], of the image.
      camera_to_ego: [B, 4, 4].
      map_size: rows h, columns w of the feature map.
      stride: image pixels per cell.
      corners: spread the rays evenly from the image's first to its last pixel, as the reference does; otherwise they
        pass through the cells' centres.

    Returns:
      float32 [B, bins, h, w, 3], ego frame, metres.
    """
    rows, columns = map_size
    if corners:
        v_px = jnp.linspace(0.0, stride * rows - 1.0, rows, dtype=jnp.float32)
        u_px = jnp.linspace(0.0, stride * columns - 1.0, columns, dtype=jnp.float32)
    else:
        v_px, u_px = (stride * (jnp.arange(side, dtype=jnp.float32) + 0.5) for side in map_size)
    depth_m = jnp.arange(1, bins + 1, dtype=jnp.float32)
    v_px, u_px = jnp.meshgrid(v_px, u_px, indexing="ij")
    pixels = jnp.stack([u_px, v_px, jnp.ones_like(u_px)], axis=-1)
    scaled = jnp.expand_dims(pixels, 0) * depth_m[:, None, None, None]
    to_ego = jnp.einsum("bij,bjk->bik", camera_to_ego[:, :3, :3], jnp.linalg.inv(intrinsics),
                        precision=precision.PRODUCTS)
    points = jnp.einsum("bij,dhwj->bdhwi", to_ego, scaled, precision=precision.PRODUCTS)
    return points + camera_to_ego[:, None, None, None, :3, 3]


def cell_indices(points_m: jax.Array, grid: BirdsEyeGrid, *, truncate: bool = False) -> jax.Array:
    """The flat cell of each point, int32 [...], row * cells + column; cells**2 where it lies in none.

    Args:
      points_m: float32 [..., 3], ego frame.
      truncate: round towards zero as the reference does, which adds the cells just outside to the first row and column.
    """
    per_m = 1.0 / grid.cell_m
    column = points_m[..., 0] * per_m + grid.cells_behind
    row = grid.cells / 2 - points_m[..., 1] * per_m
    height_m = points_m[..., 2]
    lower = -1.0 if truncate else 0.0
    inside = (height_m > HEIGHT_RANGE_M[0]) & (height_m < HEIGHT_RANGE_M[1])
    for value in (row, column):
        inside &= ((value > lower) if truncate else (value >= lower)) & (value < grid.cells)
    flat = row.astype(jnp.int32) * grid.cells + column.astype(jnp.int32)
    return jnp.where(inside, flat, grid.cells**2)


def pool(values: jax.Array, cells: jax.Array, grid: BirdsEyeGrid) -> jax.Array:
    """Sums values by cell.

    Args:
      values: float32 [B, P, C].
      cells: int32 [B, P], of `cell_indices`.

    Returns:
      float32 [B, cells, cells, C].
    """
    total = jax.vmap(lambda value, cell: jax.ops.segment_sum(value, cell, grid.cells**2 + 1))(values, cells)
    return total[:, :-1].reshape(-1, grid.cells, grid.cells, values.shape[-1])


def most_probable(probabilities: jax.Array, cells: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """The `count` largest probabilities [B, D, P] over D, and the cells that they go to: [B, count, P] each."""
    if count == probabilities.shape[1]:
        return probabilities, cells
    chosen, index = jax.lax.top_k(jnp.moveaxis(probabilities, 1, -1), count)
    index = jnp.moveaxis(index, -1, 1)
    return jnp.moveaxis(chosen, -1, 1), jnp.take_along_axis(cells, index, axis=1)


def lift_splat(features: jax.Array, probabilities: jax.Array, cells: jax.Array, grid: BirdsEyeGrid) -> jax.Array:
    """Sum over pixels p and depths d of probabilities[d, p] * features[p], by the cell of (d, p).

    The product of features and depths is never formed: the probabilities are summed by (cell, pixel), which is a matrix
    that the features are multiplied by.

    Args:
      features: [B, P, C].
      probabilities: float32 [B, D, P].
      cells: int32 [B, D, P], of `cell_indices`.

    Returns:
      [B, cells, cells, C] of the dtype of the features.
    """
    pixels = features.shape[1]

    def one(feature, probability, cell):
        place = cell * pixels + jnp.arange(pixels, dtype=jnp.int32)[None]
        size = (grid.cells**2 + 1) * pixels
        weights = jnp.zeros((size,), jnp.float32).at[place.reshape(-1)].add(probability.reshape(-1))
        weights = weights[:-pixels].reshape(grid.cells**2, pixels)
        return jnp.dot(weights.astype(feature.dtype), feature, precision=precision.PRODUCTS)

    pooled = jax.vmap(one)(features, probabilities, cells)
    return pooled.reshape(-1, grid.cells, grid.cells, features.shape[-1])
