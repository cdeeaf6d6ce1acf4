"""What a sensor saw, as it looks from where the car will be: range views, images and voxels moved by a flat motion.

`pose` is always where the new ego frame stands in the old one (x, y in metres, yaw in radians; muvo_jax.ops.motion).
Coordinates and values are differentiable with respect to it; which point of two is the nearer one is not. One leading
axis N; all shapes are static.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from muvo_jax.geometry import RangeViewGeometry, VoxelGrid
from muvo_jax.ops import motion
from muvo_jax.ops import range_view as range_view_ops
from muvo_jax.types import RANGE_NO_RETURN_M, Array

FAR_M = 1000.0  # where a pixel without a return is taken to look; only turning moves it
GROUND_M = 0.3  # returns below this height over the road are ground
_MIDDLE = 0.1  # so much of a pixel beside its middle still counts as there


def move_range_view(range_view: Array, pose: Array, geometry: RangeViewGeometry) -> Array:
    """Range views [N, Hr, Wr, 4] of one moment from another place: every return moved, the nearest of a pixel winning.

    Args:
      range_view: types.Batch.range_view.
      pose: [N, 3].

    Returns:
      float32 [N, Hr, Wr, 4], (0, 0, 0, -1) where nothing came to lie. Points that leave the field of view are gone.
    """
    rows = range_view.reshape(range_view.shape[0], -1, 4)
    valid = rows[..., 3] > 0.0
    # Before they are moved: the slope of a pixel without a return that holds NaN would spoil that of the pose.
    points_m = _where_valid(rows[..., :3], valid)
    return splat(motion.into_frame(points_m, pose), valid, geometry)


def splat(points_m: Array, valid: Array, geometry: RangeViewGeometry) -> Array:
    """Points [N, P, 3] (ego frame) as range views [N, Hr, Wr, 4], the nearest valid one [N, P] of each pixel.

    What is not valid may hold anything; but 0 times NaN is NaN, so do not move NaN by a pose whose gradient is wanted.
    """
    points_m = _where_valid(points_m, valid)
    count, points = valid.shape
    cells = geometry.rows * geometry.columns
    row, column, range_m = _polar(points_m, geometry)
    inside = valid & (row >= 0) & (row < geometry.rows)
    pixel = jnp.where(inside, row * geometry.columns + column, cells)
    pixel = jax.lax.stop_gradient(pixel + (cells + 1) * jnp.arange(count, dtype=jnp.int32)[:, None]).reshape(-1)
    ranges = jax.lax.stop_gradient(range_m).reshape(-1)
    nearest = jnp.full((count * (cells + 1),), jnp.inf, jnp.float32).at[pixel].min(ranges)
    wins = ranges == nearest[pixel]
    number = jnp.broadcast_to(jnp.arange(points, dtype=jnp.int32)[None], valid.shape).reshape(-1)
    winner = jnp.full((count * (cells + 1),), -1, jnp.int32).at[pixel].max(jnp.where(wins, number, -1))
    winner = winner.reshape(count, cells + 1)[:, :cells]
    seen = jnp.concatenate([points_m, jnp.expand_dims(range_m, -1)], axis=-1)
    chosen = _rows(seen, jnp.maximum(winner, 0))
    chosen = jnp.where(jnp.expand_dims(winner >= 0, -1), chosen, _hole(chosen))
    return chosen.reshape(count, geometry.rows, geometry.columns, 4)


def _where_valid(points_m: Array, valid: Array) -> Array:
    """Points [N, P, 3], (0, 0, 0) where they are not valid [N, P]."""
    return jnp.where(jnp.expand_dims(valid, -1), points_m, jnp.zeros((), points_m.dtype))


def move_image(image: Array, range_m: Array, pose: Array, intrinsics: Array, camera_to_ego: Array,
               geometry: RangeViewGeometry, which: Array | None = None) -> tuple[Array, Array]:
    """Images [N, H, W, C] of one moment from another place, looked up through the ranges that are seen from there.

    A pixel above or below the lidar's field of view has the horizontal distance of the edge row of its column; one
    without a return lies FAR_M away.

    Args:
      image: [S, H, W, C], of the old moment.
      range_m: [N, Hr, Wr], as seen from the NEW place, negative where nothing is (fill_holes).
      pose: [N, 3].
      intrinsics, camera_to_ego: [N, 3, 3] and [N, 4, 4] of the camera; the same at both places.
      which: int32 [N], the image that each result looks up (nothing is copied); by default one each.

    Returns:
      float32 [N, H, W, C], bilinear, and bool [N, H, W], whether the pixel was inside the old image.
    """
    rows, columns = image.shape[1:3]
    rays = _camera_rays(intrinsics, camera_to_ego, rows, columns)
    camera_m = camera_to_ego[:, None, :3, 3]
    distance_m = _distance_along(rays, camera_m, range_m, geometry)
    points_m = motion.out_of_frame(camera_m + rays * jnp.expand_dims(distance_m, -1), pose)
    u_px, v_px, ahead = _project(points_m, intrinsics, camera_to_ego)
    inside = ahead & (u_px >= 0) & (u_px <= columns) & (v_px >= 0) & (v_px <= rows)
    values, shape = _bilinear(image, v_px - 0.5, u_px - 0.5, which), (pose.shape[0], rows, columns)
    return values.reshape(*shape, image.shape[3]), inside.reshape(shape)


def move_voxels(values: Array, pose: Array, grid: VoxelGrid, source: VoxelGrid | None = None,
                which: Array | None = None) -> Array:
    """Voxels of one moment from another place: trilinear (heights stay), 0 beyond the grid.

    Args:
      values: float32 [S, X', Y', C], of the old moment; C are heights, or several things for each of them.
      pose: [N, 3].
      grid: of the result.
      source: of the values; the same by default.
      which: int32 [N], which of the S each result looks at (nothing is copied); by default one each.

    Returns:
      float32 [N, X, Y, C].
    """
    source = source or grid
    ground_m = voxel_centres_m(grid)[:, :, 0].reshape(1, -1, 3)
    moved = motion.out_of_frame(jnp.broadcast_to(ground_m, (pose.shape[0], *ground_m.shape[1:])), pose)
    place = [(moved[..., axis] - source.origin_m[axis]) / source.voxel_size_m - 0.5 for axis in (0, 1)]
    resampled = _bilinear(values, place[0], place[1], which, outside_is_zero=True)
    return resampled.reshape(pose.shape[0], *grid.shape[:2], values.shape[-1])


def voxel_centres_m(grid: VoxelGrid) -> Array:
    """float32 [X, Y, Z, 3], ego frame."""
    axes = [grid.origin_m[axis] + grid.voxel_size_m * (jnp.arange(side, dtype=jnp.float32) + 0.5)
            for axis, side in enumerate(grid.shape)]
    return jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1)


def hit_voxels(points_m: Array, valid: Array, grid: VoxelGrid) -> Array:
    """1 where a valid point [N, P] of points [N, P, 3] lies in the voxel, else 0: float32 [N, X, Y, Z]."""
    count, cells = points_m.shape[0], math.prod(grid.shape)
    number, inside = jnp.zeros(valid.shape, jnp.int32), valid
    for axis, side in enumerate(grid.shape):
        index = jnp.floor((points_m[..., axis] - grid.origin_m[axis]) / grid.voxel_size_m)
        inside = inside & (index >= 0) & (index < side)
        number = number * side + jnp.clip(index, 0, side - 1).astype(jnp.int32)
    number = jnp.where(inside, number, cells) + (cells + 1) * jnp.arange(count, dtype=jnp.int32)[:, None]
    hits = jnp.zeros((count * (cells + 1),), jnp.float32).at[jax.lax.stop_gradient(number).reshape(-1)].set(1.0)
    return hits.reshape(count, cells + 1)[:, :cells].reshape(count, *grid.shape)


def scan_evidence(scans_m: Array, which: Array, pose: Array, grid: VoxelGrid, geometry: RangeViewGeometry) -> Array:
    """What a scan says about the voxels around another place: 1 hit, -1 looked through, 0 nothing.

    A voxel nearer to the lidar than the return along its beam is free, within a voxel of it occupied, behind it
    unknown; in between it changes linearly, the way of a truncated signed distance. Voxels outside the scan's field of
    view are unknown, pixels without a return free throughout.

    Args:
      scans_m: [S, Hr, Wr], ranges of scans, negative where nothing returned.
      which: int32 [N], the scan that each result looks at; the scans are not copied.
      pose: [N, 3].

    Returns:
      float32 [N, X, Y, Z] in [-1, 1].
    """
    count, centres_m = pose.shape[0], voxel_centres_m(grid).reshape(1, -1, 3)
    points_m = motion.out_of_frame(jnp.broadcast_to(centres_m, (count, *centres_m.shape[1:])), pose)
    row, column, distance_m = _polar(points_m, geometry)
    inside = (row >= 0) & (row < geometry.rows)
    pixel = jnp.clip(row, 0, geometry.rows - 1) * geometry.columns + column
    place = which[:, None] * (geometry.rows * geometry.columns) + pixel
    measured_m = scans_m.reshape(-1)[jax.lax.stop_gradient(place)]
    behind = (distance_m - measured_m) / grid.voxel_size_m  # in voxels
    hit = jnp.clip(2.0 - 2.0 * jnp.abs(behind), 0.0, 1.0)
    free = jnp.clip(-2.0 * behind - 1.0, 0.0, 1.0)
    evidence = jnp.where(measured_m > 0.0, hit - free, -1.0)
    return jnp.where(inside, evidence, 0.0).reshape(count, *grid.shape)


def move_sky(range_view: Array, pose: Array, geometry: RangeViewGeometry) -> Array:
    """Where the pixels without a return come to lie: bool [N, Hr, Wr]. They are infinitely far, and only turn."""
    directions = jnp.asarray(range_view_ops.beam_directions(geometry)).reshape(1, -1, 3) * FAR_M
    points_m = jnp.broadcast_to(directions + _lidar_m(geometry), (range_view.shape[0], *directions.shape[1:]))
    nothing = range_view[..., 3].reshape(range_view.shape[0], -1) <= 0.0
    return splat(motion.into_frame(points_m, pose), nothing, geometry)[..., 3] > 0.0


def onto_beams(range_view: Array, geometry: RangeViewGeometry) -> Array:
    """Moved returns [N, Hr, Wr, 4] where the beam of their pixel meets the same surface.

    The ground (below GROUND_M) is flat: there the height stays. Everything else stands upright: the horizontal
    distance stays. So the rings that a scan draws on the road stand still while the world moves.
    """
    beams = jnp.asarray(range_view_ops.beam_directions(geometry))[None]
    down = jnp.minimum(beams[..., 2], -0.02)
    height_m = range_view[..., 2] - geometry.position_m[2]
    ground = (range_view[..., 2] < GROUND_M) & (beams[..., 2] < -0.02)
    flat_m = jnp.sqrt(jnp.maximum(range_view[..., 3] ** 2 - height_m**2, 1e-6))
    range_m = jnp.where(ground, height_m / down, flat_m / jnp.sqrt(1.0 - beams[..., 2] ** 2))
    moved = jnp.concatenate([beam_points(range_m, geometry), jnp.expand_dims(range_m, -1)], axis=-1)
    return jnp.where(range_view[..., 3:] > 0.0, moved, range_view)


def lies_on_beams(range_view: Array, geometry: RangeViewGeometry) -> Array:
    """Whether a scan's returns [N, Hr, Wr, 4] lie in the middle of their pixels, bool [N].

    So it is with a simulated lidar of as many beams. A pixel that holds one of several returns has it anywhere.
    """
    away_m = jnp.linalg.norm(range_view[..., :3] - beam_points(range_view[..., 3], geometry), axis=-1)
    pixel_m = range_view[..., 3] * (2.0 * math.pi / geometry.columns)
    returned = range_view[..., 3] > 0.0
    middle = (returned & (away_m < _MIDDLE * pixel_m)).sum(axis=(1, 2))
    return 2 * middle > returned.sum(axis=(1, 2))


def beam_points(range_m: Array, geometry: RangeViewGeometry, scale: int = 1) -> Array:
    """The points [..., Hr, Wr, 3] (ego frame) in the middle of the pixels at ranges [..., Hr, Wr].

    Of a smaller picture [..., Hr/scale, Wr/scale] in the middle of those that it keeps.
    """
    beams = jnp.asarray(range_view_ops.beam_directions(geometry))[::scale, ::scale]
    lead = (1,) * (range_m.ndim - 2)
    return (beams.reshape(*lead, *beams.shape) * jnp.expand_dims(range_m, -1)
            + _lidar_m(geometry).reshape(*lead, 1, 1, 3))


def fill_holes(range_m: Array, sky: Array, geometry: RangeViewGeometry, rounds: int = 2) -> Array:
    """Ranges [N, Hr, Wr] in which pixels that neither returned nor are `sky` take the nearest of their neighbours'.

    By horizontal distance; a pixel whose known neighbours are all sky becomes sky. What stays unknown, and sky, holds
    -1. (The mean of the neighbours instead hangs points in the air between an edge and what lies behind it.)
    """
    flat = jnp.sqrt(1.0 - jnp.asarray(range_view_ops.beam_directions(geometry))[None, ..., 2] ** 2)
    returned = range_m > 0.0
    # 1 / horizontal distance, 0 for sky, -1 unknown: the largest of the neighbours is the nearest.
    nearness = jnp.where(returned, 1.0 / jnp.where(returned, range_m * flat, 1.0), jnp.where(sky, 0.0, -1.0))
    for _ in range(rounds):
        nearness = jnp.where(nearness < 0.0, _largest_neighbour(nearness), nearness)
    near = nearness > 1.0 / FAR_M
    return jnp.where(near, 1.0 / (jnp.where(near, nearness, 1.0) * flat), RANGE_NO_RETURN_M)


def _largest_neighbour(values: Array) -> Array:
    """The largest of 3x3 pixels of [N, Hr, Wr]; columns go round, rows end."""
    wide = jnp.concatenate([values[:, :, -1:], values, values[:, :, :1]], axis=2)
    across = jnp.maximum(jnp.maximum(wide[:, :, :-2], wide[:, :, 1:-1]), wide[:, :, 2:])
    tall = jnp.pad(across, ((0, 0), (1, 1), (0, 0)), constant_values=-1.0)
    return jnp.maximum(jnp.maximum(tall[:, :-2], tall[:, 1:-1]), tall[:, 2:])


def _lidar_m(geometry: RangeViewGeometry) -> Array:
    return jnp.asarray(geometry.position_m, jnp.float32).reshape(1, 1, 3)


def _polar(points_m: Array, geometry: RangeViewGeometry) -> tuple[Array, Array, Array]:
    """Row and column (int32) and range of points [..., 3]; rows may lie outside the field of view."""
    x, y, z = (points_m[..., axis] - geometry.position_m[axis] for axis in range(3))
    flat_m = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))
    range_m = jnp.sqrt(flat_m * flat_m + z * z)
    span_rad = geometry.elevation_max_rad - geometry.elevation_min_rad
    share = (jnp.arctan2(z, flat_m) - geometry.elevation_min_rad) / span_rad
    row = jnp.floor((1.0 - share) * geometry.rows).astype(jnp.int32)
    column = jnp.floor(0.5 * (1.0 - jnp.arctan2(y, x) / jnp.pi) * geometry.columns).astype(jnp.int32)
    return row, jnp.clip(column, 0, geometry.columns - 1), range_m


def _rows(values: Array, index: Array) -> Array:
    """values [N, R, C] at rows [N, P]: [N, P, C]."""
    return jax.vmap(lambda rows, chosen: rows[chosen])(values, index)


def _hole(like: Array) -> Array:
    return jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, RANGE_NO_RETURN_M], jnp.float32).reshape(
        (1,) * (like.ndim - 1) + (4,)), like.shape)


def _camera_rays(intrinsics: Array, camera_to_ego: Array, rows: int, columns: int) -> Array:
    """Unit vectors [N, H * W, 3] (ego axes) through the pixels' centres."""
    centres_px = [jnp.arange(side, dtype=jnp.float32) + 0.5 for side in (rows, columns)]
    v_px, u_px = jnp.meshgrid(*centres_px, indexing="ij")
    pixels = jnp.stack([u_px, v_px, jnp.ones_like(u_px)], axis=-1).reshape(-1, 3)
    to_ego = jnp.einsum("nij,njk->nik", camera_to_ego[:, :3, :3], jnp.linalg.inv(intrinsics),
                        precision=jax.lax.Precision.HIGHEST)
    rays = jnp.einsum("nij,pj->npi", to_ego, pixels, precision=jax.lax.Precision.HIGHEST)
    return rays / jnp.linalg.norm(rays, axis=-1, keepdims=True)


