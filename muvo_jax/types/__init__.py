"""The pytrees that every part of muvo_jax exchanges.

Axes: B batch, T time, N branches or points, H W image rows and columns, C channels (always last), X Y Z voxels,
S stochastic channels, D deterministic channels. With the 2D latent [..., S] and [..., D] are tokens [..., N, C].

Ego frame: x forward, y left, z up, metres, origin on the ground under the ego vehicle.
Time: `action[t]` is applied from t to t+1.
"""

from __future__ import annotations

from muvo_jax.types.arrays import (
    OCCUPANCY_EMPTY,
    OCCUPANCY_OCCUPIED,
    OCCUPANCY_UNKNOWN,
    RANGE_NO_RETURN_M,
    Array,
    ArrayLike,
    Variables,
)
from muvo_jax.types.batch import BATCH_FIELDS, UNTIMED_FIELDS, Batch
from muvo_jax.types.predictions import Predictions
from muvo_jax.types.states import Dream, Gaussian, LatentState, Memory, Motion, Observed, StepNoise, Vantage

__all__ = ["BATCH_FIELDS", "OCCUPANCY_EMPTY", "OCCUPANCY_OCCUPIED", "OCCUPANCY_UNKNOWN", "RANGE_NO_RETURN_M",
           "UNTIMED_FIELDS", "Array", "ArrayLike", "Batch", "Dream", "Gaussian", "LatentState", "Memory", "Motion",
           "Observed", "Predictions", "StepNoise", "Vantage", "Variables"]
