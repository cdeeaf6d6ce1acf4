"""python -m muvo_jax.evaluate RUN: judge a trained model beside copy-last and the training mean."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import sys
from collections.abc import Mapping
from typing import Annotated, Any

import rich.table
import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax.data import pipeline, prepare, words
    from muvo_jax.metrics import protocol
    from muvo_jax.training import checkpoint_meta, screen, validation

# metric -> (label, decimals, whether higher is better)
METRICS = {
    "psnr_db": ("PSNR (dB)", 2, True), "chamfer_m": ("Chamfer (m)", 3, False),
    "iou_occ_observed": ("IoU+", 4, True), "iou_empty_observed": ("IoU-", 4, True),
    "precision_observed": ("precision", 4, True), "recall_observed": ("recall", 4, True),
    "iou_occ_all": ("IoU+, unknown = empty", 4, True), "iou_empty_all": ("IoU-, unknown = empty", 4, True),
    "precision_all": ("precision, unknown = empty", 4, True), "recall_all": ("recall, unknown = empty", 4, True),
    "depth_error_m": ("depth error (m)", 2, False), "semantic_image_share": ("semantic image, share right", 4, True),
    "semantic_range_view_share": ("semantic range view, share right", 4, True),
    "birds_eye_share": ("bird's-eye view, share right", 4, True),
}
SOURCES = {"model": "model", "copy_last": "copy-last", "training_mean": "training mean"}


@dataclasses.dataclass(frozen=True)
class Options:
    """Judges a run on every split: frames that it observed and frames that it imagined, beside two baselines.

    Prints tables and writes RUN/evaluation.json and RUN/report.md (with the name of the recording where it is another
    one than the run's).
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (validation loss) or a step."""
    splits: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="(default: all)")] = ()
    """Which ones to judge."""
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


EXAMPLES = """
python -m muvo_jax.evaluate runs/town-tr
python -m muvo_jax.evaluate runs/town-tr --splits val_ds --windows=0  (all windows)
python -m muvo_jax.evaluate runs/town-tr --context=8 --horizon=10 --checkpoint=best
"""


def evaluate(options: Options, show: screen.Screen) -> dict[str, Any]:
    """Does what the command line asks for; returns what evaluation.json holds."""
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    fields = {"data": "data.path", "context": "data.context", "horizon": "data.horizon",
              "windows": "evaluation.windows", "batch": "evaluation.batch",
              "chamfer_points": "evaluation.chamfer_points", "sampled": "evaluation.sampled"}
    chosen = command_line.chosen_settings(options, fields)
    config = config_lib.override_all(loaded.config, chosen)
    recording = command_line.open_data(config, show)
    config = fit(config, recording, tuple(chosen))
    frames = pipeline.Frames(recording, config)
    splits = options.splits or tuple(sorted(recording.description.splits, key=lambda split: split == "train"))
    mean, mean_frames = validation.training_mean(frames) if "train" in recording.description.splits else ({}, 0)
    report: dict[str, Any] = {
        "run": str(loaded.folder), "variant": config.model.variant, "step": loaded.step,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(loaded.variables["params"])),
        "data": {"name": recording.description.name, "path": config.data.path}, "protocol": protocol.identity(config),
        "training_mean_frames": mean_frames, "packages": checkpoint_meta.package_versions(), "splits": {}}
    for split in splits:
        show.line(f"evaluating {split} ...", style="dim")
        scores = protocol.evaluate(loaded.model, loaded.variables,
                                   validation.windows(frames, split, config.evaluation.windows), config, mean)
        report["splits"][split] = scores
        for phase in protocol.PHASES:
            show.console.print(screen_table(split, phase, scores))
    suffix = f"-{recording.description.name}" if options.data else ""
    for path in write_report(loaded.folder, report, suffix):
        show.line(f"wrote {path}")
    return report


def fit(config: config_lib.Config, recording, chosen: tuple[str, ...]) -> config_lib.Config:
    """The config fitted to a recording, whose sensors must be those that the model was trained with.

    Raises:
      ValueError: naming both where the recording asks for another network.
    """
    fitted = prepare.adapt(config, recording, keep=chosen).config
    where = f"recording {recording.description.name!r} asks for another model than this run, which"
    checkpoint_meta.check_architecture(fitted, config, where)
    return fitted


def screen_table(split: str, phase: str, scores: Mapping[str, Any]) -> rich.table.Table:
    """One split and phase: a row for each metric, the best source bold."""
    phase_scores = scores[phase]
    windows = words.counted(scores["windows"], "window")
    table = rich.table.Table(title=f"{split}: {phase} frames, {windows}", title_justify="left")
    table.add_column("metric")
    for source in phase_scores:
        table.add_column(SOURCES[source], justify="right")
    if phase == "imagined":
        steps = max(len(metric["per_step"]) for metric in phase_scores["model"].values())
        for source in phase_scores:
            table.add_column(f"{SOURCES[source]}\nat step {steps}", justify="right")
    table.add_column("undefined\nframes", justify="right")
    for name, (label, decimals, higher) in METRICS.items():
        if name not in phase_scores["model"]:
            continue
        means = {source: metrics[name]["mean"] for source, metrics in phase_scores.items() if name in metrics}
        cells = marked(means, phase_scores, decimals, higher, "[bold]{}[/bold]")
        if phase == "imagined":
            last = {source: metrics[name]["per_step"][-1]
                    for source, metrics in phase_scores.items() if name in metrics}
            cells += marked(last, phase_scores, decimals, higher, "[bold]{}[/bold]")
        undefined = [str(metrics[name].get("undefined", "")) for metrics in phase_scores.values() if name in metrics]
        table.add_row(label, *cells, " / ".join(part for part in undefined if part))
    return table


def marked(values: Mapping[str, float], sources: Mapping[str, Any], decimals: int, higher: bool,
           mark: str) -> list[str]:
    """The values as text, the best one marked; NaN stays nan, a source without the metric is empty."""
    defined = [value for value in values.values() if not math.isnan(value)]
    best = (max if higher else min)(defined) if defined else None
    cells = []
    for source in sources:
        text = "" if source not in values else number(values[source], decimals)
        cells.append(mark.format(text) if text and values[source] == best else text)
    return cells


def number(value: float, decimals: int) -> str:
    return "nan" if math.isnan(value) else f"{value:.{decimals}f}"


def write_report(folder: pathlib.Path, report: Mapping[str, Any], suffix: str = "") -> tuple[pathlib.Path, ...]:
    """Writes RUN/evaluation.json (not-a-number as the string "nan") and RUN/report.md; returns their paths."""
    numbers, page = folder / f"evaluation{suffix}.json", folder / f"report{suffix}.md"
    numbers.write_text(json.dumps(json_ready(report), indent=1) + "\n", encoding="utf-8")
    page.write_text(markdown(report), encoding="utf-8")
    return numbers, page


def json_ready(value):
    """Strict JSON: floats that are not finite become strings."""
    if isinstance(value, Mapping):
        return {name: json_ready(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def markdown(report: Mapping[str, Any]) -> str:
    """The report as a page: for each split the averages and every step of the horizon."""
    lines = [f"# {pathlib.Path(report['run']).name}", "",
             f"{report['variant']}, {report['parameters']:,} parameters, step {report['step']}, trained and judged on "
             f"{report['data']['name']}.", "", f"Protocol: {report['protocol']}. Training mean of "
             f"{report['training_mean_frames']} frames. Bold is best. Chamfer and PSNR are means over frames; voxel "
             f"scores come from counts over the whole split.", ""]
    for split, scores in report["splits"].items():
        lines += [f"## {split} ({words.counted(scores['windows'], 'window')})", ""]
        for phase in protocol.PHASES:
            lines += [f"### {phase} frames", "", *_average_table(scores[phase]), ""]
        lines += ["### imagined frames, step by step", "", *_step_table(scores["imagined"]), "",
                  f"Copy-last copied {scores['copy_last_unknown_voxels']} unknown voxels as empty.", ""]
    return "\n".join(lines)


def _average_table(phase_scores: Mapping[str, Any]) -> list[str]:
    lines = ["| metric | " + " | ".join(SOURCES[source] for source in phase_scores) + " | frames (undefined) |",
             "|---|" + "---:|" * (len(phase_scores) + 1)]
    for name, (label, decimals, higher) in METRICS.items():
        if name not in phase_scores["model"]:
            continue
        means = {source: metrics[name]["mean"] for source, metrics in phase_scores.items() if name in metrics}
        counted = [f"{metrics[name]['frames']} ({metrics[name]['undefined']})" for metrics in phase_scores.values()
                   if "frames" in metrics.get(name, {})]
        cells = marked(means, phase_scores, decimals, higher, "**{}**")
        lines.append(f"| {label} | " + " | ".join(cells) + f" | {', '.join(counted)} |")
    return lines


def _step_table(phase_scores: Mapping[str, Any]) -> list[str]:
    steps = len(next(iter(phase_scores["model"].values()))["per_step"])
    lines = ["| metric | source | " + " | ".join(str(step + 1) for step in range(steps)) + " |",
             "|---|---|" + "---:|" * steps]
    for name in ("psnr_db", "chamfer_m", "iou_occ_observed", "iou_occ_all"):
        for source, metrics in phase_scores.items():
            if name in metrics:
                label, decimals, _ = METRICS[name]
                cells = " | ".join(number(value, decimals) for value in metrics[name]["per_step"])
                lines.append(f"| {label} | {SOURCES[source]} | {cells} |")
    return lines


def main() -> int:
    return command_line.run(Options, evaluate, program="evaluate", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
