"""What a checkpoint says of itself: schema, configuration, action contract, package versions, position in the data."""

from __future__ import annotations

import base64
import dataclasses
import importlib.metadata
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import orbax.checkpoint as ocp

from muvo_jax import config as config_lib
from muvo_jax.config import settings
from muvo_jax.training import integrity

SCHEMA_VERSION = 1
_READ = frozenset({"schema_version", "config", "packages", "provenance", "data_state", "score"})
_PACKAGES = ("muvo_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


class DescriptionError(ValueError):
    """A stored description is none; the message goes on from the checkpoint's name."""


def describe(step: int, config: config_lib.Config, provenance: Mapping[str, Any] | None, data_state=None,
             score: float | None = None) -> dict[str, Any]:
    """What is stored, as JSON types; arguments as `checkpoint.Checkpoints.save`."""
    return {"schema_version": SCHEMA_VERSION, "step": step, "variant": config.model.variant,
            "config": config.to_dict(), "contract": dataclasses.asdict(config.contract),
            "packages": package_versions(), "provenance": dict(provenance or {}),
            "data_state": _encode(data_state), "score": score}


def read(folder: pathlib.Path) -> dict[str, Any]:
    """The stored description of a checkpoint.

    Raises:
      DescriptionError: where there is none, or not what `describe` makes.
      ValueError: for an unknown schema version.
    """
    try:
        with ocp.Checkpointer(ocp.JsonCheckpointHandler(), multiprocessing_options=alone()) as reader:
            meta = reader.restore(folder / "meta")
    except (OSError, ValueError, RecursionError) as error:
        raise DescriptionError(f"its description in meta/ cannot be read ({error})") from error
    if not isinstance(meta, dict):
        raise DescriptionError(f"its description in meta/ is a {type(meta).__name__}, not an object of JSON")
    if meta.get("schema_version", SCHEMA_VERSION) != SCHEMA_VERSION:
        writer = meta.get("packages", {}).get("muvo_jax")
        raise ValueError(f"{folder} has checkpoint schema {meta['schema_version']}, this version reads "
                         f"{SCHEMA_VERSION}. It was written by muvo_jax {writer}: use that.")
    if missing := sorted(_READ - meta.keys()):
        raise DescriptionError(f"its description in meta/ lacks {', '.join(missing)}")
    return meta


def trusted(folder: pathlib.Path) -> tuple[dict[str, Any], config_lib.Config] | str:
    """The description and the config of a checkpoint; or why it cannot be trusted.

    Raises:
      ValueError: where it was written by a version with an unknown schema or configuration.
    """
    if (reason := integrity.damage(folder)) is not None:
        return reason
    try:
        meta = read(folder)
        return meta, config_lib.Config.from_dict(meta["config"])
    except DescriptionError as error:
        return str(error)


def alone() -> ocp.options.MultiprocessingOptions:
    """For Orbax: what this process reads it reads without the others, if there are any."""
    process = jax.process_index()
    return ocp.options.MultiprocessingOptions(primary_host=process, active_processes={process},
                                              barrier_sync_key_prefix=f"alone_{process}")


def read_data_state(meta: Mapping[str, Any]) -> Any:
    """The position in the data as it was given to `describe`; None where none was."""
    stored = meta["data_state"]
    is_bytes = isinstance(stored, dict) and set(stored) == {"base64"}
    return base64.b64decode(stored["base64"]) if is_bytes else stored


def _encode(data_state):
    return {"base64": base64.b64encode(data_state).decode()} if isinstance(data_state, bytes) else data_state


def check_architecture(wanted: config_lib.Config, stored: config_lib.Config, where: str) -> None:
    """Raises ValueError naming both where the two configs describe different networks.

    What an action does (model.kinematics) is the recording's, not the network's.
    """
    ours, theirs = (settings.names(dataclasses.asdict(dataclasses.replace(config.model, kinematics=None)))
                    for config in (wanted, stored))
    if ours == theirs:
        return
    fields = [f"{name} {theirs.get(name, 'none')!r} (stored) against {ours.get(name, 'none')!r} (asked for)"
              for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
    raise ValueError(f"{where} holds another architecture: it is {stored.model.variant} of preset {stored.preset!r}, "
                     f"asked for is {wanted.model.variant} of preset {wanted.preset!r}. Different: "
                     f"{'; '.join(fields)}. Use the run's own settings, or a new --name.")


def check_resumable(wanted: config_lib.Config, stored: config_lib.Config, where: str) -> None:
    """As `check_architecture`, and ValueError where the optimiser's state is another: of other parameters, or kept in
    another way."""
    check_architecture(wanted, stored, where)
    for name, of, as_kept in (("train.trainable", lambda config: config.train.trainable, str),
                              ("train.share_state", lambda config: config.train.share_state, bool),
                              ("optimizer.clip_norm", lambda config: config.optimizer.clip_norm, bool)):
        ours, theirs = of(wanted), of(stored)
        if as_kept(ours) != as_kept(theirs):
            raise ValueError(f"{where} was trained with {name}={theirs}, and cannot go on with {ours}: the optimiser's "
                             f"state belongs to what trains and how. Start another run from its weights, with --init "
                             f"and a new --name.")


def package_versions() -> dict[str, str | None]:
    """Versions of the packages that a run depends on; None where a package is not installed as one."""
    def version(name):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            return None
    return {name: version(name) for name in _PACKAGES}
