"""Lidar points as a cylindrical image and back (host side, NumPy), with the projection of the reference's data tools.

Column floor((1 - yaw / pi) / 2 * columns): the middle looks forward and columns grow to the right. Row
floor((1 - (elevation - min) / (max - min)) * rows): row 0 looks highest. Unlike the reference, which turns a range
image back into points at pixel corners, `beam_directions` are pixel centres; `to_points` needs no directions because
the image stores x, y and z.
"""

from __future__ import annotations

import numpy as np

from muvo_jax import config as config_lib

NO_RETURN_M = -1.0


def check_points(points_m: np.ndarray, name: str = "points_m") -> np.ndarray:
    """Returns the points as float32 [P, 3].

    Raises:
      ValueError: for another shape, or where a coordinate is NaN or infinite (nothing is dropped in silence).
    """
    points_m = np.asarray(points_m, dtype=np.float32)
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ValueError(f"{name}: got shape {points_m.shape}, expected [points, 3] (x, y, z in metres).")
    if not np.isfinite(points_m).all():
        finite = np.isfinite(points_m).all(axis=1)
        raise ValueError(f"{name}: {int((~finite).sum())} of {len(points_m)} points are NaN or infinite (the first is "
                         f"point {int(np.argmin(finite))}); remove them before projecting, as in "
                         f"points[np.isfinite(points).all(axis=1)].")
    return points_m


def project(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Projects points [P, 3] (ego frame, m) into a range view, the nearest point of a pixel winning.

    Points above or below the field of view go into the edge rows, as in the reference; a point exactly at the lidar has
    no direction and is left out.

    Returns:
      float32 [rows, columns, 4]: x, y, z (ego frame, m) and range from the lidar (m); 0, 0, 0, -1 where empty.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    points_m = check_points(points_m)
    # In float64: two points on one ring of flat ground differ in range by less than float32 tells, and one must win.
    relative_m = points_m - np.asarray(geometry.position_m, np.float64)[None]
    range_m = np.sqrt(np.einsum("pc,pc->p", relative_m, relative_m))
    here = range_m > 0
    points_m, relative_m, range_m = points_m[here], relative_m[here], range_m[here]

    x, y, z = relative_m.astype(np.float32).T
    yaw_rad = np.arctan2(y, x)
    elevation_rad = np.arcsin(np.clip(z / range_m.astype(np.float32), -1.0, 1.0))
    span_rad = geometry.elevation_max_rad - geometry.elevation_min_rad
    column = np.floor(0.5 * (1.0 - yaw_rad / np.float32(np.pi)) * geometry.columns).astype(np.int64)
    row = np.floor((1.0 - (elevation_rad - geometry.elevation_min_rad) / span_rad) * geometry.rows).astype(np.int64)
    pixel = (np.clip(row, 0, geometry.rows - 1) * geometry.columns + np.clip(column, 0, geometry.columns - 1))

    image = np.zeros((geometry.rows * geometry.columns, 4), np.float32)
    image[:, 3] = NO_RETURN_M
    # NumPy keeps the last of repeated assignments, so the nearest point comes last.
    order = np.argsort(-range_m, kind="stable")
    image[pixel[order], :3] = points_m[order]
    image[pixel[order], 3] = range_m[order]
    return image.reshape(geometry.rows, geometry.columns, 4)


def to_points(range_view: np.ndarray, threshold_m: float = 0.0) -> np.ndarray:
    """Returns the xyz (ego frame, m) of all pixels whose range exceeds `threshold_m`, float32 [P, 3], row by row."""
    return np.ascontiguousarray(range_view[range_view[..., 3] > threshold_m][:, :3], dtype=np.float32)


def beam_directions(geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Returns the unit vectors (ego axes) through the pixel centres, float32 [rows, columns, 3]."""
    yaw_rad, elevation_rad = beam_angles(geometry)
    flat = np.cos(elevation_rad)[:, None]
    return np.stack([flat * np.cos(yaw_rad)[None], flat * np.sin(yaw_rad)[None],
                     np.broadcast_to(np.sin(elevation_rad)[:, None], (geometry.rows, geometry.columns))],
                    axis=-1).astype(np.float32)


def beam_angles(geometry: config_lib.RangeViewGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Returns the yaw of each column (left positive) and the elevation of each row, in radians, at pixel centres."""
    yaw_rad = np.pi * (1.0 - 2.0 * (np.arange(geometry.columns) + 0.5) / geometry.columns)
    share = 1.0 - (np.arange(geometry.rows) + 0.5) / geometry.rows
    elevation_rad = geometry.elevation_min_rad + share * (geometry.elevation_max_rad - geometry.elevation_min_rad)
    return yaw_rad, elevation_rad
