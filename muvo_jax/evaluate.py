"""python -m muvo_jax.evaluate RUN: judge a trained model beside baselines that learned nothing."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import pathlib
import re
import sys
import warnings
from collections.abc import Mapping
from typing import Annotated, Any

import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax import evaluation_report
    from muvo_jax import head as head_lib
    from muvo_jax import run as run_lib
    from muvo_jax.agents import forecasts
    from muvo_jax.data import fitting, pipeline, schema, sequences, windows
    from muvo_jax.metrics import baselines, cards, protocol, warp
    from muvo_jax.model import world_model
    from muvo_jax.training import checkpoint_meta, run_folder, screen, validation
    from muvo_jax.viz import rerun_log, sheets


TRAINING_WINDOWS = 8  # of the split "train", where it is not asked for by name


@dataclasses.dataclass(frozen=True)
class Options:
    """Judges a run on every split: frames that it observed and frames that it imagined, beside baselines that learned
    nothing, and whether what it imagines answers to the actions.

    Prints tables and writes RUN/evaluation.json and RUN/report.md (with the name of the card that was asked for, and
    "on" that of the recording where --data names one). Every table says which protocol card it follows.
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    splits: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="(default: all)")] = ()
    """Which ones to judge; not named, "train" is judged by a few windows."""
    card: Annotated[str, command_line.shown("NAME", "the run's own settings")] = ""
    """Judge by this protocol card: one of muvo_jax/cards (town, authors, kitti-4docc-1s), or a path to one's own."""
    data: Annotated[str | None, command_line.shown("PATH", "the run's")] = None
    """Another recording than the one that the run was trained on."""
    context: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Frames to observe."""
    horizon: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Frames to imagine."""
    windows: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """At most so many windows of a split, evenly spread; 0 for all."""
    batch: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Windows at a time."""
    chamfer_points: Annotated[int | None, command_line.shown("N", "the run's")] = None
    """Points of each frame that the Chamfer distance looks at; 0 for all."""
    sampled: Annotated[bool | None, command_line.shown("{True,False}", "the run's")] = None
    """Draw the latents instead of taking their means."""
    uncertainty: int = 0
    """Also sample so many futures of each window, and measure how far they can be trusted (RUN/uncertainty.png)."""
    rerun: Annotated[pathlib.Path | None, command_line.shown("FILE.rrd", "none")] = None
    """Also log the first window of each split, with all baselines, for the Rerun viewer (extra [viz])."""


EXAMPLES = """
python -m muvo_jax.evaluate runs/town-tr
python -m muvo_jax.evaluate runs/town-tr --splits val_ds --windows=0  (all windows)
python -m muvo_jax.evaluate runs/town-tr --splits val_rl --windows=16 --uncertainty=8
python -m muvo_jax.evaluate runs/town-tr --card=authors
python -m muvo_jax.evaluate runs/town-tr --context=8 --horizon=10 --checkpoint=best
"""


def evaluate(options: Options, show: screen.Screen) -> dict[str, Any]:
    """Does what the command line asks for; returns what evaluation.json holds.

    Raises:
      ValueError: for options that do not fit the run or the recording.
      OSError: where the run's folder cannot be written, before anything is judged.
    """
    card = cards.load(options.card) if options.card else None
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    fields = {"data": "data.path", "context": "data.context", "horizon": "data.horizon",
              "windows": "evaluation.windows", "batch": "evaluation.batch",
              "chamfer_points": "evaluation.chamfer_points", "sampled": "evaluation.sampled"}
    if options.uncertainty < 0 or options.uncertainty == 1:
        raise ValueError(f"--uncertainty is {options.uncertainty}; expected two futures or more, or 0 for none.")
    if options.rerun:
        check_shown(loaded, "--rerun")
    run_folder.check_writable(loaded.folder, "RUN")
    log = rerun_log.RerunLog(options.rerun) if options.rerun else None
    chosen = command_line.chosen_settings(options, fields)
    config = config_lib.override_all(loaded.config, chosen)
    config = card.applied(config, chosen) if card else config
    recording = command_line.open_data(config, show)
    splits = options.splits or _splits(card, recording)
    config = fit(config, recording, (*chosen, *(card.settings if card else ())), splits)
    if card and (problem := card.foreign(config, recording.description.kind)):
        raise ValueError(problem)
    frames = pipeline.Frames(recording, config)
    trained = sequences.longest(recording.sequences, "train", frames.needs) > 0  # who judges may have copied no more
    mean, mean_frames = validation.training_mean(frames) if trained else ({}, 0)
    report: dict[str, Any] = {
        "run": str(loaded.folder), "variant": config.model.variant, "step": loaded.step,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(loaded.variables["params"])),
        "trained_on": (loaded.provenance or {}).get("name"),
        "data": {"name": recording.description.name, "path": config.data.path}, "protocol": protocol.identity(config),
        "card": {"name": card.name, "about": card.about, "notes": card.notes} if card else None,
        "training_mean_frames": mean_frames, "packages": checkpoint_meta.package_versions(), "splits": {}}
    for split in splits:
        show.line(f"evaluating {split} ...", style="dim")
        count = config.evaluation.windows
        if split == "train" and not options.splits:  # what was learned by heart needs no close look
            count = min(count or TRAINING_WINDOWS, TRAINING_WINDOWS)
        scores = protocol.evaluate(world_model.WorldModel(config.model), loaded.variables,
                                   validation.windows(frames, split, count), config, mean,
                                   look=functools.partial(log_windows, log, config, split) if log else None)
        scores = _named(scores, card, frames, split, count)
        if options.uncertainty:
            scores["uncertainty"] = forecasts.measure(
                world_model.WorldModel(config.model), loaded.variables, jax.random.key(config.evaluation.seed),
                ((entry.batch, len(entry.drives)) for entry in validation.windows(frames, split, count)),
                context=config.data.context, horizon=config.data.horizon, branches=options.uncertainty)
            for line in evaluation_report.uncertainty_table(scores["uncertainty"]):
                show.line(line)
        report["splits"][split] = scores
        for phase in evaluation_report.judged_phases(scores):
            show.console.print(evaluation_report.screen_table(split, phase, scores))
        show.line(evaluation_report.answers_line(scores["action_shuffle"]))
    suffix = f"-{pathlib.Path(card.name).stem}" if card else ""
    suffix += f"-on-{_in_a_name(recording.description.name, config.data.path)}" if options.data else ""
    written = _write(loaded.folder, report, suffix, show)
    if options.uncertainty:
        written += (evaluation_report.draw_uncertainty(loaded.folder / f"uncertainty{suffix}.png", report),)
    written += (log.close(),) if log else ()
    for path in written:
        show.line(f"wrote {path}")
    return report


def _write(folder: pathlib.Path, report: dict[str, Any], suffix: str, show: screen.Screen) -> tuple[pathlib.Path, ...]:
    """Writes the report; shows it where that fails, for judging took long.

    Raises:
      OSError: where it cannot be written.
    """
    try:
        return evaluation_report.write_report(folder, report, suffix)
    except OSError as error:
        show.line(evaluation_report.markdown(report))
        raise OSError(f"the report could not be written to {folder} ({error.strerror or error}), and stands above "
                      f"instead.") from error


def check_shown(loaded: run_lib.Run, what: str) -> None:
    """Raises ValueError where none of a run's heads predicts what `what` could show."""
    if not protocol.shown_heads(loaded.config.model):
        raise ValueError(f"run {loaded.folder} has the heads {', '.join(loaded.config.model.heads)}, and none of them "
                         f"predicts what could be drawn; {what} needs one or more of {', '.join(head_lib.shown())}. "
                         f"Train with one of these (--with-heads=image), which --init can start from this run.")


