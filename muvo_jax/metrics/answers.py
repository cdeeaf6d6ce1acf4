"""Does a model answer to the actions of a recording: its error under another window's actions over its own error.

1 says that it is deaf to them. The pasts stay the same, so that only what the actions change can tell the two apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.metrics import streaming


def errors(prediction: Mapping[str, np.ndarray], truth: types.Batch,
           grid: config_lib.VoxelGrid) -> dict[str, np.ndarray]:
    """Head -> error of each frame, float64 [B, H], of the heads that say what theirs is (head.Frames.error)."""
    return {name: frames.error(np.asarray(prediction[name]), truth, grid)
            for name, frames in head_lib.shown(tuple(prediction)).items()
            if frames.error is not None and getattr(truth, frames.field) is not None}


class Answers:
    """Errors of a model under the recorded actions and under others."""

    def __init__(self, config: config_lib.Config):
        self._grid, self._seed = config.model.voxels, config.evaluation.seed
        self._sums: dict[str, streaming.DriveSums] = {}

    def add(self, recorded: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray], truth: types.Batch,
            drives: Sequence[str]) -> None:
        """With imagined frames [B, H, ...] under the recorded and under other actions, and what was recorded."""
        under_recorded, under_other = (errors(frames, truth, self._grid) for frames in (recorded, other))
        for head, error in under_recorded.items():
            self._sums.setdefault(head, streaming.DriveSums()).add(
                drives, {"recorded": error, "other": under_other[head]})

    def merge(self, other: Answers) -> None:
        """With the errors in other windows."""
        for head, sums in other._sums.items():
            self._sums.setdefault(head, streaming.DriveSums()).merge(sums)

    def ratios(self) -> dict[str, dict[str, Any]]:
        """{head: {"mean", "interval", "per_step"}} of the action shuffle ratio, NaN where nothing is wrong at all."""
        ratio = lambda sums: streaming.divide_or_nan(sums["other"], sums["recorded"])
        return {head: streaming.summary(sums, ratio, self._seed) for head, sums in self._sums.items()}
