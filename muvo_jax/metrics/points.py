"""Chamfer distance between predicted and measured lidar points, in metres (paper section IV).

Of each frame: half of (mean nearest distance from truth to prediction + the same backwards), unsquared. The reference's
metric instead compares 10,000 random pixels, holes included: `pixel_chamfer_m`. Computed on the host with k-d trees.
"""

from __future__ import annotations

import numpy as np
from scipy import spatial

from muvo_jax import types


def range_view_points(range_view: types.ArrayLike, return_threshold_m: float = 0.0,
                      above_m: float = -np.inf) -> np.ndarray:
    """float32 [P, 3]: the points of a range view [Hr, Wr, 4] whose range is above the threshold.

    The threshold is 0 for a measured range view, whose holes hold -1, and larger for a predicted one. Of the points
    only those higher than `above_m` over the ground under the ego are taken.
    """
    range_view = np.asarray(range_view)
    return range_view[(range_view[..., 3] > return_threshold_m) & (range_view[..., 2] > above_m)][:, :3]


def keyed_subset(points: np.ndarray, count: int, seed: tuple[int, ...]) -> np.ndarray:
    """At most `count` of the rows, drawn without repetition by a generator of this seed; all rows where count is 0.

    Args:
      points: [P, 3].
      count: size of the subset.
      seed: such as (seed of the evaluation, window, step), so that a frame always gives the same subset.
    """
    if not 0 < count < len(points):
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


def chamfer_m(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Chamfer distance of two clouds [P, 3] and [Q, 3] in metres, NaN where one of them is empty."""
    if not len(prediction) or not len(truth):
        return float("nan")
    to_truth, to_prediction = nearest_m(prediction, truth)
    return float(to_truth.mean() + to_prediction.mean()) / 2.0


def nearest_m(prediction: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of two clouds [P, 3] and [Q, 3], neither empty: how far each point of one is from the nearest of the other."""
    to_truth, _ = spatial.cKDTree(truth).query(prediction, workers=-1)
    to_prediction, _ = spatial.cKDTree(prediction).query(truth, workers=-1)
    return to_truth, to_prediction


def frame_chamfer_m(prediction: types.ArrayLike, truth: types.ArrayLike, *, return_threshold_m: float, points: int,
                    seed: tuple[int, ...], above_m: float = -np.inf) -> np.ndarray:
    """Chamfer distances of windows of range views.

    Args:
      prediction, truth: float32 [B, H, Hr, Wr, 4], metres, ego frame.
      return_threshold_m: a predicted return is a predicted range above this.
      points: size of the keyed subset of each side, 0 for all points.
      seed: names this batch; the frame's place is added to it.
      above_m: only points higher than this count, of either side.

    Returns:
      float64 [B, H], NaN where one side of a frame is empty, or the prediction is not finite.
    """
    prediction, truth = np.asarray(prediction), np.asarray(truth)
    distances = np.empty(prediction.shape[:2])
    for window, step in np.ndindex(distances.shape):
        if not np.isfinite(prediction[window, step]).all():
            distances[window, step] = np.nan
            continue
        clouds = (range_view_points(prediction[window, step], return_threshold_m, above_m),
                  range_view_points(truth[window, step], 0.0, above_m))
        distances[window, step] = chamfer_m(*(keyed_subset(cloud, points, (*seed, window, step, side))
                                              for side, cloud in enumerate(clouds)))
    return distances


def pixel_chamfer_m(prediction: types.ArrayLike, truth: types.ArrayLike, *, pixels: int,
                    seed: tuple[int, ...]) -> np.ndarray:
    """The authors' Chamfer distance: of the points of random pixels, the same of both sides, holes included.

    A hole of the truth is a point at the ego's origin: half of the points may stand there, all at one place, and a
    prediction that has one point near it is right about all of them.

    Args:
      prediction, truth: float32 [B, H, Hr, Wr, 4], metres, ego frame.
      pixels: how many are drawn, with repetition.
      seed: names this batch; the frame's place is added to it.

    Returns:
      float64 [B, H], NaN where the prediction is not finite.
    """
    prediction, truth = np.asarray(prediction), np.asarray(truth)
    distances = np.full(prediction.shape[:2], np.nan)
    for window, step in np.ndindex(distances.shape):
        if np.isfinite(prediction[window, step]).all():
            drawn = np.random.default_rng((*seed, window, step)).integers(0, truth[0, 0, ..., 0].size, pixels)
            distances[window, step] = chamfer_m(*(view[window, step, ..., :3].reshape(-1, 3)[drawn]
                                                  for view in (prediction, truth)))
    return distances
