"""Lidar forecasts along the rays of recorded scans, as 4D-Occ scores them (Khurana et al., CVPR 2023).

A scan asks, and nothing of it but the directions of its returns is seen: what range does the predicted range view show
there, or, where it shows none, beside it? So range views of any size are judged by all points of a scan. Near-field
Chamfer: half of the mean squared nearest distances both ways, m^2, of the points inside a box, measured and predicted.
L1 and AbsRel: errors of the range along each ray, both ranges ending where the ray leaves the box, in metres and in
percent of the measured one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import spatial

from muvo_jax import config as config_lib
from muvo_jax.metrics import points
from muvo_jax.ops import range_view as range_view_ops


def frame_scores(prediction: np.ndarray, scans: Sequence[Sequence[np.ndarray]], ego_motion: np.ndarray, *,
                 geometry: config_lib.RangeViewGeometry, evaluation: config_lib.EvaluationConfig,
                 threshold_m: float) -> dict[str, np.ndarray]:
    """Scores of each predicted scan.

    Args:
      prediction: float32 [B, T, Hr, Wr, 4], the steps behind the context.
      scans: [B][T] of float32 [P, 3], what was recorded, ego frame of its own step, m.
      ego_motion: [B, T, 4], types.Batch.ego_motion of these steps.
      geometry: of the range views.
      evaluation: whose boxes these are.
      threshold_m: a predicted return is a predicted range above this.

    Returns:
      {"near_m2", "l1_m", "absrel_percent"}: float64 [B, T]; the first is NaN where the box holds no point of one side,
      all are where the prediction is not finite or one side has no returns.
    """
    ranges_m = np.asarray(prediction)[..., 3]
    beams = range_view_ops.beam_directions(geometry).reshape(-1, 3)
    scores = {name: np.full(ranges_m.shape[:2], np.nan) for name in ("near_m2", "l1_m", "absrel_percent")}
    for window, moves in enumerate(np.asarray(ego_motion, np.float64)):
        pose = np.zeros(3)  # of the ego, as the last observed frame sees it
        for step, (forward_m, left_m, turn_rad) in enumerate(moves[:, :3]):
            pose = np.append(_turned(np.array([forward_m, left_m]), pose[2]) + pose[:2], pose[2] + turn_rad)
            scan_m = _kept(scans[window][step], geometry, evaluation.scan_without_m)
            shown_m = ranges_m[window, step].reshape(-1)
            if len(scan_m) and np.isfinite(shown_m).all() and (shown_m > threshold_m).any():
                pixel, measured_m = range_view_ops.pixels_of(scan_m, geometry)
                predicted_m = _filled(shown_m, beams, threshold_m)[pixel]
                found = _scores(predicted_m, measured_m, scan_m, pose, geometry.position_m, evaluation.scan_region_m)
                for name, value in found.items():
                    scores[name][window, step] = value
    return scores


def _scores(predicted_m: np.ndarray, measured_m: np.ndarray, scan_m: np.ndarray, pose: np.ndarray,
            position_m: tuple[float, float, float], region_m: tuple[float, ...]) -> dict[str, float]:
    """Of the ranges [P] of one scan [P, 3], seen from the ego frame that stands at `pose` in that of the last observed
    frame, with the lidar's place in either."""
    ray = (scan_m - np.array(position_m)) / measured_m[:, None]
    # As the last observed frame's lidar sees it. In NumPy: JAX would compile anew for every number of points.
    ray[:, :2] = _turned(ray[:, :2], pose[2])
    lidar_m = np.array(position_m[:2])
    origin_m = np.append(_turned(lidar_m, pose[2]) + pose[:2] - lidar_m, 0.0)
    low_m, high_m = np.reshape(region_m, (2, 3))
    inside = lambda cloud: cloud[((cloud >= low_m) & (cloud <= high_m)).all(axis=1)]
    guess, truth = (inside(origin_m + ray * range_m[:, None]) for range_m in (predicted_m, measured_m))
    near_m2 = np.nan
    if len(truth) and len(guess):
        near_m2 = sum(np.square(side).mean() for side in points.nearest_m(guess, truth)) / 2.0
    with np.errstate(divide="ignore"):
        leaves_m = np.where(ray == 0.0, np.inf, (np.where(ray > 0.0, high_m, low_m) - origin_m) / ray).min(axis=1)
    ends_m = np.minimum(measured_m, leaves_m)
    error_m = np.abs(np.minimum(predicted_m, leaves_m) - ends_m)
    return {"near_m2": near_m2, "l1_m": error_m.mean(), "absrel_percent": 100.0 * (error_m / ends_m).mean()}


def _filled(shown_m: np.ndarray, beams: np.ndarray, threshold_m: float) -> np.ndarray:
    """Ranges [Hr * Wr], where nothing is shown that of the return nearest in direction, as 4D-Occ asks point clouds."""
    returns = np.flatnonzero(shown_m > threshold_m)
    _, nearest = spatial.cKDTree(beams[returns]).query(beams, workers=-1)  # of a return itself
    return shown_m[returns[nearest]].astype(np.float64)


def _kept(scan_m: np.ndarray, geometry: config_lib.RangeViewGeometry, without_m: tuple[float, ...]) -> np.ndarray:
    """The returns away from the lidar and outside a box around it."""
    offset_m = np.asarray(scan_m, np.float64) - np.array(geometry.position_m)
    kept = (offset_m != 0.0).any(axis=1)
    if without_m:
        low_m, high_m = np.reshape(without_m, (2, 2))
        kept &= ~((offset_m[:, :2] >= low_m) & (offset_m[:, :2] <= high_m)).all(axis=1)
    return np.asarray(scan_m)[kept]


def _turned(xy: np.ndarray, angle_rad: float) -> np.ndarray:
    """[..., 2], turned to the left."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return xy @ np.array([[cosine, sine], [-sine, cosine]])
