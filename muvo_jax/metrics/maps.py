"""How well a map agrees with the recorded one, frame by frame: float64 [B, T], NaN where that says nothing."""

from __future__ import annotations

import numpy as np

_UNLABELLED = 255


def depth_error_m(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The mean absolute error of depths [B, T, H, W] in metres, where the truth has a surface."""
    return _mean(np.abs(np.asarray(prediction, np.float64) - truth), truth >= 0.0)


def share_right(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The share of the labelled pixels or cells [B, T, H, W] whose class is right."""
    return _mean(np.asarray(prediction == truth, np.float64), truth != _UNLABELLED)


def _mean(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    count = counted.sum(axis=(-2, -1))
    total = np.where(counted, values, 0.0).sum(axis=(-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
