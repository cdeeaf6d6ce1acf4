"""Whether lidar and camera see the same edges at the same place: a shift in pixels, found without any labels.

Where a scan jumps from near to far, the picture usually has an edge, somewhere between the last near beam and the first
far one. These gaps, projected, are moved over the picture's gradient; where the two fit best, the shift should be zero.
Only what stands above the ground counts: on the road the rings of a scan lie as far apart as edges, and show none.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.signal

from muvo_jax import config as config_lib
from muvo_jax.data import schema
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops

_JUMP_RATIO, _JUMP_M = 1.15, 1.0
_NEAREST_M, _FARTHEST_M = 3.0, 50.0
_CLEARANCE_M, _GROUND_CELL_M = 0.6, 3.0  # what is lower, over the lowest point nearby, is ground
_GROUND_FARTHEST_M = 1000.0  # no lidar's; the ground is looked up in a table that such points would make too large
_BLUR_PX = 1.0
SEARCH, _SEARCH_ROWS = 0.04, 2.5  # to each side: of the image width, but at least so many rows of the lidar,
_MOST_SEARCHED = 0.2  # and no more of the image's shorter side
_COLUMNS_PX = 480  # wider pictures are looked at in this width
_STRONGEST = 4.0  # of the mean gradient nearby: more counts for no more, lest one strong edge decide
_FEWEST_EDGES, _LEAST_CONTRAST = 200, 1.1
_AGREE_PX = 4.0
_FILL, _FEWEST_COLUMNS = 0.3, 128
_ROWS_ABOVE = 2  # of beams, for sky to be sky: the highest ones end at another height in each direction
_SAMPLES = 12  # of a gap between two beams
_DRAWS, _SEED = 100, 0  # of frames, for the spread


class Alignment(NamedTuple):
    """Attributes:
      right_px, down_px: how far the projected lidar would have to move in the recorded picture, in its middle where
        `is_turn`; NaN where unknown.
      gain: how much better than unmoved it would fit, 1 where no better.
      contrast: fit at the best place over the fit at all places; near 1 where nothing can be said.
      edges: how many jumps were used.
      is_turn: whether a turn of the camera fits better than a shift of all pixels.
      row_px, column_px: from one beam of the lidar to the next in the recorded picture, as the scans have them.
      spread_px: how far (right, down) the best places of other draws of the frames lie, four in five of them nearer.
      at_border: whether the best place was the farthest looked at.
    """

    right_px: float
    down_px: float
    gain: float
    contrast: float
    edges: int
    is_turn: bool = False
    row_px: float = np.nan
    column_px: float = np.nan
    spread_px: tuple[float, float] = (np.inf, np.inf)
    at_border: bool = False

    @property
    def is_known(self) -> bool:
        """Whether there are edges enough, and draws of the frames agree within a beam or some pixels."""
        agree = (self.spread_px[0] <= max(self.column_px, _AGREE_PX)
                 and self.spread_px[1] <= max(self.row_px, _AGREE_PX))
        return self.edges >= _FEWEST_EDGES and self.contrast > _LEAST_CONTRAST and agree and not self.at_border


class Gaps(NamedTuple):
    """Between the last near beam and the first far one, at the near one's range.

    Attributes: (both ends of each gap as float32 [N, 2, 3], ego frame)
      beside: between columns (the left and right edges of things).
      above: between rows (their upper edges, before something farther or the sky).
      row_rad, column_rad: the usual angle between beams.
    """

    beside: np.ndarray
    above: np.ndarray
    row_rad: float
    column_rad: float


class _Look(NamedTuple):
    """How the frames of a recording are compared: picture scale, shifts to each side, angles between beams."""

    scale: float
    reach_px: int
    row_rad: float
    column_rad: float


def measure(frames: Iterable[schema.RawFrame], lidar: config_lib.RangeViewGeometry) -> Alignment:
    """Compares the edges of scans and pictures, summed over frames (some ten, in different places)."""
    look: _Look | None = None
    fits: list[np.ndarray] = []  # [2, side, side]: shifts of pixels, turns
    edges, focal_px = 0, 1.0
    for frame in frames:
        gaps = find_gaps(frame["points_m"], _filled(lidar, len(frame["points_m"])))
        focal_px = float(frame["intrinsics"][0, 0])
        look = look or _look(frame, gaps)
        fit, count = _fit_frame(frame, gaps, look)
        fits.append(fit)
        edges += count
    if look is None or not edges:
        return Alignment(np.nan, np.nan, 1.0, 1.0, 0)
    stack = np.stack(fits)
    total, middle = stack.sum(axis=0), np.maximum(np.median(stack.sum(axis=0), axis=(1, 2)), 1e-9)
    contrast = total.max(axis=(1, 2)) / middle
    kind = int(contrast[1] > contrast[0])
    total, reach, scale = total[kind], look.reach_px, look.scale
    down, right = _best(total)
    rng = np.random.default_rng(_SEED)
    draws = [_best(stack[rng.integers(len(stack), size=len(stack)), kind].sum(axis=0)) for _ in range(_DRAWS)]
    spread = np.quantile(np.abs(np.array(draws) - [down, right]), 0.8, axis=0) / scale
    return Alignment(
        (right + _summit(total[down], right) - reach) / scale, (down + _summit(total[:, right], down) - reach) / scale,
        float(total[down, right] / max(total[reach, reach], 1e-9)), float(contrast[kind]), edges, bool(kind),
        look.row_rad * focal_px, look.column_rad * focal_px, (float(spread[1]), float(spread[0])),
        down in (0, 2 * reach) or right in (0, 2 * reach))


def _look(frame: schema.RawFrame, gaps: Gaps) -> _Look:
    height_px, width_px = frame["image"].shape[:2]
    scale = min(1.0, _COLUMNS_PX / width_px)
    rows_px = _SEARCH_ROWS * gaps.row_rad * float(frame["intrinsics"][0, 0])
    wanted_px = max(SEARCH * width_px, rows_px if np.isfinite(rows_px) else 0.0)
    reach_px = max(2, round(min(wanted_px, _MOST_SEARCHED * min(height_px, width_px)) * scale))
    return _Look(scale, reach_px, gaps.row_rad, gaps.column_rad)


def _best(fit: np.ndarray) -> tuple[int, int]:
    down, right = np.unravel_index(int(fit.argmax()), fit.shape)
    return int(down), int(right)


def _summit(fits: np.ndarray, best: int) -> float:
    """How far beside the best of some values the top of the parabola through it and its neighbours lies."""
    if not 0 < best < len(fits) - 1:
        return 0.0
    before, here, after = map(float, fits[best - 1:best + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _filled(lidar: config_lib.RangeViewGeometry, points: int) -> config_lib.RangeViewGeometry:
    """With so few columns that a thin scan still fills neighbouring pixels."""
    columns = lidar.columns
    while points < _FILL * lidar.rows * columns and columns > _FEWEST_COLUMNS:
        columns //= 2
    return dataclasses.replace(lidar, columns=columns)


def find_gaps(points_m: np.ndarray, lidar: config_lib.RangeViewGeometry) -> Gaps:
    """Where a scan jumps from near to far, above the ground; rows that no beam hits (a thinned scan) are skipped."""
    view = range_view_ops.project(points_m, lidar)
    view = view[(view[..., 3] > 0).mean(axis=1) > 0.02]  # rows that hold beams
    range_m = np.where(view[..., 3] > 0, view[..., 3], np.nan)
    lidar_m = np.asarray(lidar.position_m, np.float32)
    with np.errstate(invalid="ignore"):
        standing = (range_m > _NEAREST_M) & (range_m < _FARTHEST_M) & (_clearance(view) > _CLEARANCE_M)
    direction = (view[..., :3] - lidar_m) / np.where(view[..., 3:] > 0, view[..., 3:], np.nan)
    elevation_rad = np.arcsin(direction[..., 2])
    rows_rad = np.nanmedian(elevation_rad, axis=1) if len(view) else np.zeros(0)
    row_rad = float(np.median(-np.diff(rows_rad))) if len(view) > 1 else np.nan
    limit_m = range_m * _JUMP_RATIO + _JUMP_M
    beside = []
    for step in (-1, 1):
        other_m, other = np.roll(range_m, step, axis=1), np.roll(direction, step, axis=1)
        with np.errstate(invalid="ignore"):
            jump = standing & (other_m > limit_m)
        beside.append(_ends(view, direction, other, jump, lidar_m))
    above_m, above = _next_above(range_m, direction, row_rad)
    with np.errstate(invalid="ignore"):
        jump = standing & (above_m > limit_m)
    return Gaps(np.concatenate(beside), _ends(view, direction, above, jump, lidar_m), row_rad,
                2 * math.pi / lidar.columns)


def _ends(view: np.ndarray, near: np.ndarray, far: np.ndarray, jump: np.ndarray, lidar_m: np.ndarray) -> np.ndarray:
    reach_m = view[jump][:, 3:]
    return np.stack([lidar_m + near[jump] * reach_m, lidar_m + far[jump] * reach_m], axis=1).astype(np.float32)


def _next_above(range_m: np.ndarray, direction: np.ndarray, row_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Range and direction of the next return above in each column; infinite, one row up, where there is only sky."""
    next_m, towards = np.full_like(range_m, np.nan), np.full_like(direction, np.nan)
    seen_m = np.full(range_m.shape[1], np.inf)  # by column, of the rows above
    seen = np.full((range_m.shape[1], 3), np.nan, direction.dtype)
    for row in range(len(range_m)):
        if row >= _ROWS_ABOVE:
            here = direction[row]
            sky = np.isinf(seen_m)
            flat = np.hypot(here[:, 0], here[:, 1])
            angle_rad = np.arctan2(here[:, 2], flat) + row_rad
            up = np.stack([here[:, 0] / flat * np.cos(angle_rad), here[:, 1] / flat * np.cos(angle_rad),
                           np.sin(angle_rad)], axis=1)
            next_m[row], towards[row] = seen_m, np.where(sky[:, None], up, seen)
        valid = np.isfinite(range_m[row])
        seen_m, seen = np.where(valid, range_m[row], seen_m), np.where(valid[:, None], direction[row], seen)
    return next_m, towards


