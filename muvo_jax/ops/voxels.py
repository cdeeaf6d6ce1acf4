"""Occupancy grids from points and from the rays that measured them (host side, NumPy).

The paper voxelises fused depth-map and lidar points and calls every other voxel empty. Here a voxel is empty only where
a measuring ray passed through it; voxels that no ray has reached are unknown.
"""

from __future__ import annotations

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.ops import range_view

EMPTY, OCCUPIED, UNKNOWN = 0, 1, 255


def voxelize(points_m: np.ndarray, grid: config_lib.VoxelGrid) -> np.ndarray:
    """Marks the voxels that contain a point.

    Args:
      points_m: [P, 3], ego frame, metres; points outside the grid count for nothing.

    Returns:
      uint8 [X, Y, Z], 1 where at least one point lies in [corner, corner + voxel size), else 0.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    number = _flat_index(_in_voxels(points_m, grid), grid)
    occupied = np.zeros(int(np.prod(grid.shape)), np.uint8)
    occupied[number[number >= 0]] = 1
    return occupied.reshape(grid.shape)


def voxel_table(points_m: np.ndarray, tags: np.ndarray, grid: config_lib.VoxelGrid, *,
                winning_tag: int | None = None) -> np.ndarray:
    """Lists the occupied voxels, each with the tag of its point nearest to the voxel's LOWER CORNER, in float64.

    That is how the authors' generate_voxels labels (its comment says centre); of points at exactly one distance the
    last wins here, any in their code, which sorts unstably.

    Args:
      points_m: [P, 3], ego frame, metres, in float32 or float64; points outside the grid count for nothing.
      tags: unsigned [P].
      winning_tag: a tag that labels a voxel however far from the corner its point lies (the authors': road line).

    Returns:
      uint16 [M, 4]: ix, iy, iz, tag, sorted by z, then y, then x.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    points_m = np.asarray(points_m)
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        range_view.check_points(points_m)  # raises
    tags = np.asarray(tags)
    if tags.shape != points_m.shape[:1]:
        raise ValueError(f"tags: got shape {tags.shape}, expected one for each of {len(points_m)} points.")
    nearest = range_view.NearestOfCells(int(np.prod(grid.shape)))
    has_winning = np.zeros(len(nearest.winner) + 1, bool)  # the last place is of the points outside
    for start in range(0, len(points_m), range_view.BLOCK_POINTS):
        block = slice(start, start + range_view.BLOCK_POINTS)
        number, to_corner = _number_and_distance(points_m[block], grid)
        if not np.isfinite(to_corner).all():
            range_view.check_points(points_m)  # says which points are not finite
        nearest.add(number, to_corner, start)
        if winning_tag is not None:
            has_winning[number[tags[block] == winning_tag]] = True
    voxel = np.flatnonzero(nearest.winner >= 0)
    tag = tags[nearest.winner[voxel]].astype(np.uint16)
    tag[has_winning[voxel]] = 0 if winning_tag is None else winning_tag
    columns, rows, _ = grid.shape
    plane, ix = np.divmod(voxel.astype(np.int32), np.int32(columns))
    iz, iy = np.divmod(plane, np.int32(rows))
    return np.stack([ix, iy, iz, tag], axis=1).astype(np.uint16)


def voxel_index(points_m: np.ndarray, grid: config_lib.VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Returns the voxel of each point, int32 [P, 3], and whether it lies inside the grid, bool [P]."""
    index = np.floor(_in_voxels(points_m, grid)).astype(np.int32).T
    inside = ((index >= 0) & (index < np.asarray(grid.shape, np.int32))).all(axis=1)
    return index, inside


def carve(origin_m: np.ndarray, endpoints_m: np.ndarray, grid: config_lib.VoxelGrid) -> np.ndarray:
    """Marks the voxels that a ray passed through before it ended.

    The traversal is exact up to float32 rounding: between two neighbouring voxels a ray crosses one plane of the grid,
    so the voxel behind each crossed plane of each axis, and the voxel of the origin, are all the voxels it visits.

    Args:
      origin_m: [3] or [P, 3], where the rays start, ego frame, metres; it may lie outside the grid.
      endpoints_m: [P, 3], where they end.

    Returns:
      bool [X, Y, Z]. The voxel in which a ray ends is not marked by this ray (by another ray it may be).

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    ends = _in_voxels(endpoints_m, grid)
    origin_m = np.asarray(origin_m, np.float32)
    starts = np.broadcast_to(_in_voxels(np.atleast_2d(origin_m), grid), ends.shape)
    end_voxel = _flat_index(ends, grid)
    starts, ends, reaches = _clip_to_grid(starts, ends, grid)
    starts, ends, end_voxel = starts[:, reaches], ends[:, reaches], end_voxel[reaches]

    passed = np.zeros(int(np.prod(grid.shape)), bool)
    limit = np.asarray(grid.shape, np.float32)[:, None] - 1
    start_voxel = _flat_index(np.clip(starts, 0, limit), grid)
    passed[start_voxel[start_voxel != end_voxel]] = True
    for axis in range(3):
        passed[_entered_by_crossing(starts, ends, end_voxel, axis, grid)] = True
    return passed.reshape(grid.shape)


def occupancy_target(points_m: np.ndarray, ray_origins_m: np.ndarray, grid: config_lib.VoxelGrid, *,
                     free_points_m: np.ndarray | None = None, free_origins_m: np.ndarray | None = None,
                     ray_stride: int = 1) -> np.ndarray:
    """Builds the training target of a frame: what the sensors hit is occupied, what they looked through is empty.

    Args:
      points_m: [P, 3], all measured points, ego frame, metres.
      ray_origins_m: [3] or [P, 3], the sensor that measured each point.
      free_points_m: [Q, 3], ends of rays that returned nothing up to there (sky, maximum range).
      free_origins_m: [3] or [Q, 3]; by default `ray_origins_m`, which then must be one point.
      ray_stride: every n-th ray carves; all points occupy.

    Returns:
      uint8 [X, Y, Z]: 1 occupied (wins over empty), 0 empty, 255 unknown.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    occupied = voxelize(points_m, grid).astype(bool)
    empty = carve(_strided(ray_origins_m, ray_stride), np.asarray(points_m)[::ray_stride], grid)
    if free_points_m is not None and len(free_points_m):
        origins = ray_origins_m if free_origins_m is None else free_origins_m
        empty |= carve(_strided(origins, ray_stride), np.asarray(free_points_m)[::ray_stride], grid)
    return np.where(occupied, np.uint8(OCCUPIED), np.where(empty, np.uint8(EMPTY), np.uint8(UNKNOWN)))


def _number_and_distance(points_m: np.ndarray, grid: config_lib.VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Column-major number of the voxel around each point, -1 outside, and the squared distance to its lower corner.

    The distance of a point that is not finite is NaN.
    """
    number = np.zeros(len(points_m))  # whole, but as floats: far coordinates would overflow
    inside = np.ones(len(points_m), bool)
    to_corner = np.zeros(len(points_m))  # in voxels
    for axis in (2, 1, 0):
        place = points_m[:, axis] - np.float64(grid.origin_m[axis])
        place /= grid.voxel_size_m
        index = np.floor(place)
        inside &= (index >= 0) & (index < grid.shape[axis])
        with np.errstate(invalid="ignore"):
            place -= index
        place *= place
        to_corner += place
        number *= grid.shape[axis]
        number += index
    number[~inside] = -1
    return number.astype(np.intp), to_corner


def _strided(origins_m: np.ndarray, stride: int) -> np.ndarray:
    origins_m = np.asarray(origins_m, np.float32)
    return origins_m if origins_m.ndim == 1 else origins_m[::stride]


def _in_voxels(points_m: np.ndarray, grid: config_lib.VoxelGrid) -> np.ndarray:
    """Coordinates in units of voxels from the lower corner of the grid, one row per axis: float32 [3, P]."""
    points_m = range_view.check_points(points_m)
    corner = np.asarray(grid.origin_m, np.float32)[:, None]
    return (np.ascontiguousarray(points_m.T) - corner) * np.float32(1.0 / grid.voxel_size_m)


def _flat_index(coordinates: np.ndarray, grid: config_lib.VoxelGrid) -> np.ndarray:
    """Row-major number of the voxel around each of [3, P] coordinates, int32 [P], -1 outside the grid."""
    number = np.zeros(coordinates.shape[1], np.int32)
    inside = np.ones(coordinates.shape[1], bool)
    for axis, size in enumerate(grid.shape):
        inside &= (coordinates[axis] >= 0) & (coordinates[axis] < size)
        # Far coordinates would overflow; what is outside is masked in the end.
        number = number * np.int32(size) + np.clip(coordinates[axis], 0, size).astype(np.int32)
    return np.where(inside, number, -1)


def _clip_to_grid(starts: np.ndarray, ends: np.ndarray,
                  grid: config_lib.VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts segments (in voxels, [3, P]) to the box of the grid; the third result says which touch it at all, [P]."""
    size = np.asarray(grid.shape, np.float32)[:, None]
    direction = ends - starts
    safe = np.where(direction == 0, np.float32(1e-20), direction)
    with np.errstate(over="ignore"):
        at_low, at_high = -starts / safe, (size - starts) / safe
    enter = np.maximum(np.minimum(at_low, at_high).max(axis=0), 0)
    leave = np.minimum(np.maximum(at_low, at_high).min(axis=0), 1)
    clipped_starts = np.where(enter > 0, starts + direction * enter, starts)
    clipped_ends = np.where(leave < 1, starts + direction * leave, ends)
    return clipped_starts, clipped_ends, enter < leave


def _entered_by_crossing(starts: np.ndarray, ends: np.ndarray, end_voxel: np.ndarray, axis: int,
                         grid: config_lib.VoxelGrid) -> np.ndarray:
    """Numbers of the voxels that rays enter through grid planes perpendicular to `axis`, end voxels left out."""
    strides = (grid.shape[1] * grid.shape[2], grid.shape[2], 1)
    first, last = (np.clip(np.floor(side[axis]), 0, grid.shape[axis] - 1).astype(np.int32)
                   for side in (starts, ends))
    crosses = first != last
    starts, ends, first, last = starts[:, crosses], ends[:, crosses], first[crosses], last[crosses]
    moving = ends[axis] - starts[axis]
    sign = np.sign(last - first).astype(np.int32)
    count = np.abs(last - first)
    step = np.arange(count.sum(), dtype=np.int32) - np.repeat(np.cumsum(count, dtype=np.int32) - count, count)
    # The plane between voxels k and k+1 lies at k+1; what follows is anchored at the first plane each ray crosses.
    to_plane = (first + (sign > 0)).astype(np.float32) - starts[axis]
    step_float, sign_float = step.astype(np.float32), sign.astype(np.float32)
    number = (np.repeat(first + sign, count) + np.repeat(sign, count) * step) * np.int32(strides[axis])
    for other in range(3):
        if other == axis:
            continue
        slope = (ends[other] - starts[other]) / moving
        anchor = starts[other] + to_plane * slope
        index = (np.repeat(anchor, count) + np.repeat(sign_float * slope, count) * step_float).astype(np.int32)
        number += np.clip(index, 0, grid.shape[other] - 1) * np.int32(strides[other])
    return number[number != np.repeat(end_voxel[crosses], count)]
