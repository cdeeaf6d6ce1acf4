"""Trained models that ship with the package, by name: "builtin:town" wherever a run's folder is asked for.

A model is a folder of muvo_jax/builtin: weights.safetensors (parameters in bfloat16, running statistics and average
frames in float32), config.json, and card.json, which says what the model was trained on, how well it does, and the
checksum of the weights. docs/models.md is the page about them.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax import safetensors_file
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint_meta

PREFIX = "builtin:"
FOLDER = pathlib.Path(config_lib.__file__).parents[1] / "builtin"
WEIGHTS, CONFIG, CARD = "weights.safetensors", "config.json", "card.json"
_BY_DTYPE = {"params": jnp.bfloat16, "batch_stats": jnp.float32}


class BuiltinError(ValueError):
    """There is no such model, or its files are damaged; the message names it and what to do."""


def named(run: str | os.PathLike) -> str | None:
    """The name of a model that ships with the package, where `run` is one and no folder: "town" of "builtin:town"."""
    text = os.fspath(run)
    return text.removeprefix(PREFIX) if text.startswith(PREFIX) else None


def load(name: str) -> run_lib.Run:
    """A model that ships with the package, its parameters as float32. Commands write into runs/builtin-NAME.

    Raises:
      BuiltinError: for an unknown name (naming the nearest known one), and for files that are missing or damaged.
    """
    known = sorted(path.parent.name for path in FOLDER.glob(f"*/{CARD}"))
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise BuiltinError(f"{PREFIX}{name}: no such model ships with muvo_jax; there is {', '.join(known) or 'none'}."
                           + (f" Did you mean {PREFIX}{near[0]}?" if near else ""))
    folder = FOLDER / name
    try:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
        config = config_lib.Config.from_dict(json.loads((folder / CONFIG).read_text(encoding="utf-8")))
        stored = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
        if stored != card["weights_sha256"]:
            raise ValueError(f"{WEIGHTS} has the SHA-256 {stored}, {CARD} says {card['weights_sha256']}")
        flat = safetensors_file.load(folder / WEIGHTS)
    except (OSError, ValueError, KeyError) as error:
        raise BuiltinError(f"{PREFIX}{name} is damaged ({folder}: {error}). Install muvo_jax again.") from error
    tree = traverse_util.unflatten_dict({path: value.astype(np.float32) for path, value in flat.items()}, sep="/")
    variables = jax.tree.map(jnp.asarray, {kind: tree.get(kind, {}) for kind in _BY_DTYPE})
    return run_lib.Run(world_model.WorldModel(config.model), variables, config, card["step"],
                       pathlib.Path("runs", f"builtin-{name}").resolve(), card["provenance"])


def seal(run: run_lib.Run, folder: str | os.PathLike, card: Mapping[str, Any]) -> pathlib.Path:
    """Writes a run as a model that ships with the package; the card last.

    Args:
      run: what is sealed.
      folder: made where it is missing.
      card: what card.json says beside step, provenance, versions and checksum; JSON types.

    Returns:
      the folder.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CARD).unlink(missing_ok=True)
    flat = {f"{kind}/{path}": np.asarray(value).astype(_BY_DTYPE[kind])
            for kind, tree in jax.device_get(dict(run.variables)).items()
            for path, value in traverse_util.flatten_dict(tree, sep="/").items()}
    safetensors_file.save(folder / WEIGHTS, flat)
    (folder / CONFIG).write_text(json.dumps(run.config.to_dict(), indent=1) + "\n", encoding="utf-8")
    described = {"variant": run.model.config.variant, "step": run.step, "provenance": dict(run.provenance),
                 "packages": checkpoint_meta.package_versions(), **card,
                 "weights_sha256": hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()}
    (folder / CARD).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return folder
