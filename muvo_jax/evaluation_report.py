"""What evaluate reports: tables for the screen, RUN/report.md and RUN/evaluation.json."""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import rich.table

from muvo_jax import head as head_lib
from muvo_jax.agents import forecasts
from muvo_jax.data import words
from muvo_jax.metrics import cards, occupancy, protocol

SOURCES = {"model": "model", "copy_last": "copy-last", "warp_last": "warp-last", "warp_fused": "warp-fused",
           "training_mean": "training mean"}


def screen_table(split: str, phase: str, scores: Mapping[str, Any]) -> rich.table.Table:
    """One split and phase: a row for each headline, the best source bold; of imagined frames the last step in brackets.

    report.md has every metric and step.
    """
    phase_scores, imagined = scores[phase], phase == "imagined"
    last_step = f" (step {len(next(iter(phase_scores['model'].values()))['per_step'])})" if imagined else ""
    table = rich.table.Table(title=f"{split}: {phase} frames{last_step}, {counts_text(scores)}; {card_text(scores)}",
                             title_justify="left")
    table.add_column("metric")
    for source in phase_scores:
        table.add_column(SOURCES[source], justify="right")
    table.add_column("model, 95 %", justify="right")
    for name, metric in _labelled(phase_scores["model"]):
        if not metric.on_screen:
            continue
        decimals, higher = metric.decimals, metric.higher
        shown = [source for source in phase_scores if name in phase_scores[source]]
        means = {source: phase_scores[source][name]["mean"] for source in shown}
        cells = marked(means, phase_scores, decimals, higher, "[bold]{}[/bold]")
        if imagined:
            last = {source: phase_scores[source][name]["per_step"][-1] for source in shown}
            ends = marked(last, phase_scores, decimals, higher, "[bold]{}[/bold]")
            cells = [f"{cell} ({end})" if cell else "" for cell, end in zip(cells, ends, strict=True)]
        table.add_row(_title(metric), *cells, interval_text(phase_scores["model"][name], decimals))
    return table


def judged_phases(scores: Mapping[str, Any]) -> tuple[str, ...]:
    """The phases of a split in which anything is scored: a card may define no score of observed frames."""
    return tuple(phase for phase in protocol.PHASES if scores[phase].get("model"))


def _labelled(scores: Mapping[str, Any]) -> list[tuple[str, head_lib.Metric]]:
    """The metrics among these scores that people read, in the order of the report."""
    return [(name, metric) for name, metric in head_lib.metrics().items() if metric.label and name in scores]


def _title(metric: head_lib.Metric) -> str:
    return f"{metric.label} ({metric.unit})" if metric.unit else metric.label


def counts_text(scores: Mapping[str, Any]) -> str:
    """Such as "16 windows of 4 drives"."""
    return f"{words.counted(scores['windows'], 'window')} of {words.counted(scores['drives'], 'drive')}"


def card_text(scores: Mapping[str, Any]) -> str:
    """Such as "card town"."""
    name = scores.get("card", cards.NONE)
    return name if name == cards.NONE else f"card {name}"


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


def interval_text(metric: Mapping[str, Any], decimals: int) -> str:
    """Such as "19.31..20.85"; empty where a split has one drive."""
    low, high = metric["interval"]
    return "" if math.isnan(low) else f"{number(low, decimals)}..{number(high, decimals)}"


def answers_line(ratios: Mapping[str, Any]) -> str:
    """The action shuffle ratios of the heads for the screen; there are none of a single window."""
    shown = ", ".join(f"{_error_name(head)} {number(ratio['mean'], 2)}" for head, ratio in ratios.items())
    return f"error under another window's actions over error under the recorded ones (1 is deaf): {shown or 'none'}"


def _error_name(head: str) -> str:
    return head_lib.shown((head,))[head].error_name


