"""The plain forms that data.py compares with: how a direct transcription of the reference's data tools reads."""

from __future__ import annotations

import numpy as np

from muvo_jax import config as config_lib


def project(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Range view in float64: angles, a full sort by range, assignment from the farthest to the nearest point."""
    points_m = np.asarray(points_m, np.float64)
    relative_m = points_m - np.asarray(geometry.position_m)[None]
    range_m = np.linalg.norm(relative_m, axis=1)
    yaw_rad = np.arctan2(relative_m[:, 1], relative_m[:, 0])
    pitch_rad = np.arcsin(relative_m[:, 2] / range_m)
    span_rad = geometry.elevation_max_rad - geometry.elevation_min_rad
    column = np.floor(0.5 * (1.0 - yaw_rad / np.pi) * geometry.columns)
    row = np.floor((1.0 - (pitch_rad - geometry.elevation_min_rad) / span_rad) * geometry.rows)
    column = np.clip(column, 0, geometry.columns - 1).astype(np.int32)
    row = np.clip(row, 0, geometry.rows - 1).astype(np.int32)
    order = np.argsort(range_m)[::-1]
    image = np.zeros((geometry.rows, geometry.columns, 4), np.float32)
    image[..., 3] = -1.0
    image[row[order], column[order], :3] = points_m[order]
    image[row[order], column[order], 3] = range_m[order]
    return image


def voxel_table(points_m: np.ndarray, tags: np.ndarray, grid: config_lib.VoxelGrid, winning_tag: int) -> np.ndarray:
    """Rows (ix, iy, iz, tag) of the occupied voxels, one voxel after the other."""
    shifted_m = np.asarray(points_m, np.float64) - np.asarray(grid.origin_m)[None]
    inside = ((shifted_m >= 0) & (shifted_m < np.asarray(grid.shape) * grid.voxel_size_m)).all(axis=1)
    shifted_m, tags = shifted_m[inside], tags[inside]
    index = np.floor(shifted_m / grid.voxel_size_m).astype(np.int64)
    columns, rows, _ = grid.shape
    number = index[:, 0] + columns * index[:, 1] + columns * rows * index[:, 2]
    order = np.argsort(number)
    number, shifted_m, tags, index = number[order], shifted_m[order], tags[order], index[order]
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    table = []
    for start, stop in zip(starts, [*starts[1:], len(number)], strict=True):
        here = tags[start:stop]
        if (here == winning_tag).any():
            tag = winning_tag
        else:
            corner_m = index[start] * grid.voxel_size_m
            tag = here[np.argmin(np.linalg.norm(shifted_m[start:stop] - corner_m, axis=1))]
        table.append((*index[start], tag))
    return np.array(table, np.uint16).reshape(-1, 4)
