"""The ground plan of the voxel grid: what lies on each cell, and the centres of vehicles and pedestrians."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from muvo_jax import head, types
from muvo_jax.config import BIRDS_EYE_CLASSES, LossConfig, ModelConfig
from muvo_jax.metrics import maps, streaming
from muvo_jax.model import decoders
from muvo_jax.objectives import classification, instances, labels


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    """Predictions are class logits, then offset (2) and centre (1)."""
    loss, count = learned.loss, BIRDS_EYE_CLASSES
    sums: dict[str, head.Sums] = {}
    numbers = labels.map_labels(learned.truth("birds_eye_instances"))
    for scale, target in labels.map_labels(learned.truth("birds_eye_classes")).items():
        prediction = learned.predictions[scale]
        sums[f"birds_eye_{scale}"] = classification.cross_entropy_sums(
            prediction[..., :count], target, weights=loss.birds_eye_weights, top_share=loss.birds_eye_share)
        sums[f"birds_eye_centre_{scale}"], sums[f"birds_eye_offset_{scale}"] = instances.sums(
            prediction[..., count + 2:], prediction[..., count:count + 2], numbers[scale], scale)
    return sums


def _weights(loss: LossConfig) -> dict[str, float]:
    return head.scaled(loss, "birds_eye", "birds_eye_centre") | {
        f"birds_eye_offset_{scale}": loss.birds_eye_offset for scale in head.SCALES}


def _classes(value: types.Array, model: ModelConfig) -> types.Array:
    del model
    return jnp.argmax(value[..., :BIRDS_EYE_CLASSES], axis=-1).astype(jnp.uint8)


def _sums(judged: head.Judged) -> dict[str, streaming.Sums]:
    return {"frames": streaming.mean_sums(maps.share_right(judged.frames, np.asarray(judged.truth.birds_eye_classes)))}


def _draw(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import panels  # with Pillow, which imagining does not need
    del scene
    return panels.ground_plan(frame, columns_px)


HEAD = head.Head(
    targets=lambda model: {"birds_eye_classes": model.voxels.shape[:2], "birds_eye_instances": model.voxels.shape[:2]},
    build=lambda model: decoders.of_ground_plan(model, BIRDS_EYE_CLASSES), scales=head.SCALES, tokens="occupancy",
    losses=_losses, weights=_weights,
    frames=head.Frames(
        field="birds_eye_classes", of=_classes, sums=_sums,
        metrics={"birds_eye_share": head.Metric("frames", streaming.mean, "bird's-eye view, share right",
                                                on_screen=True)},
        pictures=(head.Picture("ground plan", _draw, "above"),)))