def write_report(folder: pathlib.Path, report: Mapping[str, Any], suffix: str = "") -> tuple[pathlib.Path, ...]:
    """Writes RUN/evaluation.json (not-a-number as the string "nan") and RUN/report.md; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers, page = folder / f"evaluation{suffix}.json", folder / f"report{suffix}.md"
    numbers.write_text(json.dumps(json_ready(report), indent=1) + "\n", encoding="utf-8")
    page.write_text(markdown(report), encoding="utf-8")
    return numbers, page


def json_ready(value):
    """Strict JSON: NumPy's numbers become Python's, floats that are not finite strings."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {name: json_ready(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _on(report: Mapping[str, Any]) -> str:
    trained, judged = report.get("trained_on"), report["data"]["name"]
    if trained is None:
        return f"judged on {judged}"
    return f"trained and judged on {judged}" if trained == judged else f"trained on {trained}, judged on {judged}"


def markdown(report: Mapping[str, Any]) -> str:
    """The report as a page: for each split the averages and every step of the horizon."""
    lines = [f"# {pathlib.Path(report['run']).name}", "",
             f"{report['variant']}, {report['parameters']:,} parameters, step {report['step']}, "
             f"{_on(report)}.", "", f"Protocol: {report['protocol']}. Training mean of "
             f"{report['training_mean_frames']} frames. Bold is best. Chamfer and PSNR are means over frames; voxel "
             f"scores and movers' PSNR come from sums over the whole split. In brackets 95 % intervals by bootstrap "
             f"over drives. Above the road: {occupancy.ABOVE_ROAD_M:g} m and more over the ground under the ego.", ""]
    if report["card"]:
        lines += [f"Card {report['card']['name']}: {report['card']['about']}", "",
                  *(f"* {note}" for note in report["card"]["notes"]), ""]
    for split, scores in report["splits"].items():
        samples = scores["samples"]
        lines += [f"## {split} ({counts_text(scores)}; {card_text(scores)})", "",
                  f"Samples {samples['fingerprint']}.", ""]
        for phase in judged_phases(scores):
            lines += [f"### {phase} frames", "", *_average_table(scores[phase]), ""]
        if "imagined" in judged_phases(scores):
            lines += ["### imagined frames, step by step", "", *_step_table(scores["imagined"]), "",
                      "### answer to actions", "", *_answer_table(scores["action_shuffle"]), ""]
        else:
            lines += ["Nothing that the heads predict is scored.", ""]
        lines += [f"Movers: {scores['movers'] or 'none'}. Copy-last copied {scores['copy_last_unknown_voxels']} "
                  f"unknown voxels as empty.", ""]
        if "uncertainty" in scores:
            lines += ["### sampled futures", "", *uncertainty_table(scores["uncertainty"]), ""]
    return "\n".join(lines)


def _average_table(phase_scores: Mapping[str, Any]) -> list[str]:
    lines = ["| metric | " + " | ".join(SOURCES[source] for source in phase_scores) + " | frames (undefined) |",
             "|---|" + "---:|" * (len(phase_scores) + 1)]
    for name, metric in _labelled(phase_scores["model"]):
        decimals, higher = metric.decimals, metric.higher
        means = {source: metrics[name]["mean"] for source, metrics in phase_scores.items() if name in metrics}
        counted = [f"{metrics[name]['frames']} ({metrics[name]['undefined']})" for metrics in phase_scores.values()
                   if "frames" in metrics.get(name, {})]
        cells = marked(means, phase_scores, decimals, higher, "**{}**")
        intervals = [interval_text(metrics[name], decimals) if name in metrics else ""
                     for metrics in phase_scores.values()]
        cells = [f"{cell} [{interval}]" if interval else cell for cell, interval in zip(cells, intervals, strict=True)]
        lines.append(f"| {_title(metric)} | " + " | ".join(cells) + f" | {', '.join(counted)} |")
    return lines


