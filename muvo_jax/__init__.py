"""MUVO, a multimodal generative world model for driving, in JAX.

    run = muvo_jax.load("runs/town-tr")
    batch = muvo_jax.windows(run, frames=6)
    observed = muvo_jax.observe(run.model, run.variables, key, batch)
    dream = muvo_jax.imagine(run.model, run.variables, key, observed.last, actions)
    predictions = muvo_jax.decode(run.model, run.variables, dream.states, ("image",), memory=observed.memory)
    predictions.image, predictions.at_scale(2).image

Everything is a pure function of explicit pytrees, with arguments in one order: (model, variables, key, what goes in);
see docs/design.md.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from muvo_jax import presets
    from muvo_jax.agents.environment import Environment
    from muvo_jax.config import Config, ModelConfig
    from muvo_jax.model.live import LiveState, observe_step, start_live
    from muvo_jax.model.rollout import decode, imagine, imagine_step, observe
    from muvo_jax.model.world_model import WorldModel
    from muvo_jax.run import Run
    from muvo_jax.types import Batch, Dream, LatentState, Observed, Predictions

__all__ = [
    "Batch", "Config", "Dream", "Environment", "LatentState", "LiveState", "ModelConfig", "Observed", "Predictions",
    "Run", "WorldModel", "decode", "imagine", "imagine_step", "load", "observe", "observe_step", "presets",
    "start_live", "windows",
]

# Where names come from. Each is imported when it is first used: a command's --help needs no JAX.
_MODULES = ("agents", "config", "geometry", "model", "nn", "ops", "presets", "types")
_HOMES = {
    "agents.environment": ("Environment",),
    "config": ("Config", "ModelConfig"),
    "model.live": ("LiveState", "observe_step", "start_live"),
    "model.rollout": ("decode", "imagine", "imagine_step", "observe"),
    "model.world_model": ("WorldModel",),
    "run": ("Run",),
    "types": ("Batch", "Dream", "LatentState", "Observed", "Predictions"),
}


def __getattr__(name):
    if name in _MODULES:
        return importlib.import_module(f"muvo_jax.{name}")
    for home, names in _HOMES.items():
        if name in names:
            globals()[name] = getattr(importlib.import_module(f"muvo_jax.{home}"), name)
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return sorted({*globals(), *__all__})


def load(run, checkpoint="latest"):
    """Loads a trained run: `load("runs/town-tr") -> Run`.

    Args:
      run: folder that `python -m muvo_jax.train` wrote, or "builtin:town", a trained model that ships with the package.
      checkpoint: "latest", "best" (skill of imagined frames) or a step.

    Raises:
      muvo_jax.training.checkpoint.CheckpointError: if there is no such run or checkpoint, or none that can be read.
      ValueError: if another version wrote it, with a schema or settings that this one does not know, or if no model of
        that name ships.
    """
    from muvo_jax.training.checkpoint import load_run  # imported late: imagining needs no checkpoint library

    return load_run(run, checkpoint)


def windows(run, split=None, *, count=2, frames=None):
    """Windows of the recording that a run was trained on: `windows("runs/town-tr") -> Batch [count, frames, ...]`.

    Args:
      run: a Run, or the folder that `python -m muvo_jax.train` wrote.
      split: by default the first one that validates ("val_rl" of the town).
      count: how many windows, evenly spread over the split.
      frames: of each window, by default those of the run's evaluation (context and horizon).

    Raises:
      muvo_jax.training.checkpoint.CheckpointError: if the folder holds no readable checkpoint.
      muvo_jax.data.schema.DataError: if the recording is gone, lacks the split, or has fewer windows of that length.
      ValueError: for a count or frames below 1.
    """
    from muvo_jax.training import validation  # imported late, as above

    return validation.windows_of_run(run, split, count=count, frames=frames)
