"""A mean that is fed piece by piece: sums and counts on the host, kept per horizon step."""

from __future__ import annotations

import flax.struct
import numpy as np


@flax.struct.dataclass
class StreamingMean:
    """Means over windows, one for each step of the horizon.

    Attributes:
      total: float64 [H].
      count: int64 [H], values that went in.
      undefined: int64 [H], values that were NaN: counted, never averaged.
    """

    total: np.ndarray
    count: np.ndarray
    undefined: np.ndarray

    @classmethod
    def zeros(cls, steps: int) -> StreamingMean:
        """Nothing seen yet."""
        return cls(np.zeros(steps), np.zeros(steps, np.int64), np.zeros(steps, np.int64))

    def add(self, values: np.ndarray) -> StreamingMean:
        """With more values, float [B, H]; NaN says that a value is undefined."""
        values = np.asarray(values, np.float64)
        missing = np.isnan(values)
        return StreamingMean(self.total + np.where(missing, 0.0, values).sum(axis=0),
                             self.count + (~missing).sum(axis=0), self.undefined + missing.sum(axis=0))

    def per_step(self) -> np.ndarray:
        """float64 [H], NaN where nothing was defined."""
        return divide_or_nan(self.total, self.count)

    def overall(self) -> float:
        """The mean over all steps and windows, NaN where nothing was defined."""
        return float(divide_or_nan(self.total.sum(), self.count.sum()))


def divide_or_nan(numerator, denominator) -> np.ndarray:
    """numerator / denominator, NaN where the denominator is 0."""
    denominator = np.asarray(denominator, np.float64)
    return np.divide(numerator, denominator, out=np.full(denominator.shape, np.nan), where=denominator != 0)
