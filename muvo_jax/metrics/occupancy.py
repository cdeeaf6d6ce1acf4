"""Occupancy scores from counts summed over a whole split, never a mean of per-frame ratios (paper section IV).

Each score comes in two forms: `*_observed` leaves unknown voxels out, `*_all` counts them as empty, as the paper does.
"""

from __future__ import annotations

import flax.struct
import numpy as np

from muvo_jax import types
from muvo_jax.metrics import streaming

VARIANTS = ("observed", "all")


@flax.struct.dataclass
class OccupancyCounts:
    """Voxel counts per horizon step, int64 [H]."""

    true_positive: np.ndarray
    false_positive: np.ndarray
    false_negative: np.ndarray
    true_negative: np.ndarray

    @classmethod
    def zeros(cls, steps: int) -> OccupancyCounts:
        """Nothing seen yet."""
        return cls(*(np.zeros(steps, np.int64) for _ in range(4)))

    def add(self, occupied: np.ndarray, target: np.ndarray, *, unknown_is_empty: bool) -> OccupancyCounts:
        """With more windows.

        Args:
          occupied: bool [B, H, X, Y, Z], predicted probability above 0.5 (`predicted_occupied`).
          target: uint8 [B, H, X, Y, Z], 0 empty, 1 occupied, 255 unknown.
          unknown_is_empty: whether unknown voxels count as empty; otherwise they do not count.
        """
        occupied, target = np.asarray(occupied), np.asarray(target)
        positive = target == types.OCCUPANCY_OCCUPIED
        negative = ~positive if unknown_is_empty else target == types.OCCUPANCY_EMPTY
        count = lambda mask: mask.sum(axis=(0, 2, 3, 4), dtype=np.int64)
        true_positive, false_positive = count(occupied & positive), count(occupied & negative)
        return OccupancyCounts(self.true_positive + true_positive, self.false_positive + false_positive,
                               self.false_negative + count(positive) - true_positive,
                               self.true_negative + count(negative) - false_positive)

    def overall(self) -> OccupancyCounts:
        """Summed over the horizon."""
        return OccupancyCounts(self.true_positive.sum(), self.false_positive.sum(), self.false_negative.sum(),
                               self.true_negative.sum())

    def scores(self) -> dict[str, np.ndarray]:
        """{"iou_occ", "iou_empty", "precision", "recall"}, float64 [H], NaN where undefined."""
        wrong = self.false_positive + self.false_negative
        divide = streaming.divide_or_nan
        return {
            "iou_occ": divide(self.true_positive, self.true_positive + wrong),
            "iou_empty": divide(self.true_negative, self.true_negative + wrong),
            "precision": divide(self.true_positive, self.true_positive + self.false_positive),
            "recall": divide(self.true_positive, self.true_positive + self.false_negative),
        }


@flax.struct.dataclass
class OccupancyScores:
    """Both ways to treat unknown voxels, side by side."""

    observed: OccupancyCounts
    all: OccupancyCounts

    @classmethod
    def zeros(cls, steps: int) -> OccupancyScores:
        """Nothing seen yet."""
        return cls(OccupancyCounts.zeros(steps), OccupancyCounts.zeros(steps))

    def add(self, occupied: np.ndarray, target: np.ndarray) -> OccupancyScores:
        """With more windows; arguments as `OccupancyCounts.add`."""
        return OccupancyScores(self.observed.add(occupied, target, unknown_is_empty=False),
                               self.all.add(occupied, target, unknown_is_empty=True))

    def per_step(self) -> dict[str, np.ndarray]:
        """{"iou_occ_observed", "iou_occ_all", "iou_empty_observed", ...}, float64 [H], NaN where undefined."""
        return {f"{name}_{variant}": value for variant in VARIANTS
                for name, value in getattr(self, variant).scores().items()}

    def overall(self) -> dict[str, float]:
        """The same scores of the counts of all steps together."""
        return {f"{name}_{variant}": float(value) for variant in VARIANTS
                for name, value in getattr(self, variant).overall().scores().items()}


def predicted_occupied(logits: types.Array) -> types.Array:
    """bool [...] from logits [..., 2]: probability of "occupied" above 0.5."""
    return logits[..., 1] > logits[..., 0]
