"""Occupancy scores from counts summed over a whole split, never a mean of per-frame ratios (paper section IV).

Each score comes in two forms: `*_observed` leaves unknown voxels out, `*_all` counts them as empty, as the paper does.
Most occupied voxels are road, which the mean of all training frames has right; what a driver must not hit stands above
it. So IoU+ above the road is the headline.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.metrics import streaming

VARIANTS = {"observed": False, "all": True}  # name -> whether unknown voxels count as empty
ABOVE_ROAD_M = 0.5


def above_road(grid: config_lib.VoxelGrid) -> slice:
    """The layers of a grid's last axis whose lower face is ABOVE_ROAD_M or more above the ground under the ego.

    Of the town's 1 m voxels from z = -1.5 m on these are all but the lowest two: the road lies in the second.
    """
    return grid.layers(ABOVE_ROAD_M)


def counts(occupied: np.ndarray, target: np.ndarray, *, unknown_is_empty: bool,
           where: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Counts of voxels, int64 [B, H], that `score` reads.

    Args:
      occupied: bool [B, H, X, Y, Z], `predicted_occupied`.
      target: uint8 [B, H, X, Y, Z], 0 empty, 1 occupied, 255 unknown.
      unknown_is_empty: whether unknown voxels count as empty; otherwise they do not count.
      where: bool [B, H, X, Y, Z], which voxels count at all; None for all.
    """
    occupied, target = np.asarray(occupied), np.asarray(target)
    positive = target == types.OCCUPANCY_OCCUPIED
    negative = ~positive if unknown_is_empty else target == types.OCCUPANCY_EMPTY
    if where is not None:
        positive, negative = positive & where, negative & where
    count = lambda mask: mask.sum(axis=(2, 3, 4), dtype=np.int64)
    true_positive, false_positive = count(occupied & positive), count(occupied & negative)
    return {"true_positive": true_positive, "false_positive": false_positive,
            "false_negative": count(positive) - true_positive, "true_negative": count(negative) - false_positive}


def _share(sums: streaming.Sums, part: str, *others: str) -> np.ndarray:
    return streaming.divide_or_nan(sums[part], sums[part] + sum(sums[other] for other in others))


# Name -> function of counts of any one shape, NaN where undefined.
SCORES: dict[str, Callable[[streaming.Sums], np.ndarray]] = {
    "iou_occ": lambda sums: _share(sums, "true_positive", "false_positive", "false_negative"),
    "iou_empty": lambda sums: _share(sums, "true_negative", "false_positive", "false_negative"),
    "precision": lambda sums: _share(sums, "true_positive", "false_positive"),
    "recall": lambda sums: _share(sums, "true_positive", "false_negative"),
}


def predicted_occupied(logits: types.Array, above: float) -> types.Array:
    """bool [...] from logits [..., 2]: probability of "occupied" above ModelConfig.occupied_above."""
    return logits[..., 1] - logits[..., 0] > math.log(above / (1.0 - above))
