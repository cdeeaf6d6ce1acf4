"""Whether lidar and camera see the same edges at the same place: a shift in pixels, found without any labels.

Where a scan jumps from near to far, the picture usually has an edge. The projected jumps are moved over the picture's
gradient; where the two fit best, the shift should be zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from muvo_jax import config as config_lib
from muvo_jax.data import schema
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops

_JUMP_RATIO, _JUMP_M = 1.15, 1.0
_NEAREST_M, _FARTHEST_M = 3.0, 50.0
_BLUR_PX = 1.0
SEARCH = 0.04  # of the image width, to each side
_COLUMNS_PX = 480  # wider pictures are looked at in this width
_FEWEST_EDGES, _LEAST_CONTRAST = 1000, 1.2
_FILL, _FEWEST_COLUMNS = 0.3, 128


class Alignment(NamedTuple):
    """Attributes:
      right_px, down_px: how far the projected lidar would have to move in the recorded picture; NaN where unknown.
      gain: how much better than unmoved it would fit, 1 where no better.
      contrast: fit at the best place over the fit at all places; near 1 where nothing can be said.
      edges: how many jumps were used.
      at_border: whether the best place was the farthest looked at.
    """

    right_px: float
    down_px: float
    gain: float
    contrast: float
    edges: int
    at_border: bool = False

    @property
    def is_known(self) -> bool:
        return self.edges >= _FEWEST_EDGES and self.contrast > _LEAST_CONTRAST and not self.at_border


def measure(frames: Iterable[schema.RawFrame], lidar: config_lib.RangeViewGeometry) -> Alignment:
    """Compares the edges of scans and pictures, summed over frames (some ten, in different places)."""
    total: np.ndarray | None = None
    edges, scale = 0, 1.0
    for frame in frames:
        picture = frame["image"].mean(axis=2)
        scale = min(1.0, _COLUMNS_PX / picture.shape[1])
        reach = max(2, round(SEARCH * picture.shape[1] * scale))
        picture = scipy.ndimage.zoom(picture, scale, order=1) if scale < 1 else picture
        beside, above = jumps(frame["points_m"], _filled(lidar, len(frame["points_m"])))
        for points_m, axis in ((beside, 1), (above, 0)):
            place, _ = camera_ops.project_to_image(points_m, frame["intrinsics"], frame["camera_to_ego"])
            fit, count = _fit(picture, place * scale, axis, reach)
            total = fit if total is None else total + fit
            edges += count
    if total is None or not edges:
        return Alignment(np.nan, np.nan, 1.0, 1.0, 0)
    reach = total.shape[0] // 2
    down, right = np.unravel_index(int(total.argmax()), total.shape)
    unmoved = float(total[reach, reach])
    best = float(total.max())
    return Alignment(float((right - reach) / scale), float((down - reach) / scale), best / max(unmoved, 1e-9),
                     best / max(float(np.median(total)), 1e-9), edges,
                     down in (0, 2 * reach) or right in (0, 2 * reach))


def _filled(lidar: config_lib.RangeViewGeometry, points: int) -> config_lib.RangeViewGeometry:
    """With so few columns that a thin scan still fills neighbouring pixels."""
    columns = lidar.columns
    while points < _FILL * lidar.rows * columns and columns > _FEWEST_COLUMNS:
        columns //= 2
    return dataclasses.replace(lidar, columns=columns)


def jumps(points_m: np.ndarray, lidar: config_lib.RangeViewGeometry) -> tuple[np.ndarray, np.ndarray]:
    """The near sides of jumps in range: from one column to the next (left and right edges), and to the row above."""
    view = range_view_ops.project(points_m, lidar)
    range_m = np.where(view[..., 3] > 0, view[..., 3], np.nan)
    near = (range_m > _NEAREST_M) & (range_m < _FARTHEST_M)
    limit = range_m * _JUMP_RATIO + _JUMP_M
    with np.errstate(invalid="ignore"):
        left, right = np.roll(range_m, 1, axis=1), np.roll(range_m, -1, axis=1)
        beside = near & ((left > limit) | (right > limit))
        above = np.zeros_like(near)
        above[1:] = near[1:] & (range_m[:-1] > limit[1:])
    return view[beside][:, :3], view[above][:, :3]


def _fit(picture: np.ndarray, place_px: np.ndarray, axis: int, reach: int) -> tuple[np.ndarray, int]:
    """Mean gradient along `axis` under the points, for every shift up to `reach`: [down, right], and how many points.

    The gradient is measured against its mean, and its largest values are capped, lest one strong edge decide.
    """
    gradient = np.abs(scipy.ndimage.gaussian_filter1d(scipy.ndimage.gaussian_filter(picture, _BLUR_PX), 1.0, axis=axis,
                                                      order=1))
    gradient = np.minimum(gradient / max(float(gradient.mean()), 1e-9), 4.0)
    height, width = gradient.shape
    with np.errstate(invalid="ignore"):
        column, row = np.floor(place_px[:, 0]), np.floor(place_px[:, 1])
        inside = (column >= reach) & (column < width - reach) & (row >= reach) & (row < height - reach)
    column, row = column[inside].astype(int), row[inside].astype(int)
    side = 2 * reach + 1
    if not len(column):
        return np.zeros((side, side)), 0
    hits = np.zeros_like(gradient)
    np.add.at(hits, (row, column), 1.0)
    fit = np.empty((side, side))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            window = gradient[reach + down:height - reach + down, reach + right:width - reach + right]
            fit[down + reach, right + reach] = (hits[reach:height - reach, reach:width - reach] * window).sum()
    return fit, len(column)
