"""The average training frame as the start of the decoders (config.TrainingMean, model/decoders.py)."""

from __future__ import annotations

import dataclasses

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax.metrics import baselines
from muvo_jax.model import decoders
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib

_LEAST_SPREAD = 0.02  # of an action that hardly ever moves: its noise is not to be made large


def constants(mean: baselines.TrainingMean, config: config_lib.ModelConfig) -> dict[str, dict[str, np.ndarray]]:
    """What `decoders.FirstGuess` adds, in the decoders' raw units: the subtree of `batch_stats` for every such head.

    Args:
      mean: of the training frames.
      config: says which heads there are, and the units.
    """
    averages = {name: average(mean, config) for name in config.heads
                if (average := head_lib.get(name).average) is not None}
    return {decoders.first_guess_path(head): {f"scale_{scale}": np.asarray(value, np.float32)
                                             for scale, value in scales.items()} for head, scales in averages.items()}


def fill(state: state_lib.TrainState, mean: baselines.TrainingMean, config: config_lib.ModelConfig,
         plan: parallel_lib.Plan) -> state_lib.TrainState:
    """`state` with the constants of `mean`, placed as `plan` says."""
    found = measured(mean, config)
    batch_stats = {**state.batch_stats, **{name: {**state.batch_stats.get(name, {}), **values}
                                           for name, values in found.items()}}
    return parallel_lib.place_state(plan, dataclasses.replace(state, batch_stats=batch_stats))


def measured(mean: baselines.TrainingMean, config: config_lib.ModelConfig) -> dict[str, dict[str, np.ndarray]]:
    """All that a model's `batch_stats` hold of its training frames: `constants`, and how large actions usually are."""
    found = {} if isinstance(config.first_guess, config_lib.ZeroGuess) else constants(mean, config)
    if config.action_path == "recurrence" and mean.action is not None:
        spread = np.sqrt(mean.action / mean.frames)
        found["transition"] = {"action_spread": np.maximum(spread, _LEAST_SPREAD).astype(np.float32)}
    return found
