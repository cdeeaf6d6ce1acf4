"""Which voxels around the car are occupied (paper section III-D)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from muvo_jax import head, types
from muvo_jax.config import LastSeen, LossConfig, ModelConfig, VoxelGrid, as_kind
from muvo_jax.metrics import baselines, occupancy, streaming
from muvo_jax.model import decoders, glimpse
from muvo_jax.objectives import classification, labels, scal
from muvo_jax.ops import resample

_TRUST = 3.0  # log-odds that evidence of a hit or of a look through is worth to a fresh model
_PRIOR_FRAMES = 4.0  # frames of evidence, a quarter of them occupied, that a voxel of the average frame starts with


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    unknown_is_empty = learned.loss.occupancy_unknown == "empty"
    sums: dict[str, head.Sums] = {}
    for scale, target in labels.occupancy_labels(
            learned.truth("occupancy"), pooled=learned.model.numerics == "standard").items():
        sums[f"occupancy_{scale}"] = scal.occupancy_sums(learned.predictions[scale], target, unknown_is_empty,
                                                         learned.loss.occupancy_unknown_weight)
        if learned.loss.occupancy_dice:
            sums[f"occupancy_dice_{scale}"] = classification.occupancy_dice_sums(learned.predictions[scale], target,
                                                                                 unknown_is_empty)
    return sums


def _weights(loss: LossConfig) -> dict[str, float]:
    return head.scaled(loss, "occupancy_cross_entropy", "occupancy_semantic_scal", "occupancy_geometric_scal",
                       "occupancy_dice")


def _average(mean: baselines.TrainingMean, config: ModelConfig) -> dict[int, np.ndarray]:
    """The log-odds of a voxel's frequency among the frames that know it."""
    del config
    assert mean.occupied is not None and mean.known is not None  # of a model with this head
    return {scale: _log_odds(mean.occupied[scale], mean.known[scale]) for scale in head.SCALES}


def _log_odds(occupied: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Logits [..., 2] of voxels that are occupied in so many frames of those that know them."""
    share = (occupied + 0.25 * _PRIOR_FRAMES) / (known + _PRIOR_FRAMES)
    return np.stack([np.zeros(share.shape), np.log(share) - np.log1p(-share)], axis=-1).astype(np.float32)


def _sums(judged: head.Judged) -> dict[str, streaming.Sums]:
    occupied, target = np.asarray(judged.frames), np.asarray(judged.truth.occupancy)
    high = occupancy.above_road(judged.config.model.voxels)
    above = (occupied[..., high], target[..., high])
    sums: dict[str, streaming.Sums] = {}
    for variant, unknown_is_empty in occupancy.VARIANTS.items():
        sums[variant] = occupancy.counts(occupied, target, unknown_is_empty=unknown_is_empty)
        sums[f"above_{variant}"] = occupancy.counts(*above, unknown_is_empty=unknown_is_empty)
    if judged.movers is not None:
        sums["movers"] = occupancy.counts(*above, unknown_is_empty=False, where=judged.movers[..., high])
    return sums


def _error(frames: np.ndarray, truth: types.Batch, grid: VoxelGrid) -> np.ndarray:
    """How many of the known voxels above the road are decided wrongly."""
    high = occupancy.above_road(grid)
    counted = occupancy.counts(frames[..., high], np.asarray(truth.occupancy)[..., high], unknown_is_empty=False)
    return counted["false_positive"] + counted["false_negative"]


def _metric(score: str, sums: str, label: str = "", **shown) -> dict[str, head.Metric]:
    return {f"{score}_{sums}": head.Metric(sums, occupancy.SCORES[score], label, **shown)}


_METRICS = {
    **_metric("iou_occ", "above_observed", "IoU+ above the road", on_screen=True, by_step=True,
              logged="imagined_iou_occ_above", error=lambda share: 1.0 - share),
    **_metric("iou_occ", "above_all", "IoU+ above the road, unknown = empty"),
    **_metric("iou_occ", "movers", "IoU+ of movers", on_screen=True, by_step=True),
    **_metric("iou_occ", "observed", "IoU+", on_screen=True, by_step=True, logged="imagined_iou_occ"),
    **_metric("iou_empty", "observed", "IoU-"),
    **_metric("precision", "observed", "precision"), **_metric("recall", "observed", "recall"),
    **_metric("iou_occ", "all", "IoU+, unknown = empty", on_screen=True, by_step=True),
    **_metric("iou_empty", "all", "IoU-, unknown = empty"),
    **_metric("precision", "all", "precision, unknown = empty"), **_metric("recall", "all", "recall, unknown = empty"),
    **_metric("precision", "above_observed"), **_metric("recall", "above_observed"),
    **_metric("precision", "above_all"), **_metric("recall", "above_all"),
}


def _draw_above(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import panels  # with Pillow, which imagining does not need
    return panels.occupancy_from_above(frame, scene.grid, columns_px=columns_px, ego_m=scene.ego_m)


def _draw_ahead(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import panels
    return panels.occupancy_from_behind(frame, scene.grid, size_px=(max(96, round(0.39 * columns_px)), columns_px))


def _see(seen: glimpse.VoxelGlimpse, config: ModelConfig) -> types.Array:
    del config
    moving = [] if seen.onward is None else [seen.onward]
    return jnp.concatenate([seen.newest, seen.older, *moving], axis=-1)


def _compose(raw, seen: glimpse.VoxelGlimpse, mean, config: ModelConfig) -> dict[int, types.Array]:
    trust = np.zeros(config.voxels.shape[2], np.float32)
    trust[occupancy.above_road(config.voxels)] = _TRUST
    # Above the road only: the road's rings do not move with the world. The newest scan has the say; the older ones
    # where it has none. (Added up, what moves is cancelled out.)
    evidence = seen.newest + (1.0 - jnp.abs(seen.newest)) * seen.older
    if seen.onward is not None:  # where it was may be hidden by it now, or not: that is left to be learned
        evidence = jnp.maximum(evidence, seen.onward)
    believed = jnp.asarray(trust).reshape(1, 1, 1, -1) * evidence
    raw = {scale: value.reshape(*value.shape[:3], -1, 2) for scale, value in raw.items()}
    own, result = mean(raw), {}
    for scale in head.SCALES:
        if scale > 1:
            believed = resample.max_pool2(believed)
        result[scale] = own[scale] + jnp.stack([jnp.zeros_like(believed), believed], axis=-1)
    return result


HEAD = head.Head(
    targets=lambda model: {"occupancy": model.voxels.shape},
    build=lambda model: decoders.of_voxels(model, 2), scales=head.SCALES, tokens="occupancy", initial_bias=0.0,
    losses=_losses, weights=_weights, average=_average,
    guide=head.Guide(view="occupancy", plane=lambda model: model.voxels.shape[:2],
                     width=lambda model: as_kind(model.first_guess, LastSeen).widths["occupancy"],
                     channels=lambda model, scale: 2 * model.voxels.shape[2] // scale, shrink=8, see=_see,
                     compose=_compose),
    frames=head.Frames(
        field="occupancy", sums=_sums,
        of=lambda value, model: occupancy.predicted_occupied(value, model.occupied_above),
        metrics=_METRICS, error=_error, error_name="voxels above the road",
        pictures=(head.Picture("voxels above", _draw_above, "above", ("height", "unknown")),
                  head.Picture("voxels ahead", _draw_ahead, "ahead", ("height", "unknown")))))