def _distance_along(rays: Array, camera_m: Array, range_m: Array, geometry: RangeViewGeometry) -> Array:
    """How far each ray [N, P, 3] from the camera goes until it meets what the lidar at another place measured."""
    count = range_m.shape[0]
    lidar_m = _lidar_m(geometry)
    beams = range_view_ops.beam_directions(geometry)
    flat = jnp.asarray(jnp.hypot(beams[..., 0], beams[..., 1])).reshape(1, -1)
    returns = range_m.reshape(count, -1)
    flat_m = jnp.where(returns > 0.0, returns * flat, FAR_M)  # horizontal: walls go on above the field of view
    distance_m = jnp.full(rays.shape[:2], 20.0)
    for _ in range(2):  # the camera stands within a metre or two of the lidar: twice is enough
        row, column, _ = _polar(camera_m + rays * jnp.expand_dims(distance_m, -1), geometry)
        pixel = jax.lax.stop_gradient(jnp.clip(row, 0, geometry.rows - 1) * geometry.columns + column)
        horizontal_m = jnp.take_along_axis(flat_m, pixel, axis=1)
        offset = lidar_m - camera_m
        ray_flat = jnp.sqrt(rays[..., 0]**2 + rays[..., 1]**2)
        along_m = (rays[..., 0] * offset[..., 0] + rays[..., 1] * offset[..., 1]) / ray_flat
        distance_m = jnp.clip((horizontal_m + along_m) / ray_flat, 0.5, FAR_M)
    return distance_m