def log_windows(log: rerun_log.RerunLog, config: config_lib.Config, split: str, item: protocol.Windows,
                guesses: Mapping[str, Mapping[str, baselines.Frames]]) -> None:
    """Logs the first of these windows and what every source makes of it (protocol.Look); where a baseline says nothing
    of observed frames, these stand as they were recorded."""
    truth, context = sheets.views_of_batch(item.batch, 0), config.data.context
    sources = {"truth": truth}
    for source, ahead in guesses["imagined"].items():
        seen = guesses["observed"].get(source)
        before = truth[:context] if seen is None else sheets.views_of_frames(seen, 0)
        sources[evaluation_report.SOURCES[source]] = before + sheets.views_of_frames(ahead, 0)
    log.window(item.batch, sources, sheets.Scene.of(config), context=context,
               poses=warp.path(item.batch, context, config), name=split)


def _in_a_name(name: str, path: str) -> str:
    """A recording as a part of a file's name. Copies of one have one name, KITTI's are those of all its drives, other
    ones have slashes: so its beginning, and where the recording lies as eight digits."""
    where = path if path == "town" else str(pathlib.Path(path).expanduser().resolve())
    plain = re.sub(r"[^\w.-]+", "-", name)[:40]
    return f"{plain}-{hashlib.sha256(where.encode()).hexdigest()[:8]}"


