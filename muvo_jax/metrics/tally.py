"""Running scores of one source of predictions: what is compared, modality by modality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.metrics import image, maps, occupancy, points, streaming

HEADS = ("image", "range_view", "occupancy")
_ABOVE_SCORES = ("iou_occ", "precision", "recall")
# Which voxels -> the scores of their counts, named SCORE_GROUP.
_VOXEL_SCORES: dict[str, tuple[str, ...]] = {
    "above_observed": _ABOVE_SCORES, "above_all": _ABOVE_SCORES, "movers": ("iou_occ",),
    "observed": tuple(occupancy.SCORES), "all": tuple(occupancy.SCORES)}


class Tally:
    """Scores over the windows of one phase, kept for each drive and step."""

    def __init__(self, config: config_lib.Config):
        self._evaluation = config.evaluation
        self._above = occupancy.above_road(config.model.voxels)
        self._sums: dict[str, streaming.DriveSums] = {}

    def add(self, prediction: Mapping[str, np.ndarray], truth: types.Batch, drives: Sequence[str], *,
            seed: tuple[int, ...], threshold_m: float, movers: np.ndarray | None = None) -> None:
        """Scores frames [B, steps, ...] against the recorded ones; a modality that either lacks is not scored.

        Args:
          prediction: as protocol.predict returns it.
          truth: the same steps of the recording; its image_moving_mask says which pixels show movers.
          drives: of each window [B].
          seed: names these frames, for the points that the Chamfer distance looks at.
          threshold_m: a predicted return is a predicted range above this.
          movers: bool [B, steps, X, Y, Z], the voxels that count as movers'; None to leave their score out.
        """
        present = [head for head in HEADS if head in prediction and getattr(truth, head) is not None]
        if "image" in present:
            self._add_image(prediction["image"], truth, drives)
        if "range_view" in present:
            for name, above_m in (("chamfer_m", -np.inf), ("chamfer_above_m", occupancy.ABOVE_ROAD_M)):
                distances = points.frame_chamfer_m(
                    prediction["range_view"], np.asarray(truth.range_view), seed=seed, return_threshold_m=threshold_m,
                    points=self._evaluation.chamfer_points, above_m=above_m)
                self._add(name, drives, streaming.mean_sums(distances))
        if "occupancy" in present:
            self._add_voxels(np.asarray(prediction["occupancy"]), np.asarray(truth.occupancy), drives, movers)
        for head, (field, score) in maps.FIELDS.items():
            if field in prediction and getattr(truth, field) is not None:
                values = maps.frame_scores(head, np.asarray(prediction[field]), np.asarray(getattr(truth, field)))
                self._add(score, drives, streaming.mean_sums(values))

    def scores(self) -> dict[str, dict[str, Any]]:
        """{metric: {"mean", "interval", "per_step"}}, with "frames" and "undefined" of means over frames.

        NaN where nothing was defined; see streaming.summary.
        """
        seed = self._evaluation.seed
        result: dict[str, dict[str, Any]] = {}
        for name, sums in self._sums.items():
            if name in _VOXEL_SCORES:
                result |= {f"{score}_{name}": streaming.summary(sums, occupancy.SCORES[score], seed)
                           for score in _VOXEL_SCORES[name]}
            elif name == "psnr_movers_db":
                result[name] = streaming.summary(sums, image.masked_psnr_db, seed)
            else:
                total = sums.total()
                result[name] = streaming.summary(sums, streaming.mean, seed) | {
                    "frames": int(total["count"].sum()), "undefined": int(total["undefined"].sum())}
        return result

    def _add(self, name: str, drives: Sequence[str], values: streaming.Sums) -> None:
        self._sums.setdefault(name, streaming.DriveSums()).add(drives, values)

    def _add_image(self, prediction: np.ndarray, truth: types.Batch, drives: Sequence[str]) -> None:
        target = np.asarray(truth.image)
        self._add("psnr_db", drives, streaming.mean_sums(np.asarray(image.frame_psnr_db(prediction, target))))
        if truth.image_moving_mask is not None:
            self._add("psnr_movers_db", drives,
                      image.masked_sums(prediction, target, np.asarray(truth.image_moving_mask)))

    def _add_voxels(self, occupied: np.ndarray, target: np.ndarray, drives: Sequence[str],
                    movers: np.ndarray | None) -> None:
        above = (occupied[..., self._above], target[..., self._above])
        for variant, unknown_is_empty in occupancy.VARIANTS.items():
            self._add(variant, drives, occupancy.counts(occupied, target, unknown_is_empty=unknown_is_empty))
            self._add(f"above_{variant}", drives, occupancy.counts(*above, unknown_is_empty=unknown_is_empty))
        if movers is not None:
            self._add("movers", drives, occupancy.counts(*above, unknown_is_empty=False,
                                                         where=movers[..., self._above]))
