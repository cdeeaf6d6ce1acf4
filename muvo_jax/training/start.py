"""The state that a run starts from: a fresh one, another run's weights, or what its newest checkpoint holds."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.data import pipeline
from muvo_jax.training import (
    checkpoint,
    first_guess,
    preparation,
    run_folder,
    screen,
    transfer,
    validation,
)
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import state as state_lib

Pretrained = Callable[[types.Variables, config_lib.ModelConfig], tuple[types.Variables, tuple[str, ...]]]


def first(init: pathlib.Path | None, pretrained: Pretrained | None, show: screen.Screen, config: config_lib.Config,
          ready: preparation.Prepared, frames: pipeline.Frames) -> state_lib.TrainState:
    """The state of step 0: weights of the run `init`, or fresh ones, some of which `pretrained` replaces.

    Raises:
      CheckpointError: where `init` has no checkpoint that can be read.
      ValueError: where its weights, or those of `pretrained`, belong to another network.
    """
    if init:
        return _from_run(init, show, config, ready, frames)
    state = ready.state
    if pretrained is not None:
        variables, notes = pretrained(state.variables, config.model)
        for note in notes:
            show.field("loaded", note)
        state = ready.with_variables(variables, config)
    if not isinstance(config.model.first_guess, config_lib.ZeroGuess) or config.model.action_path == "recurrence":
        return first_guess.fill(state, validation.training_sums(frames), config.model, ready.step.plan)
    return state


def resume(keeper: checkpoint.Checkpoints, show: screen.Screen, config: config_lib.Config, ready: preparation.Prepared,
           make_first: Callable[[], state_lib.TrainState]) -> tuple[state_lib.TrainState, int, Any]:
    """The newest readable checkpoint of a run, or `make_first()` where it has none yet.

    Later checkpoints, all of them damaged, are set aside, and records of later steps are forgotten.

    Returns:
      state, steps done, position in the data (None: its start).

    Raises:
      CheckpointError: where there are checkpoints and none can be read.
      ValueError: where they belong to another architecture.
    """
    folder = keeper.run_folder
    restored = keeper.restore_latest(ready.state, config)
    if restored is None:
        show.warn(f"{folder} has no checkpoint yet: training starts at step 0.")
        run_folder.forget_after(folder, 0)
        return make_first(), 0, None
    for text in restored.warnings:
        show.warn(text)
    for moved in keeper.set_aside([step for step in keeper.steps() if step > restored.step]):
        show.warn(f"moved the damaged checkpoint to {moved}.")
    run_folder.forget_after(folder, restored.step)
    show.field("resumed", f"from step {restored.step}")
    opt_state = optimizer_lib.with_constants(restored.state.opt_state, ready.state.opt_state)
    return restored.state.replace(opt_state=opt_state), restored.step, restored.data_state


def _from_run(run: pathlib.Path, show: screen.Screen, config: config_lib.Config, ready: preparation.Prepared,
              frames: pipeline.Frames) -> state_lib.TrainState:
    """A state at step 0 with the weights of another run."""
    loaded = checkpoint.load_run(run)
    for text in loaded.warnings:
        show.warn(text)
    variables, taken = loaded.variables, ""
    wanted = ready.state.variables
    if (config.model.numerics != loaded.config.model.numerics
            or transfer.shapes(loaded.variables) != transfer.shapes(wanted)):
        variables = transfer.to_recording(loaded, config, wanted, frames)
        taken = ", as far as inputs and heads are the same; average frames are this recording's"
    show.field("weights", f"of step {loaded.step} of {run}{taken}")
    return ready.with_variables(variables, config)
