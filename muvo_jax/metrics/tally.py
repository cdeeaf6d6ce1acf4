"""Running scores of one source of predictions, head by head; what is compared is said by each Head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.metrics import streaming


class Tally:
    """Scores over the windows of one phase, kept for each drive and step."""

    def __init__(self, config: config_lib.Config):
        self._config = config
        self._sums: dict[tuple[str, str], streaming.DriveSums] = {}

    def add(self, prediction: Mapping[str, np.ndarray], truth: types.Batch, drives: Sequence[str], *,
            seed: tuple[int, ...], threshold_m: float, movers: np.ndarray | None = None,
            scans: Sequence[Sequence[np.ndarray]] | None = None) -> None:
        """Scores frames [B, steps, ...] against the recorded ones; a head that either lacks is not scored.

        Args:
          prediction: as protocol.predict returns it.
          truth: the same steps of the recording.
          drives: of each window [B].
          seed, threshold_m, movers, scans: see head.Judged.
        """
        for name, frames in head_lib.shown(tuple(prediction)).items():
            if getattr(truth, frames.field) is not None:
                judged = head_lib.Judged(np.asarray(prediction[name]), truth, self._config, seed, threshold_m, movers,
                                         scans)
                for part, sums in frames.sums(judged).items():
                    self._sums.setdefault((name, part), streaming.DriveSums()).add(drives, sums)

    def merge(self, other: Tally) -> None:
        """With the scores of other windows."""
        for key, sums in other._sums.items():
            self._sums.setdefault(key, streaming.DriveSums()).merge(sums)

    def scores(self) -> dict[str, dict[str, Any]]:
        """{metric: {"mean", "interval", "per_step"}}, with "frames" and "undefined" of means over frames.

        NaN where nothing was defined; see streaming.summary.
        """
        result: dict[str, dict[str, Any]] = {}
        for head, frames in head_lib.shown(tuple(head for head, _ in self._sums)).items():
            for name, metric in frames.metrics.items():
                if (head, metric.sums) in self._sums:
                    result[name] = self._summary(self._sums[head, metric.sums], metric)
        return result

    def _summary(self, sums: streaming.DriveSums, metric: head_lib.Metric) -> dict[str, Any]:
        found = streaming.summary(sums, metric.score, self._config.evaluation.seed)
        if metric.score is not streaming.mean:
            return found
        total = sums.total()
        return found | {"frames": int(total["count"].sum()), "undefined": int(total["undefined"].sum())}