def _splits(card: cards.Card | None, recording: schema.Recording) -> tuple[str, ...]:
    """Those that are judged where none is named.

    Raises:
      ValueError: where the recording lacks one of the card's.
    """
    held = recording.description.splits
    if card is None:
        return tuple(sorted(held, key=lambda split: split == "train"))
    if lacking := ", ".join(split for split in card.splits if split not in held):
        raise ValueError(f"card {card.name} judges {', '.join(card.splits)}, but recording "
                         f"{recording.description.name!r} has no {lacking}; it has {', '.join(held)}. Name one "
                         f"of these with --splits: its numbers are then said to be of other samples.")
    return card.splits or tuple(split for split in held if split != "train")


def _named(scores: dict[str, Any], card: cards.Card | None, frames: pipeline.Frames, split: str,
           count: int) -> dict[str, Any]:
    """The scores of a split with the name of their card and the list of samples that they come from."""
    chosen = pipeline.evaluation_windows(frames, split, windows=count)
    samples = cards.Samples(len(chosen), windows.fingerprint(chosen))
    if card is None:
        name = cards.label(frames.config, frames.recording.description.kind, split, samples)
    else:
        name, scores = card.label(split, samples), cards.defined(card, scores)
    return {"card": name, "samples": dataclasses.asdict(samples), **scores}


def fit(config: config_lib.Config, recording: schema.Recording, chosen: tuple[str, ...],
        splits: tuple[str, ...] | None = None) -> config_lib.Config:
    """The config fitted to a recording, whose sensors must be those that the model was trained with; windows need to
    fit into these splits alone (None: all). Warns where the recording is so short that they are cut in another way.

    Raises:
      ValueError: naming both where the recording asks for another network.
    """
    fitted = fitting.adapt(config, recording, keep=(*chosen, *fitting.OF_TRAINED), splits=splits).config
    changed = ", ".join(f"{name}={getattr(fitted.data, name)} ({getattr(config.data, name)})"
                        for name in ("stride", "context", "horizon")
                        if getattr(fitted.data, name) != getattr(config.data, name))
    if changed:
        warnings.warn(f"recording {recording.description.name!r} is too short for the windows of this run; it is "
                      f"judged with {changed}, in brackets what it was trained with. --context and --horizon choose "
                      f"others.", schema.DataWarning, stacklevel=2)
    where = f"recording {recording.description.name!r} asks for another model than this run, which"
    checkpoint_meta.check_architecture(fitted, config, where)
    return fitted


def main() -> int:
    return command_line.run(Options, evaluate, program="evaluate", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