def _clearance(view: np.ndarray) -> np.ndarray:
    """[rows, columns]: height of a pixel's point over the lowest within some metres, NaN where there is none."""
    valid = (view[..., 3] > 0) & (np.abs(view[..., :2]) < _GROUND_FARTHEST_M).all(axis=-1)
    points_m = view[valid][:, :3]
    heights_m = np.full(view.shape[:2], np.nan)
    if not len(points_m):
        return heights_m
    cell = np.floor(points_m[:, :2] / _GROUND_CELL_M).astype(int)
    cell -= cell.min(axis=0)
    lowest_m = np.full(cell.max(axis=0) + 1, np.inf)
    np.minimum.at(lowest_m, tuple(cell.T), points_m[:, 2])
    lowest_m = scipy.ndimage.minimum_filter(lowest_m, size=3, mode="nearest")
    heights_m[valid] = points_m[:, 2] - lowest_m[tuple(cell.T)]
    return heights_m


def _fit_frame(frame: schema.RawFrame, gaps: Gaps, look: _Look) -> tuple[np.ndarray, int]:
    """Fits [2, down, right] of one frame, flat and on a cylinder about the camera, and the number of gaps."""
    picture = frame["image"].mean(axis=2)
    picture = scipy.ndimage.zoom(picture, look.scale, order=1) if look.scale < 1 else picture
    intrinsics = np.array(frame["intrinsics"], np.float64)
    intrinsics[:2] *= look.scale
    rolled = _roll_up(picture, intrinsics)
    fits, count = np.zeros((2, 2 * look.reach_px + 1, 2 * look.reach_px + 1)), 0
    for ends_m, axis in ((gaps.beside, 1), (gaps.above, 0)):
        ends_px, _ = camera_ops.project_to_image(ends_m.reshape(-1, 3), intrinsics, frame["camera_to_ego"])
        for kind, (surface, places_px) in enumerate(((picture, ends_px), (rolled, _on_cylinder(ends_px, intrinsics)))):
            fit, found = _fit(surface, places_px.reshape(-1, 2, 2), axis, look.reach_px)
            fits[kind] += fit
            count += found * (kind == 0)
    return fits, count


