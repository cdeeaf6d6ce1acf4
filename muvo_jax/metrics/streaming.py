"""Sums that are fed window by window, kept for each drive and each step of the horizon apart, and what follows of them.

A score is a function of sums, so that it can be asked for one step, for all steps together, and for drives drawn anew:
windows of one drive overlap and look alike, hence an interval comes from drawing drives, never windows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

RESAMPLES = 1000
INTERVAL = (0.025, 0.975)  # of the resampled scores

Sums = Mapping[str, np.ndarray]
Score = Callable[[Sums], np.ndarray]


class DriveSums:
    """Named sums [H] of each drive, on the host."""

    def __init__(self):
        self._drives: dict[str, dict[str, np.ndarray]] = {}

    def add(self, drives: Sequence[str], values: Sums) -> None:
        """With more windows.

        Args:
          drives: the drive of each window [B].
          values: numbers or flags [B, H] by name, the same names in every call.
        """
        for row, drive in enumerate(drives):
            sums = self._drives.setdefault(drive, {})
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + np.asarray(value[row], np.float64)

    def merge(self, other: DriveSums) -> None:
        """With the sums of other windows."""
        for drive, values in other._drives.items():
            sums = self._drives.setdefault(drive, {})
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value

    @property
    def drives(self) -> int:
        """How many there are."""
        return len(self._drives)

    def total(self) -> dict[str, np.ndarray]:
        """Over all drives, float64 [H]."""
        return {name: values.sum(axis=0) for name, values in self._stacked().items()}

    def resampled(self, seed: int) -> dict[str, np.ndarray]:
        """Over as many drives as there are, drawn with repetition RESAMPLES times: float64 [RESAMPLES, H].

        The same seed and number of drives give the same draws, so that two sources are compared on the same ones.
        """
        count = self.drives
        times = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
        return {name: times @ values for name, values in self._stacked().items()}

    def _stacked(self) -> dict[str, np.ndarray]:
        names = next(iter(self._drives.values()), {})
        return {name: np.stack([sums[name] for sums in self._drives.values()]) for name in names}


def summary(sums: DriveSums, score: Score, seed: int) -> dict[str, Any]:
    """JSON-ready {"mean", "interval", "per_step", "to_step"} of a score.

    Args:
      score: named sums of any one shape -> scores of that shape, NaN where undefined.
      seed: of the draws.

    Returns:
      "mean" is the score of all steps together, "interval" [low, high] holds it in 95 % of the draws of drives (NaN
      with fewer than two drives), "per_step" has the score at each step, "to_step" that of all steps up to each.
    """
    over_steps = lambda values: {name: value.sum(axis=-1) for name, value in values.items()}
    total = sums.total()
    interval = [float("nan"), float("nan")]
    if sums.drives > 1:
        drawn = np.asarray(score(over_steps(sums.resampled(seed))))
        drawn = drawn[~np.isnan(drawn)]
        if len(drawn):
            interval = np.quantile(drawn, INTERVAL).tolist()
    up_to = {name: np.cumsum(value, axis=-1) for name, value in total.items()}
    return {"mean": float(score(over_steps(total))), "interval": interval, "per_step": score(total).tolist(),
            "to_step": score(up_to).tolist()}


def mean_sums(values: np.ndarray) -> dict[str, np.ndarray]:
    """What `mean` needs of values [B, H]; NaN says that a value is undefined: counted, never averaged."""
    values = np.asarray(values, np.float64)
    missing = np.isnan(values)
    return {"total": np.where(missing, 0.0, values), "count": ~missing, "undefined": missing}


def mean(sums: Sums) -> np.ndarray:
    """The mean of all values that went in, NaN where none was defined."""
    return divide_or_nan(sums["total"], sums["count"])


def divide_or_nan(numerator, denominator) -> np.ndarray:
    """numerator / denominator, NaN where the denominator is 0."""
    denominator = np.asarray(denominator, np.float64)
    return np.divide(numerator, denominator, out=np.full(denominator.shape, np.nan), where=denominator != 0)
