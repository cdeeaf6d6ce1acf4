"""The optional heads that draw maps: from decoded values to what a recording holds, and how well the two agree."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types

_UNLABELLED = 255
# Head -> the field of types.Batch that it predicts, the name of its score.
FIELDS = {"depth": ("depth_m", "depth_error_m"), "semantic_image": ("image_classes", "semantic_image_share"),
          "semantic_range_view": ("range_view_classes", "semantic_range_view_share"),
          "birds_eye": ("birds_eye_classes", "birds_eye_share")}


def finish(decoded: Mapping[str, types.Array]) -> dict[str, types.Array]:
    """{head: [..., H, W, channels]} at full size, of these heads -> {field of types.Batch: [..., H, W]}."""
    frames = {}
    for head, value in decoded.items():
        field, _ = FIELDS[head]
        if head == "depth":
            frames[field] = value[..., 0]
        else:  # after its classes a bird's-eye view has offsets and centres
            logits = value[..., :config_lib.BIRDS_EYE_CLASSES] if head == "birds_eye" else value
            frames[field] = jnp.argmax(logits, axis=-1).astype(jnp.uint8)
    return frames


def frame_scores(head: str, prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The score of each frame, float64 [B, T], NaN where nothing is measured or labelled.

    Args:
      head: of FIELDS.
      prediction, truth: [B, T, H, W], as `finish` and types.Batch have them.

    Returns:
      of "depth" the mean absolute error in metres where the truth has a surface, of the others the share of the
      labelled pixels or cells whose class is right.
    """
    if head == "depth":
        counted, good = truth >= 0.0, np.abs(np.asarray(prediction, np.float64) - truth)
    else:
        counted, good = truth != _UNLABELLED, np.asarray(prediction == truth, np.float64)
    count = counted.sum(axis=(-2, -1))
    total = np.where(counted, good, 0.0).sum(axis=(-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
