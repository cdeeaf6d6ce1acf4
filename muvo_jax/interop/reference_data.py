"""What the reference's data tools do and this library does not need, for parity (NumPy)."""

from __future__ import annotations

import numpy as np

from muvo_jax import config as config_lib

ROUTE_CHANNEL = 1
LIGHT_CHANNEL, LIGHT_VALUES = 14, (80, 170, 255)  # green, yellow, red
_MASK_CHANNELS = (0, 2, 6, 10)  # road, lane marking, vehicles and pedestrians of the newest time step
_EARTH_RADIUS_M = 6378137.0
_COMMANDS_WITHOUT = 4  # what a negative command counts as: follow the lane
_HISTOGRAM_CELLS, _HISTOGRAM_CELL_M, _HISTOGRAM_FULL = (384, 384, 128), 0.1, 5
_EV_CELL_M = 0.2
# Two axes of a map; the axis that parts the points in three; where; whether the third that lies highest comes first.
_HISTOGRAMS = {"xy": (0, 1, 2, (0.0, 2.5), False), "xz": (0, 2, 1, (-1.5, 1.5), True),
               "yz": (1, 2, 0, (-2.5, 10.0), False)}


def pixel_corner_points(range_m: np.ndarray, geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Range view [..., rows, columns] in metres to points and range [..., rows, columns, 4], ego frame.

    The rays pass through the upper left corners of the pixels.
    """
    rows, columns = range_m.shape[-2:]
    yaw = np.pi * (1.0 - 2.0 * np.arange(columns) / columns)
    span = geometry.elevation_max_rad - geometry.elevation_min_rad
    elevation = (geometry.elevation_max_rad - span * np.arange(rows) / rows)[:, None]
    x, y, z = geometry.position_m
    return np.stack([range_m * np.cos(elevation) * np.cos(yaw) + x, range_m * np.cos(elevation) * np.sin(yaw) + y,
                     range_m * np.sin(elevation) + z, range_m], axis=-1)


def histograms(points_m: np.ndarray, ego_cell: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Counts of points in three planes, {"xy": [4, 384, 384], "xz" and "yz": [4, 384, 128]}; 5 points give 1.

    The first three channels hold the points of one third of the remaining axis each, the last one their sum.

    Args:
      points_m: [P, 3], ego frame.
      ego_cell: where the ego stands in the grid, in cells of 0.2 m.
    """
    edges = [np.linspace(-cell * _EV_CELL_M, -cell * _EV_CELL_M + cells * _HISTOGRAM_CELL_M, cells + 1)
             for cell, cells in zip(ego_cell, _HISTOGRAM_CELLS, strict=True)]
    out = {}
    for name, (first, second, other, (low, high), reverse) in _HISTOGRAMS.items():
        where = points_m[:, other]
        thirds = [where <= low, (where > low) & (where <= high), where > high]
        counts = np.stack([np.histogram2d(points_m[third, first], points_m[third, second],
                                          bins=(edges[first], edges[second]))[0]
                           for third in (reversed(thirds) if reverse else thirds)])
        shares = np.minimum(counts, _HISTOGRAM_FULL) / _HISTOGRAM_FULL
        out[name] = np.concatenate([shares, shares.sum(axis=0, keepdims=True)]).astype(np.float32)
    return out


def to_bits(numbers: np.ndarray, bits: int) -> np.ndarray:
    """Integers [...] to float32 [..., bits], the lowest bit first."""
    return (numbers[..., None] >> np.arange(bits) & 1).astype(np.float32)


def from_bits(bits: np.ndarray) -> np.ndarray:
    """The inverse of `to_bits`, int32."""
    return (bits.astype(np.int64) << np.arange(bits.shape[-1])).sum(axis=-1).astype(np.int32)


def birdview_classes(masks: np.ndarray, axis: int = 0) -> np.ndarray:
    """The last class of `axis` that is set in each pixel: lights over road users over markings over road."""
    return masks.shape[axis] - 1 - np.argmax(np.flip(masks, axis), axis=axis)


def birdview_masks(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The simulator's bird's-eye view, uint8 [T, 15, H, W], to masks float32 [T, 8, H, W] and the route, [T, H, W]."""
    masks = [raw[:, channel] == 255 for channel in _MASK_CHANNELS]
    masks += [raw[:, LIGHT_CHANNEL] == value for value in LIGHT_VALUES]
    stacked = np.stack([~np.any(masks, axis=0), *masks], axis=1)
    return stacked.astype(np.float32), raw[:, ROUTE_CHANNEL]


def command_index(command: int) -> int:
    """The simulator's route command (from 1; negative: none) as an index from 0."""
    return (command if command >= 0 else _COMMANDS_WITHOUT) - 1


def gps_vector(position: np.ndarray, target: np.ndarray, compass_rad: float) -> np.ndarray:
    """From a position to a target, both (latitude, longitude, ...) in degrees: float32 [2], metres ahead and right.

    Args:
      compass_rad: heading, clockwise from north; NaN counts as 0.
    """
    east = _EARTH_RADIUS_M * np.deg2rad(target[1] - position[1])
    north_of = lambda latitude: _EARTH_RADIUS_M * np.log(np.tan(np.deg2rad(90.0 + latitude) / 2.0))
    north = north_of(target[0]) - north_of(position[0])
    heading = 0.0 if np.isnan(compass_rad) else compass_rad
    sine, cosine = np.sin(heading), np.cos(heading)
    return np.array([cosine * north + sine * east, cosine * east - sine * north], np.float32)