def _project(points_m: Array, intrinsics: Array, camera_to_ego: Array) -> tuple[Array, Array, Array]:
    """Continuous column and row in the image and whether a point [N, P, 3] lies ahead of the camera."""
    relative_m = points_m - camera_to_ego[:, None, :3, 3]
    camera = jnp.einsum("nji,npj->npi", camera_to_ego[:, :3, :3], relative_m, precision=jax.lax.Precision.HIGHEST)
    ahead = camera[..., 2] > 0.1
    depth_m = jnp.where(ahead, camera[..., 2], 1.0)
    focal = lambda axis: intrinsics[:, axis, axis][:, None]
    centre = lambda axis: intrinsics[:, axis, 2][:, None]
    u_px = focal(0) * camera[..., 0] / depth_m + centre(0)
    return u_px, focal(1) * camera[..., 1] / depth_m + centre(1), ahead


def _bilinear(values: Array, row: Array, column: Array, which: Array | None = None, *,
              outside_is_zero: bool = False) -> Array:
    """values [S, H, W, C] at places [N, P] (whole numbers are centres): float32 [N, P, C]; edges repeat unless zero.

    which: int32 [N], the entry of `values` that a row of places looks at; by default one each.
    """
    entries, rows, columns, channels = values.shape
    flat = values.reshape(-1, channels)
    first = (jnp.arange(entries) if which is None else which)[:, None] * (rows * columns)
    top, left = jnp.floor(row), jnp.floor(column)
    result = jnp.zeros((*row.shape, channels), jnp.float32)
    for down in (0, 1):
        for right in (0, 1):
            r, c = top + down, left + right
            weight = jnp.abs(1 - down - (row - top)) * jnp.abs(1 - right - (column - left))
            if outside_is_zero:
                weight = jnp.where((r >= 0) & (r < rows) & (c >= 0) & (c < columns), weight, 0.0)
            index = jnp.clip(r, 0, rows - 1) * columns + jnp.clip(c, 0, columns - 1)
            picked = flat[first + index.astype(jnp.int32)]
            result = result + picked.astype(jnp.float32) * jnp.expand_dims(weight, -1)
    return result
