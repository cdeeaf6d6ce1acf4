"""Arrays, and what the values of some of them mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

Array = jax.Array
ArrayLike = jax.Array | np.ndarray
Variables = Mapping[str, Any]  # {"params": ..., "batch_stats": ...}, plain nested dictionaries

OCCUPANCY_EMPTY = 0
OCCUPANCY_OCCUPIED = 1
OCCUPANCY_UNKNOWN = 255
RANGE_NO_RETURN_M = -1.0


class Indexable:
    """Adds `state[:, ::4]`: the same index on every leaf."""

    def __getitem__(self, index):
        return jax.tree.map(lambda leaf: leaf[index], self)
