"""Before a run starts: its data is opened, and the screen says what will be trained on it."""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable, Collection

import jax

from muvo_jax import config as config_lib
from muvo_jax.data import fitting, schema, words
from muvo_jax.objectives import perceptual
from muvo_jax.training import preparation, screen, trainable


def open_data(config: config_lib.Config, open_recording: Callable[[], schema.Recording], keep: Collection[str],
              show: screen.Screen) -> tuple[config_lib.Config, schema.Recording, float]:
    """The config fitted to the data, the data, and how many seconds it took to open (or first to make).

    Args:
      keep: settings, by dotted name, that fitting leaves alone.

    Raises:
      DataError, ValueError: for data that the config does not fit.
    """
    start_s = time.perf_counter()
    recording = open_recording()
    adapted = fitting.adapt(config, recording, keep=keep)
    fitting.check_targets(adapted.config, recording.description)
    description = recording.description
    counts = provenance(recording, adapted.config)["frames"]
    show.field("data", f"{description.name} ({description.kind}, {description.rate_hz:g} Hz), frames: "
                       + ", ".join(f"{split} {count}" for split, count in counts.items()))
    for note in (*description.notes, *adapted.notes):
        show.field("", note)
    return adapted.config, recording, time.perf_counter() - start_s


def introduce(show: screen.Screen, config: config_lib.Config, ready: preparation.Prepared, windows: int,
              frozen: perceptual.FrozenEncoder | None, folder: pathlib.Path) -> None:
    """Says what is trained on how many windows, how, and where it lands."""
    data, accumulate = config.data, config.optimizer.accumulate
    frame_s = data.stride / config.contract.rate_hz
    show.field("windows", f"{windows} of {data.frames} frames, {frame_s:g} s apart; then {data.context} observed and "
                          f"{data.horizon} imagined in evaluation")
    show.field("model", f"{config.model.variant} ({config.model.latent.kind}), {ready.parameters:,} parameters, heads "
                        f"{', '.join(config.model.heads)}")
    if config.train.trainable != trainable.EVERYTHING:
        params = ready.state.params
        trained, _ = trainable.split(params, trainable.chosen(params, config.train.trainable))
        numbers = sum(leaf.size for leaf in jax.tree.leaves(trained))
        show.field("trains", f"{numbers:,} parameters ({config.train.trainable}); the rest is frozen")
    extra = f" x {accumulate} accumulated" if accumulate > 1 else ""
    batch = words.counted(config.train.batch, "window")
    show.field("steps", f"{config.train.steps} of {batch}{extra}, {ready.step.plan.describe()}")
    if frozen is not None:
        show.field("perceptual", f"pictures are compared by {frozen.source}, frozen")
    show.field("run", str(folder))


def provenance(recording: schema.Recording, config: config_lib.Config) -> dict:
    """What a checkpoint remembers of its data."""
    description = recording.description
    frames = {split: sum(sequence.length for sequence in recording.sequences if sequence.split == split)
              for split in description.splits}
    return {"name": description.name, "kind": description.kind, "path": config.data.path, "frames": frames,
            "rate_hz": description.rate_hz, "notes": list(description.notes)}