def _step_table(phase_scores: Mapping[str, Any]) -> list[str]:
    steps = len(next(iter(phase_scores["model"].values()))["per_step"])
    lines = ["| metric | source | " + " | ".join(str(step + 1) for step in range(steps)) + " |",
             "|---|---|" + "---:|" * steps]
    for name, metric in _labelled(phase_scores["model"]):
        for source, metrics in phase_scores.items():
            if metric.by_step and name in metrics:
                cells = " | ".join(number(value, metric.decimals) for value in metrics[name]["per_step"])
                lines.append(f"| {_title(metric)} | {SOURCES[source]} | {cells} |")
    return lines


def _answer_table(ratios: Mapping[str, Any]) -> list[str]:
    steps = max((len(ratio["per_step"]) for ratio in ratios.values()), default=0)
    lines = ["Error of imagined frames under another window's actions over the error under the recorded ones; 1 is "
             "deaf to actions.", "",
             "| head | ratio | " + " | ".join(str(step + 1) for step in range(steps)) + " |",
             "|---|" + "---:|" * (steps + 1)]
    for head, ratio in ratios.items():
        interval = interval_text(ratio, 2)
        mean = number(ratio["mean"], 2) + (f" [{interval}]" if interval else "")
        cells = [mean, *(number(value, 2) for value in ratio["per_step"])]
        lines.append(f"| {_error_name(head)} | " + " | ".join(cells) + " |")
    return lines


def uncertainty_table(found: Mapping[str, Any]) -> list[str]:
    """What forecasts.measure returns, as Markdown."""
    steps = len(found["per_step"]["trust"])
    far = (f"at least a half for {words.counted(found['trust_horizon'], 'step')}"
           if math.isfinite(found["trust_horizon"]) else "which a single window does not tell")
    lines = [f"{words.counted(found['branches'], 'future')} of each of {words.counted(found['windows'], 'window')}. "
             f"Trust: 1 - variance among the futures of a window / variance of all, {far}. CRPS equals the error of "
             f"one future where all agree.", "",
             "| score | " + " | ".join(str(step + 1) for step in range(steps)) + " |", "|---|" + "---:|" * steps]
    for name, values in found["per_step"].items():
        label, unit, decimals = forecasts.SCORES[name]
        cells = " | ".join(number(value, decimals) for value in values)
        lines.append(f"| {label} ({unit}) | {cells} |" if unit else f"| {label} | {cells} |")
    if "reliability" in found:
        curve = found["reliability"]
        row = lambda label, values: f"| {label} | " + " | ".join(number(value, 2) for value in values) + " |"
        lines += ["", row("probability of a voxel above the road", curve["confidence"]),
                  "|---|" + "---:|" * len(curve["confidence"]),
                  row("how often it was occupied", curve["frequency"]), "",
                  f"Expected calibration error {number(curve['calibration_error'], 4)}."]
    return lines


def draw_uncertainty(path: pathlib.Path, report: Mapping[str, Any]) -> pathlib.Path:
    """A page with the reliability curves of all splits and their trust over the horizon."""
    from muvo_jax.viz import curves  # with Pillow, which judging does not need

    found = {split: scores["uncertainty"] for split, scores in report["splits"].items()}
    steps = {split: (range(1, 1 + len(one["per_step"]["trust"])), one["per_step"]["trust"])
             for split, one in found.items()}
    plots = [curves.curve(steps, "trust over the steps")]
    points = lambda curve: [point for point in zip(curve["confidence"], curve["frequency"], strict=True)
                            if not math.isnan(point[0])]
    reliable: dict[str, curves.Series] = {
        split: tuple(zip(*points(one["reliability"]), strict=True))  # type: ignore[misc]
        for split, one in found.items() if "reliability" in one and points(one["reliability"])}
    if reliable:
        plots.append(curves.curve({"exact": ((0.0, 1.0), (0.0, 1.0)), **reliable}, "how often voxels were occupied"))
    return curves.write_curves(path, plots, f"{pathlib.Path(report['run']).name}: sampled futures")
