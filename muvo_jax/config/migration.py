"""config.json of earlier versions: what was called what, and how old values become today's.

    version 1    no config_version; model is one flat list of fields, its parts are named by text
    version 2    model.latent, fusion, lidar, camera and first_guess are parts: {"kind": "2d", ...} or null
    version 3    train.remat is a policy, "none", "heads" or "frames"; it was false or true
"""

from __future__ import annotations

import dataclasses
from typing import Any

from muvo_jax.config import parts
from muvo_jax.config.parsing import check_choice

VERSION = 3
VERSION_FIELD = "config_version"

# Field of version 1's model -> part and field of version 2. Where the part is of a kind without such a field, it did
# nothing, and is left out.
MOVED = {
    "token_channels": "fusion.token_channels",
    "transformer_layers": "fusion.layers",
    "transformer_heads": "fusion.heads",
    "transformer_hidden_channels": "fusion.hidden_channels",
    "dropout": "fusion.dropout",
    "many_tokens": "fusion.many_tokens",
    "map_channels": "fusion.map_channels",
    "embedding_channels": "latent.embedding_channels",
    "fused_channels": "latent.fused_channels",
    "keep_cells": "latent.keep_cells",
    "deterministic_channels": "latent.deterministic_channels",
    "stochastic_channels": "latent.stochastic_channels",
    "action_channels": "latent.action_channels",
    "occupancy_blocks": "latent.occupancy_blocks",
    "transition_layers": "latent.transition_layers",
    "aligned_tokens": "latent.aligned_tokens",
    "occupancy_token_stages": "latent.occupancy_token_stages",
    "memory_frames": "first_guess.memory_frames",
    "guided_channels": "first_guess.guided_channels",
    "pillars": "lidar.grid",
    "birds_eye": "camera.grid",
}
# Part -> its kinds and what version 1 had where it was not given.
_PARTS: dict[str, tuple[Any, str]] = {
    "latent": (parts.Latent, "1d"), "fusion": (parts.Fusion, "tr"), "lidar": (parts.Lidar, "rv"),
    "camera": (parts.Camera, "wob"), "first_guess": (parts.FirstGuess, "zero")}


def to_current(values: Any) -> Any:
    """What `Config.to_dict` of any version gave as that of this version gives it, without its version.

    Raises:
      ValueError: for a version from the future, or a kind of a part that never was.
    """
    if not isinstance(values, dict):
        return values  # parse says what is wrong
    version = values.get(VERSION_FIELD, 1)
    values = {name: value for name, value in values.items() if name != VERSION_FIELD}
    if version not in (1, 2, VERSION):
        raise ValueError(f"config: {VERSION_FIELD} is {version!r}, and this version of muvo_jax reads 1 to {VERSION}. "
                         f"Use the muvo_jax that wrote it.")
    if version == 1:
        values = _from_1(values)
    return values if version == VERSION else _from_2(values)


def new_name(dotted: str) -> str | None:
    """Today's name of a setting of version 1, "model.latent.keep_cells" for "model.keep_cells"; None for others."""
    section, _, rest = dotted.partition(".")
    field, dot, below = rest.partition(".")
    return f"model.{MOVED[field]}{dot}{below}" if section == "model" and field in MOVED else None


def _from_1(values: dict[str, Any]) -> dict[str, Any]:
    """A contract that says nothing of step_action is of a run from before there was a choice: it took the first."""
    changes: dict[str, Any] = {}
    if isinstance(values.get("contract"), dict):
        changes["contract"] = {"step_action": "first"} | values["contract"]
    if isinstance(values.get("model"), dict):
        changes["model"] = _model_from_1(values["model"])
    return values | changes


def _from_2(values: dict[str, Any]) -> dict[str, Any]:
    train = values.get("train")
    if not isinstance(train, dict) or not isinstance(train.get("remat"), bool):
        return values
    return values | {"train": train | {"remat": "frames" if train["remat"] else "none"}}


def _model_from_1(model: dict[str, Any]) -> dict[str, Any]:
    current = {name: value for name, value in model.items() if name not in MOVED}
    for name, (hint, usual) in _PARTS.items():
        kind, known = model.get(name, usual), parts.kinds(hint)
        optional = (parts.NO_SENSOR,) if name in ("lidar", "camera") else ()
        check_choice(f"config.model.{name}", kind, (*known, *optional))
        if kind == parts.NO_SENSOR:
            current[name] = None
            continue
        fields = {field.name for field in dataclasses.fields(known[kind])}
        moved = {new.partition(".")[2]: model[old] for old, new in MOVED.items()
                 if old in model and new.startswith(f"{name}.")}
        current[name] = {"kind": kind} | {field: value for field, value in moved.items() if field in fields}
    return current
