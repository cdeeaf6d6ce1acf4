"""python -m muvo_jax.dream RUN: watch a trained model observe, then imagine, beside what really happened."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax import evaluate, recordings, types
    from muvo_jax.data import pipeline, schema, windows
    from muvo_jax.data import prepare as prepare_lib
    from muvo_jax.metrics import baselines, protocol, warp
    from muvo_jax.model import rollout, world_model
    from muvo_jax.training import run_folder, screen
    from muvo_jax.viz import page, rerun_log, sheets

DREAMS_FOLDER = "dreams"
MOST_COLUMNS = 3  # predictions beside the truth in one animation


@dataclasses.dataclass(frozen=True)
class Options:
    """Observes the first frames of a recorded sequence, imagines the rest under its actions, and draws both.

    Writes an animation (GIF), two sheets (PNG) of camera and range image and of points and voxels in space, and a page
    (HTML) with sliders over time and futures, which any browser opens.
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    data: Annotated[str | None, command_line.shown("PATH", "the run's")] = None
    """Another recording than the one that the run was trained on."""
    split: Annotated[str | None, command_line.shown("NAME", "the first validation split")] = None
    """Where to look for a sequence."""
    sequence: Annotated[str | None, command_line.shown("NAME", "the longest of the split")] = None
    """Name of the recorded run."""
    start: Annotated[int | None, command_line.shown("N", "middle of the sequence")] = None
    """First frame to observe, counted from the sequence's start."""
    context: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Frames to observe."""
    horizon: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Frames to imagine."""
    branches: int = 1
    """Futures to sample; 1 takes the mean of each latent."""
    seed: int = 0
    """Of the sampled futures."""
    moments: int = 8
    """At most so many frames on the sheets, evenly spread, the last one included."""
    out: Annotated[pathlib.Path | None, command_line.shown("PATH", "RUN/dreams")] = None
    """Where to write."""
    rerun: Annotated[pathlib.Path | None, command_line.shown("FILE.rrd", "none")] = None
    """Also log camera, points, voxels, path and actions for the Rerun viewer (extra [viz])."""


EXAMPLES = """
python -m muvo_jax.dream runs/town-tr
python -m muvo_jax.dream runs/town-tr --split=val_ds --start=30 --horizon=12
python -m muvo_jax.dream runs/town-tr --branches=3  (three sampled futures)
python -m muvo_jax.dream builtin:town --rerun=dream.rrd && rerun dream.rrd
"""


def dream(options: Options, show: screen.Screen) -> list[pathlib.Path]:
    """Does what the command line asks for; returns the files written.

    Raises:
      ValueError: for a run whose heads show nothing, before any data is opened; for options that do not fit.
      OSError: where the dream cannot be written, before any data is opened.
    """
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    evaluate.check_shown(loaded, "a dream")
    if options.rerun:
        rerun_log.check(options.rerun)
    run_folder.check_writable(options.out or loaded.folder / DREAMS_FOLDER, "--out" if options.out else "RUN")
    for flag, value in (("branches", options.branches), ("moments", options.moments)):
        if value < 1:
            raise ValueError(f"--{flag} is {value}; it must be at least 1.")
    fields = {"data": "data.path", "context": "data.context", "horizon": "data.horizon"}
    chosen = command_line.chosen_settings(options, fields)
    config = config_lib.override_all(loaded.config, chosen)
    recording = command_line.open_data(config, show, options.split or recordings.HELD_OUT)
    config = evaluate.fit(config, recording, tuple(chosen))
    window = choose_window(recording, config, options)
    batch = pipeline.Frames(recording, config).batch([window], judged=True)
    futures = dream_window(world_model.WorldModel(config.model), loaded.variables, jax.random.key(options.seed), batch,
                           context=config.data.context, horizon=config.data.horizon, branches=options.branches)
    labels = ["world model"] if options.branches == 1 else [f"future {index + 1}" for index in range(len(futures))]
    views = {label: sheets.views_of_frames(frames, 0) for label, frames in zip(labels, futures, strict=True)}
    written = draw(options, config, batch, views, window, loaded.folder, f"{config.model.variant} step {loaded.step}")
    for path in written:
        show.line(f"wrote {path}")
    return written


