"""The average training frame as the start of the decoders (config.TrainingMean, model/outputs.py)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.metrics import baselines
from muvo_jax.model import outputs
from muvo_jax.objectives import labels
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib

_LEAST_SPREAD = 0.02  # of an action that hardly ever moves: its noise is not to be made large
_PRIOR_FRAMES = 4.0  # frames of evidence, a quarter of them occupied, that a voxel starts with


def constants(mean: baselines.TrainingMean, config: config_lib.ModelConfig) -> dict[str, dict[str, np.ndarray]]:
    """What `outputs.FirstGuess` adds, in the decoders' raw units: the subtree of `batch_stats` for every such head.

    The image is the mean image, the range view the mean range of the pixels that return in more than half of the
    frames (a hole elsewhere); an occupied voxel has the log-odds of its frequency among the frames that know it.

    Args:
      mean: of the training frames.
      config: says which heads there are, and the units.
    """
    prediction = mean.prediction()
    full: dict[str, Any] = {}
    if "image" in config.heads:
        full["image"] = labels.image_labels(np.round(255.0 * prediction["image"]).astype(np.uint8))
    if "range_view" in config.heads:
        view = prediction["range_view"] / np.float32(config.range_scale_m)
        if config.range_view_points == "beams":
            view[..., :3] = 0.0
        full["range_view"] = labels.range_view_labels(view)
    if "occupancy" in config.heads and mean.occupied is not None and mean.known is not None:
        full["occupancy"] = {scale: _log_odds(mean.occupied[scale], mean.known[scale]) for scale in labels.SCALES}
    return {outputs.first_guess_path(head): {f"scale_{scale}": np.asarray(value, np.float32)
                                             for scale, value in scales.items()} for head, scales in full.items()}


def _log_odds(occupied: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Logits [..., 2] of voxels that are occupied in so many frames of those that know them."""
    share = (occupied + 0.25 * _PRIOR_FRAMES) / (known + _PRIOR_FRAMES)
    return np.stack([np.zeros(share.shape), np.log(share) - np.log1p(-share)], axis=-1).astype(np.float32)


def fill(state: state_lib.TrainState, mean: baselines.TrainingMean, config: config_lib.ModelConfig,
         plan: parallel_lib.Plan) -> state_lib.TrainState:
    """`state` with the constants of `mean`, placed as `plan` says."""
    batch_stats = {**state.batch_stats}
    if not isinstance(config.first_guess, config_lib.ZeroGuess):
        batch_stats |= constants(mean, config)
    if config.action_path == "recurrence" and mean.action is not None:
        spread = np.sqrt(mean.action / mean.frames)
        batch_stats["transition"] = {**batch_stats.get("transition", {}),
                                     "action_spread": np.maximum(spread, _LEAST_SPREAD).astype(np.float32)}
    return parallel_lib.place_state(plan, dataclasses.replace(state, batch_stats=batch_stats))
