"""A trained model for another recording: one that lacks an input of the old one, and has another average frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax import types
from muvo_jax.data import pipeline
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint_meta, first_guess, validation


def to_recording(loaded: run_lib.Run, config: config_lib.Config, wanted: types.Variables,
                 frames: pipeline.Frames) -> types.Variables:
    """The variables of a run for a network that lacks route, navigation or speed among its inputs, or has other heads.

    What the old network knows of these is left out, and a head that it lacks starts fresh; the average frame and the
    spread of actions are measured on the training frames, as a fresh model's are. Everything else stays.

    Args:
      loaded: what is taken over.
      config: of the new run, fitted to the recording.
      wanted: the new network's fresh variables.
      frames: of the recording.

    Raises:
      ValueError: naming both networks where they differ in anything else.
    """
    params = _taken(loaded, config, wanted)
    fresh = _fresh(loaded, config)
    measured = first_guess.measured(validation.training_sums(frames), config.model)
    stats = {name: {**(value if name in fresh else loaded.variables["batch_stats"].get(name, {})),
                    **measured.get(name, {})} for name, value in wanted["batch_stats"].items()}
    return {"params": params, "batch_stats": stats}


def check(loaded: run_lib.Run, config: config_lib.Config) -> None:
    """Refuses a config whose network cannot start from a run, by shapes alone: before there is data or a step.

    Raises:
      ValueError: as `to_recording`.
    """
    _taken(loaded, config, world_model.WorldModel(config.model).variable_shapes())


def _fresh(loaded: run_lib.Run, config: config_lib.Config) -> set[str]:
    return {f"decoders_{head}" for head in config.model.heads if head not in loaded.config.model.heads}


def _taken(loaded: run_lib.Run, config: config_lib.Config, wanted: types.Variables) -> dict[str, Any]:
    """The parameters of the new network, checked: those of the run, and those of `wanted` where a head is new."""
    fresh = _fresh(loaded, config)
    old = loaded.variables["params"]
    params = {name: value if name in fresh else old[name] for name, value in wanted["params"].items()
              if name in fresh or name in old}
    ours, theirs = _token_kinds(config.model), _token_kinds(loaded.config.model)
    if isinstance(config.model.latent, config_lib.TokenLatent) and set(ours) < set(theirs):
        rows = np.array([theirs.index(kind) for kind in ours])
        params["fusion"] = {**params["fusion"], "type_embedding": params["fusion"]["type_embedding"][rows]}
    if config.model.numerics != loaded.config.model.numerics or shapes(params) != shapes(wanted["params"]):
        checkpoint_meta.check_architecture(config, loaded.config, str(loaded.folder))
    return params


def shapes(tree: Mapping[str, Any]) -> Any:
    """The shape of every leaf."""
    return jax.tree.map(lambda leaf: tuple(leaf.shape), dict(tree))


def _token_kinds(model: config_lib.ModelConfig) -> tuple[str, ...]:
    """What each row of the fusion's type embedding stands for, in its order (world_model, fusion)."""
    names = [name for name in ("camera", "lidar") if getattr(model, name) is not None]
    names += ["route"] if model.route else []
    names += ["command", "next_command", "target"] if model.navigation else []
    return tuple(names + (["speed"] if model.speed else []))

