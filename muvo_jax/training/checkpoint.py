"""Checkpoints: Orbax, wrapped once, with proof that what is on disk can be read.

A checkpoint is one folder per step with three items, `variables` (all that inference needs), `training` (optimizer
state, run key, step) and `meta` (config, action contract, package versions, where the data came from, position in the
data), and a list of the SHA-256 of every file, written last. A folder without that list, or with a file that differs
from it, was interrupted or damaged; `restore_latest` then takes the one before and says so.

Training goes on while a checkpoint is written: `save` returns once the state is copied. The checkpoints before stay
until the new one is whole.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import logging
import os
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import jax
import orbax.checkpoint as ocp

from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax import types
from muvo_jax.model import world_model
from muvo_jax.training import builtin, checkpoint_meta, integrity, screen, together

FOLDER = "checkpoints"
_preservation = ocp.checkpoint_managers


class CheckpointError(OSError):
    """A checkpoint could not be written or read; the message names it and what to do."""


@dataclasses.dataclass(frozen=True)
class Restored:
    """A restored training state.

    Attributes:
      state: like the one that was asked for.
      step: updates done.
      data_state: position in the data, as it was given to `save`; None where none was.
      meta: everything else that was stored.
      warnings: what was passed over on the way, for the user to read.
    """

    state: Any
    step: int
    data_state: Any
    meta: Mapping[str, Any]
    warnings: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class _Writing:
    """A save under way: of which step, and what becomes of it."""

    step: int
    outcome: concurrent.futures.Future


class Checkpoints:
    """The checkpoints of one run: RUN/checkpoints/STEP. Several processes call the same methods together.

    Attributes:
      saved: the newest step that this object knows to be written whole; None where there is none yet.
    """

    def __init__(self, run_folder: str | os.PathLike, *, keep_last: int = 2, keep_best: int = 1):
        """Keeps the `keep_last` newest (at least two: a damaged one needs a predecessor) and the best by score."""
        _quiet()
        self.run_folder = pathlib.Path(run_folder).expanduser().resolve()
        self.folder = self.run_folder / FOLDER
        self._policy = _preservation.AnyPreservationPolicy([
            _preservation.LatestN(max(2, keep_last)),
            _preservation.BestN(get_metric_fn=_score, n=keep_best, keep_checkpoints_without_metrics=False)])
        self._manager = self._open()
        self._background = concurrent.futures.ThreadPoolExecutor(1, "checkpoints")
        self._writing: _Writing | None = None
        self.saved: int | None = None

    def _open(self) -> ocp.CheckpointManager:
        barrier = together.SavingBarrier() if jax.process_count() > 1 else None
        options = ocp.CheckpointManagerOptions(preservation_policy=self._policy, create=True,
                                               cleanup_tmp_directories=True,
                                               async_options=ocp.AsyncOptions(barrier_sync_fn=barrier),
                                               best_fn=_score)  # or scores would not be there when a run goes on
        return ocp.CheckpointManager(self.folder, options=options, item_names=("variables", "training", "meta"))

    def steps(self) -> list[int]:
        """Steps that have a folder, oldest first, whether readable or not."""
        return _steps(self.folder)

    def save(self, step: int, state, *, config: config_lib.Config, data_state=None, score: float | None = None,
             provenance: Mapping[str, Any] | None = None) -> None:
        """Starts to write one checkpoint, once the one before is there; `wait` ends when it is.

        The state may be changed or donated as soon as this returns. The checkpoint counts as readable only once its
        checksums are there.

        Args:
          step: updates done.
          state: a TrainState.
          config: of the run.
          data_state: position in the data (JSON types or bytes).
          score: the higher the better; keeps the best. None: never kept for being best.
          provenance: what the data is.

        Raises:
          CheckpointError: where writing failed (disk full), of this one or of the one before; earlier checkpoints stay
            untouched.
        """
        self.wait()
        meta = checkpoint_meta.describe(step, config, provenance, data_state, score)
        items = ocp.args.Composite(
            variables=ocp.args.StandardSave({"params": state.params, "batch_stats": state.batch_stats}),
            training=ocp.args.StandardSave({"opt_state": state.opt_state, "key": state.key, "step": state.step}),
            meta=ocp.args.JsonSave(meta))
        try:
            if together.any_of((self.folder / str(step)).exists()):  # an interrupted or damaged save of the same step
                self.set_aside([step])
            self._manager.save(step, args=items, metrics=None if score is None else {"score": score}, force=True)
        except Exception as error:
            self._failed(step, error)
        self._writing = _Writing(step, self._background.submit(self._seal, step))

    def _seal(self, step: int) -> None:
        self._manager.wait_until_finished()
        if together.is_first():
            integrity.seal(self.folder / str(step))

    def check(self) -> None:
        """Raises CheckpointError where the save under way is known to have failed."""
        if self._writing is not None and self._writing.outcome.done() and self._writing.outcome.exception():
            self.wait()

    def wait(self) -> None:
        """Returns once nothing is being written any more.

        Raises:
          CheckpointError: where writing failed.
        """
        writing, self._writing = self._writing, None
        if writing is None:
            return
        try:
            writing.outcome.result()
            together.wait_for_all("the checkpoint is sealed")
        except Exception as error:
            self._failed(writing.step, error)
        self.saved = writing.step

    def _failed(self, step: int, error: Exception) -> NoReturn:
        """Orbax and TensorStore raise OSError, ValueError or RuntimeError for a full disk."""
        if together.is_loss(error):
            raise error
        if together.is_first():
            shutil.rmtree(self.folder / str(step), ignore_errors=True)
            self._discard_partial_saves()
        kept = [str(other) for other in self.steps() if integrity.damage(self.folder / str(other)) is None]
        raise CheckpointError(
            f"checkpoint of step {step} could not be written to {self.folder}: {screen.said(error)}. Is the disk full, "
            f"or the folder read-only? Readable checkpoints: {', '.join(kept) or 'none'}. Mend that and go on with "
            f"--resume.") from error

    def _discard_partial_saves(self) -> None:
        for path in self.folder.glob("*orbax-checkpoint-tmp*"):
            shutil.rmtree(path, ignore_errors=True)
        if jax.process_count() == 1:  # several open it together, and the others are not here
            self._manager = self._open()

    def restore_latest(self, like, config: config_lib.Config) -> Restored | None:
        """Restores the newest readable checkpoint onto the devices of `like`, whatever devices wrote it.

        Args:
          like: a TrainState of the right structure, shapes and placement.
          config: of the run that goes on; its model must be the stored one.

        Returns:
          None where there is no checkpoint at all.

        Raises:
          CheckpointError: where there are checkpoints but none can be read.
          ValueError: where they belong to another architecture, or other parameters trained; names both.
        """
        self.wait()
        warnings: list[str] = []
        abstract = jax.tree.map(_abstract, like)
        for step in reversed(self.steps()):
            path = self.folder / str(step)
            described = checkpoint_meta.trusted(path)
            if isinstance(described, str):
                reason = described
            else:
                meta, stored = described
                checkpoint_meta.check_resumable(config, stored, str(path))
                try:
                    state = self._restore(step, abstract, like)
                except Exception as error:  # whatever Orbax raises: the checkpoint before may still be good
                    reason = f"it cannot be restored ({screen.said(error)})"
                else:
                    self.saved = step
                    return Restored(state, step, checkpoint_meta.read_data_state(meta), meta, tuple(warnings))
            warnings.append(f"checkpoint {path} is damaged: {reason}; trying the one before.")
        if warnings:
            raise CheckpointError(f"no readable checkpoint in {self.folder}: " + " ".join(warnings))
        return None

    def _restore(self, step: int, abstract, like):
        items = ocp.args.Composite(
            variables=ocp.args.StandardRestore({"params": abstract.params, "batch_stats": abstract.batch_stats}),
            training=ocp.args.StandardRestore({"opt_state": abstract.opt_state, "key": abstract.key,
                                               "step": abstract.step}))
        restored = self._manager.restore(step, args=items)
        return like.replace(**restored.variables, **restored.training)

    def set_aside(self, steps: Sequence[int]) -> list[pathlib.Path]:
        """Moves damaged checkpoints out of the way; returns where to, in the first process."""
        moved = [integrity.set_aside(self.folder / str(step), self.run_folder) for step in steps if together.is_first()]
        together.wait_for_all("damaged checkpoints are set aside")
        self._manager.reload()
        return moved

    def close(self) -> None:
        """Lets a save under way end, well or not: `wait` first to know."""
        self._background.shutdown()
        self._manager.close()


def save_variables(run_folder: str | os.PathLike, step: int, variables: types.Variables, *, config: config_lib.Config,
                   provenance: Mapping[str, Any] | None = None) -> pathlib.Path:
    """Writes a checkpoint for inference and for `train --init`, without the state of an optimiser.

    Args:
      run_folder: RUN; the checkpoint becomes RUN/checkpoints/STEP.
      step: updates that made the variables.
      variables: {"params", "batch_stats"}; NumPy arrays may be memory-mapped.
      config: of the model.
      provenance: where the variables come from.

    Raises:
      OSError: where it cannot be written.
    """
    _quiet()
    folder = pathlib.Path(run_folder).expanduser().resolve() / FOLDER / str(step)
    folder.mkdir(parents=True)
    with ocp.StandardCheckpointer() as writer:
        writer.save(folder / "variables", {"params": variables["params"], "batch_stats": variables["batch_stats"]})
    with ocp.Checkpointer(ocp.JsonCheckpointHandler()) as writer:
        writer.save(folder / "meta", checkpoint_meta.describe(step, config, provenance))
    integrity.seal(folder)
    return folder


def load_run(run: str | os.PathLike, which: int | str = "latest") -> run_lib.Run:
    """Loads a trained model for inference onto the first device of this process, wherever it was trained.

    Args:
      run: a run's folder, or "builtin:town" (training/builtin.py).
      which: "latest", "best" (highest validation score) or a step.

    Raises:
      CheckpointError: where there is no run, no such checkpoint, or none that can be read.
      ValueError: where it was written by a version with an unknown schema or configuration, or ships with none.
    """
    if isinstance(which, str) and which.isdecimal():
        which = int(which)
    if (name := builtin.named(run)) is not None:
        shipped = builtin.load(name)
        if which not in ("latest", "best", shipped.step):
            raise CheckpointError(f"{builtin.PREFIX}{name} has step {shipped.step} alone, not {which}.")
        return shipped
    folder = pathlib.Path(run).expanduser().resolve()
    checkpoints = folder / FOLDER
    found = _steps(checkpoints)
    if not found:
        state = ("has no checkpoint yet" if folder.is_dir() else "is a file, and no run's folder" if folder.exists()
                 else "does not exist")
        raise CheckpointError(f"{folder} {state}; expected {checkpoints}/STEP. Train first: python -m muvo_jax.train.")
    step, (meta, config), warnings = _readable(checkpoints, found, which)
    model = world_model.WorldModel(config.model)
    variables = _restore_variables(checkpoints / str(step), model)
    return run_lib.Run(model, variables, config, step, folder, meta["provenance"], tuple(warnings))


def _readable(checkpoints: pathlib.Path, found: list[int], which: int | str) -> tuple[
        int, tuple[dict[str, Any], config_lib.Config], list[str]]:
    """The step that is meant, its description and config, and what to say of damaged ones that it might have been."""
    held = ", ".join(map(str, found))
    if which not in ("latest", "best", *found):
        raise CheckpointError(f"{checkpoints} has no step {which}; it has {held}.")
    readable: dict[int, tuple[dict[str, Any], config_lib.Config]] = {}
    warnings = []
    for step in [which] if isinstance(which, int) else found[::-1]:
        path = checkpoints / str(step)
        described = checkpoint_meta.trusted(path)
        if isinstance(described, str):
            warnings.append(f"checkpoint {path} is damaged: {described}; it is passed over.")
        elif which == "best":
            readable[step] = described
        else:
            return step, described, warnings
    if not readable:
        wanted = f"of step {which}" if isinstance(which, int) else "at all"
        raise CheckpointError(f"no readable checkpoint {wanted} in {checkpoints}, which has {held}: "
                              + " ".join(warnings))
    scored = {step: meta["score"] for step, (meta, _) in readable.items() if meta["score"] is not None}
    if not scored:
        warnings.append(f"no checkpoint in {checkpoints} has a score; the newest is taken for the best.")
    best = max(scored or readable, key=lambda step: scored.get(step, step))
    return best, readable[best], warnings


def _score(metrics: Mapping[str, float]) -> float:
    return metrics["score"]


def _quiet() -> None:
    """Orbax reports every step of its work, warns of metadata that a single item lacks, and logs what it raises."""
    logging.getLogger("absl").setLevel(logging.CRITICAL)


def _restore_variables(path: pathlib.Path, model: world_model.WorldModel) -> types.Variables:
    """Raises CheckpointError where a checkpoint's variables cannot be read, or are not those of the model."""
    _quiet()
    folder = path / "variables"
    with ocp.StandardCheckpointer(multiprocessing_options=checkpoint_meta.alone()) as reader:
        try:
            tree = reader.metadata(folder).item_metadata.tree
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(f"checkpoint {path} is damaged: what {folder} holds cannot be read "
                                  f"({screen.said(error)}). Take another --checkpoint.") from error
        _check_shapes(path, tree, model.variable_shapes())
        return reader.restore(folder, jax.tree.map(_on_first_device, tree))


def _check_shapes(path: pathlib.Path, stored, expected) -> None:
    found = {jax.tree_util.keystr(keys): tuple(leaf.shape)
             for keys, leaf in jax.tree_util.tree_leaves_with_path(stored)}
    for keys, leaf in jax.tree_util.tree_leaves_with_path(expected):
        name = jax.tree_util.keystr(keys)
        if found.get(name) != leaf.shape:
            came = f"is {list(found[name])}" if name in found else "is missing"
            raise CheckpointError(f"checkpoint {path} is damaged: of its variables {name} {came}, and the model of its "
                                  f"config has {list(leaf.shape)} there. Take another --checkpoint.")


def _on_first_device(leaf) -> jax.ShapeDtypeStruct:
    sharding = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)


def _abstract(leaf):
    sharding = getattr(leaf, "sharding", None) or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)


def _steps(folder: pathlib.Path) -> list[int]:
    """Of the folders that are named as a save names them; 007 and ² are none."""
    named = [path.name for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    return sorted(int(name) for name in named if name.isascii() and name.isdecimal() and str(int(name)) == name)