def _roll_up(picture: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """The picture on a cylinder of one focal length, upright through the camera: there a turn moves all alike."""
    focal_px, middle_px = intrinsics[0, 0], intrinsics[:2, 2]
    height, width = picture.shape
    row, column = np.mgrid[:height, :width] + 0.5
    yaw_rad = (column - middle_px[0]) / focal_px
    with np.errstate(over="ignore", invalid="ignore"):
        source_column = middle_px[0] + focal_px * np.tan(np.clip(yaw_rad, -1.5, 1.5))
        source_row = middle_px[1] + (row - middle_px[1]) / np.cos(np.clip(yaw_rad, -1.5, 1.5))
    return scipy.ndimage.map_coordinates(picture, [source_row - 0.5, source_column - 0.5], order=1, mode="nearest")


def _on_cylinder(places_px: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Where places [N, 2] of the flat picture lie on it."""
    focal_px, middle_px = intrinsics[0, 0], intrinsics[:2, 2]
    yaw_rad = np.arctan((places_px[:, 0] - middle_px[0]) / focal_px)
    return np.stack([middle_px[0] + focal_px * yaw_rad,
                     middle_px[1] + (places_px[:, 1] - middle_px[1]) * np.cos(yaw_rad)], axis=1)


def _fit(picture: np.ndarray, ends_px: np.ndarray, axis: int, reach: int) -> tuple[np.ndarray, int]:
    """Sum of the gradient along `axis` over the gaps [N, 2, 2], for every shift up to `reach`, and how many gaps."""
    side = 2 * reach + 1
    height, width = picture.shape
    with np.errstate(invalid="ignore"):
        low, high = ends_px.min(axis=1), ends_px.max(axis=1)
        inside = ((low >= reach) & (high < np.array([width, height]) - reach)).all(axis=1)
    ends_px = ends_px[inside]
    if not len(ends_px):
        return np.zeros((side, side)), 0
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    places = ends_px[:, :1] + (ends_px[:, 1:] - ends_px[:, :1]) * share[None, :, None]
    column, row = np.floor(places).astype(int).reshape(-1, 2).T
    hits = np.zeros(picture.shape)
    np.add.at(hits, (row, column), 1.0 / _SAMPLES)
    inner = hits[reach:height - reach, reach:width - reach]
    return scipy.signal.correlate(_gradient(picture, axis, reach), inner, mode="valid", method="fft"), len(ends_px)


def _gradient(picture: np.ndarray, axis: int, reach: int) -> np.ndarray:
    """Of the blurred picture along one axis, in units of its mean nearby, lest what is rich in texture attract all."""
    slope = np.abs(scipy.ndimage.gaussian_filter1d(scipy.ndimage.gaussian_filter(picture, _BLUR_PX), 1.0, axis=axis,
                                                   order=1))
    nearby = scipy.ndimage.uniform_filter(slope, 2 * reach + 1) + 0.25 * slope.mean()
    return np.minimum(slope / np.maximum(nearby, 1e-9), _STRONGEST)