def draw(options: Options, config: config_lib.Config, batch: types.Batch, views: Mapping[str, Sequence[sheets.View]],
         window: windows.Window, folder: pathlib.Path, model_name: str) -> list[pathlib.Path]:
    """Everything that shows the first window of a batch and its futures; returns the files written."""
    truth, actions = sheets.views_of_batch(batch, 0), np.asarray(batch.action[0])
    scene, context, beside = sheets.Scene.of(config), config.data.context, moved_views(batch, config)
    sequence, out = window.sequence, options.out or folder / DREAMS_FOLDER
    name = f"{sequence.split}_{sequence.name.rpartition('/')[2]}_{window.start:04d}"
    title = f"{model_name}   {sequence.name} from frame {window.start}"
    few = {label: views[label] for label in list(views)[:MOST_COLUMNS]}
    written = sheets.write_dream(out, truth, few, actions, scene, context=context, title=title, beside=beside,
                                 name=name, most_moments=options.moments)
    written.append(page.write_page(out / f"{name}.html", truth, views, actions, scene, context=context, title=title,
                                   beside=beside))
    if options.rerun:
        log = rerun_log.RerunLog(options.rerun)
        log.window(batch, {"truth": truth, **views, **beside}, scene, context=context,
                   poses=warp.path(batch, context, config))
        written.append(log.close())
    return written


def choose_window(recording: schema.Recording, config: config_lib.Config, options: Options) -> windows.Window:
    """The frames to dream about.

    Raises:
      ValueError: for a split, sequence or start that the recording does not have, naming what it has.
    """
    description, data = recording.description, config.data
    split = options.split or next((name for name in description.splits if name != "train"), description.splits[0])
    if split not in description.splits:
        raise ValueError(f"--split: {description.name!r} has no split {split!r}; it has "
                         f"{', '.join(description.splits)}.")
    needs = prepare_lib.needed(config, description.modalities)
    sequences = [sequence for sequence in recording.sequences if sequence.split == split and sequence.has(needs)]
    if not sequences:
        raise ValueError(f"split {split!r} of {description.name!r} has no sequence with {', '.join(sorted(needs))}, "
                         f"which this model needs.")
    named = [sequence for sequence in sequences if options.sequence in (None, sequence.name)]
    if not named:
        known = ", ".join(sorted({sequence.name for sequence in sequences})[:12])
        raise ValueError(f"--sequence: split {split!r} has no {options.sequence!r}; it has {known}.")
    sequence = max(named, key=lambda candidate: candidate.length)
    frames = data.context + data.horizon
    last = sequence.length - windows.span(frames, data.stride)
    start = max(last, 0) // 2 if options.start is None else options.start
    if not 0 <= start <= last:
        raise ValueError(f"--start {start}: sequence {sequence.name!r} has {sequence.length} frames; {frames} frames, "
                         f"{data.stride} apart, fit when they start between 0 and {last}.")
    return windows.Window(sequence, start, frames, data.stride)


def moved_views(batch: types.Batch, config: config_lib.Config) -> dict[str, list[sheets.View]]:
    """What geometry alone makes of the first window, to stand beside a dream: the observed frames, then the last one
    moved. Nothing where the motion, or the ranges that an image is looked up through, are unknown."""
    context, horizon, recorded = config.data.context, config.data.horizon, sheets.views_of_batch(batch, 0)
    if warp.motion_source(batch, config) is None:
        return {}
    frames = warp.warp(batch[:1], context, horizon, config)
    if not frames.keys() >= recorded[0].keys() & set(baselines.SENSORS):
        return {}
    return {"warp-last": recorded[:context] + sheets.views_of_frames(frames, 0)}


def dream_window(model: world_model.WorldModel, variables: types.Variables, key: types.Array, batch: types.Batch, *,
                 context: int, horizon: int, branches: int) -> list[dict[str, np.ndarray]]:
    """Frames [B, context + horizon, ...] of each future: the mean one, or `branches` sampled ones."""
    sampled = branches > 1
    heads = protocol.shown_heads(model.config)
    observed = rollout.observe(model, variables, key, batch.time_slice(0, context), sampled=False)
    actions = jax.numpy.asarray(batch.action)[:, context - 1 : context + horizon - 1]
    imagined = rollout.imagine(model, variables, key, observed.last, actions, branches=branches, sampled=sampled)
    futures = []
    for branch in range(branches):
        join = lambda seen, dreamt, branch=branch: jax.numpy.concatenate([seen, dreamt[:, branch]], axis=1)
        states = jax.tree.map(join, observed.states, imagined.states)
        decoded = rollout.decode(model, variables, states, heads, memory=observed.memory)
        futures.append(jax.device_get(protocol.finish(decoded, model.config)))
    return futures


def main() -> int:
    return command_line.run(Options, dream, program="dream", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
