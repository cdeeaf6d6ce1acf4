"""MUVO, a multimodal generative world model for driving, in JAX.

    model, variables = muvo_jax.load("runs/town-tr")
    batch = muvo_jax.windows("runs/town-tr", frames=6)
    observed = muvo_jax.observe(model, variables, key, batch)
    dream = muvo_jax.imagine(model, variables, key, observed.last, actions)
    pictures = muvo_jax.decode(model, variables, dream.states, heads=("image", "occupancy"))

Everything is a pure function of explicit pytrees; see docs/design.md.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from muvo_jax import presets
    from muvo_jax.config import Config, ModelConfig
    from muvo_jax.model.live import LiveState, observe_step, start_live
    from muvo_jax.model.rollout import decode, imagine, observe
    from muvo_jax.model.world_model import WorldModel
    from muvo_jax.types import Batch, Dream, Gaussian, LatentState, Observed

__all__ = [
    "Batch", "Config", "Dream", "Gaussian", "LatentState", "LiveState", "ModelConfig", "Observed", "WorldModel",
    "decode", "imagine", "load", "observe", "observe_step", "presets", "start_live",
    "windows",
]

# Where names come from. Each is imported when it is first used: a command's --help needs no JAX.
_MODULES = ("config", "geometry", "model", "nn", "ops", "presets", "types")
_HOMES = {
    "config": ("Config", "ModelConfig"),
    "model.live": ("LiveState", "observe_step", "start_live"),
    "model.rollout": ("decode", "imagine", "observe"),
    "model.world_model": ("WorldModel",),
    "types": ("Batch", "Dream", "Gaussian", "LatentState", "Observed"),
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


def load(run):
    """Loads a trained run: `load("runs/town-tr") -> (model, variables)`.

    Args:
      run: folder that `python -m muvo_jax.train` wrote.

    Raises:
      muvo_jax.training.checkpoint.CheckpointError: if the folder holds no readable checkpoint.
    """
    from muvo_jax.training import checkpoint  # imported late: imagining needs no checkpoint library

    return checkpoint.load(run)


def windows(run, split=None, *, count=2, frames=None):
    """Windows of the recording that a run was trained on: `windows("runs/town-tr") -> Batch [count, frames, ...]`.

    Args:
      run: folder that `python -m muvo_jax.train` wrote.
      split: by default the first one that validates ("val_rl" of the town).
      count: how many windows, evenly spread over the split.
      frames: of each window, by default those of the run's evaluation (context and horizon).

    Raises:
      muvo_jax.training.checkpoint.CheckpointError: if the folder holds no readable checkpoint.
      muvo_jax.data.schema.DataError: if the recording is gone, lacks the split, or has fewer windows of that length.
    """
    from muvo_jax.training import validation  # imported late, as above

    return validation.windows_of_run(run, split, count=count, frames=frames)
