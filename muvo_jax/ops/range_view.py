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
BLOCK_POINTS = 16384  # work on this many at once stays in the processor's cache
# Above the error of float32 angles in pixels: 4e-7 rad times columns / (2 pi) or rows / (field of view).
_EDGE_PX = 2e-3


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
    nearest = _nearest(points_m, geometry)
    image = np.zeros((len(nearest.winner), 4), np.float32)
    image[:, 3] = NO_RETURN_M
    hit = np.flatnonzero(nearest.winner >= 0)
    image[hit, :3] = points_m.take(nearest.winner[hit], axis=0)
    image[hit, 3] = nearest.least[hit]
    return image.reshape(geometry.rows, geometry.columns, 4)


def nearest_points(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Returns the number of the point that `project` shows in each pixel, int32 [rows, columns], -1 where empty.

    It gathers whatever else belongs to the points, such as their classes. Of points at exactly one distance the last
    wins.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    return _nearest(check_points(points_m), geometry).winner.reshape(geometry.rows, geometry.columns)


def pixels_of(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Where `project` puts each of the points [P, 3] (ego frame, m).

    Returns:
      The number of its pixel, row by row, intp [P], -1 for a point exactly at the lidar; and its range, float64 [P], m.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    points_m = check_points(points_m)
    pixel, range_m = np.empty(len(points_m), np.intp), np.empty(len(points_m))
    _fill_pixels(points_m, geometry, pixel, range_m)
    return pixel, range_m


class NearestOfCells:
    """The nearest point of each cell, of points that come in blocks; of equals the last wins.

    Attributes:
      winner: int32 [cells], number of the point, -1 where a cell has none.
      least: float64 [cells], its distance; infinite where a cell has none.
    """

    def __init__(self, cells: int):
        # The last place belongs to the points of cell -1.
        self._winner, self._least = np.full(cells + 1, -1, np.int32), np.full(cells + 1, np.inf)

    @property
    def winner(self) -> np.ndarray:
        return self._winner[:-1]

    @property
    def least(self) -> np.ndarray:
        return self._least[:-1]

    def add(self, cell: np.ndarray, distance: np.ndarray, first: int = 0) -> None:
        """Takes in a block.

        Args:
          cell: intp [P] in [0, cells), or -1 for a point that counts for nothing.
          distance: float64 [P], or anything that grows with it.
          first: number of its first point.
        """
        np.minimum.at(self._least, cell, distance)  # a quarter of the time that sorting takes
        nearest = np.flatnonzero(distance == self._least[cell])
        self._winner[cell[nearest]] = nearest + first  # NumPy keeps the last of repeated assignments


def _nearest(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> NearestOfCells:
    """By pixel, with ranges in m."""
    nearest = NearestOfCells(geometry.rows * geometry.columns)
    for start in range(0, len(points_m), BLOCK_POINTS):
        block = points_m[start:start + BLOCK_POINTS]
        pixel, range_m = np.empty(len(block), np.intp), np.empty(len(block))
        _fill_pixels(block, geometry, pixel, range_m)
        nearest.add(pixel, range_m, start)
    return nearest


def _fill_pixels(points_m: np.ndarray, geometry: config_lib.RangeViewGeometry, pixel: np.ndarray,
                 range_m: np.ndarray) -> None:
    """Writes the pixel (-1 for a point at the lidar) and the range of each point."""
    # In float64: two points on one ring of flat ground differ in range by less than float32 tells, and one must win.
    x, y, z = (points_m[:, axis] - np.float64(geometry.position_m[axis]) for axis in range(3))
    np.sqrt(x * x + y * y + z * z, out=range_m)
    image = np.stack(_image_coordinates(x.astype(np.float32), y.astype(np.float32), z.astype(np.float32), geometry))
    whole = np.floor(image)
    # float32 angles decide all but the points at the edge of a pixel, which are taken again in float64.
    at_edge = np.abs(image - whole - np.float32(0.5)) > np.float32(0.5 - _EDGE_PX)
    edge = np.flatnonzero(at_edge[0] | at_edge[1])
    whole[:, edge] = np.floor(_image_coordinates(x[edge], y[edge], z[edge], geometry))
    row, column = whole.astype(np.int32)
    row = np.minimum(np.maximum(row, 0), geometry.rows - 1)
    np.add(row * np.int32(geometry.columns), np.minimum(np.maximum(column, 0), geometry.columns - 1), out=pixel)
    pixel[range_m == 0] = -1


def _image_coordinates(x: np.ndarray, y: np.ndarray, z: np.ndarray,
                       geometry: config_lib.RangeViewGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Continuous (row, column) of points relative to the lidar, in their dtype."""
    elevation_rad = np.arctan2(z, np.sqrt(x * x + y * y))
    span_rad = geometry.elevation_max_rad - geometry.elevation_min_rad
    row = (1.0 - (elevation_rad - geometry.elevation_min_rad) / span_rad) * geometry.rows
    return row, 0.5 * (1.0 - np.arctan2(y, x) / np.pi) * geometry.columns


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
