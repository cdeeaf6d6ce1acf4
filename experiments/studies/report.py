"""results.json, curves.png, report.md and report.html of a study."""

from __future__ import annotations

import base64
import html
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.studies import effects, tables
from muvo_jax.viz import curves

RESULTS, CURVES, REPORT, PAGE = "results.json", "curves.png", "report.md", "report.html"
Table = tuple[list[str], list[list[str]]]


def write(folder: pathlib.Path, study: tables.Study, results: Mapping[str, Any]) -> None:
    """Writes all four; results.json last, as a whole."""
    folder.mkdir(parents=True, exist_ok=True)
    runs = complete(results)
    parts: list[Any] = [f"# {study.name}: {study.figure} of the paper", study.question, _how(results)]
    for split in tables.SPLITS:
        if runs:
            parts += [f"## Imagined frames of `{split}`", _scores(study, runs, results, split)]
    if _draw(folder / CURVES, study, runs):
        parts += ["## Over training steps", folder / CURVES,
                  "Mean over seeds, band from the lowest to the highest; a few windows of each split."]
    for suffix, title in (("", "The paper's claims, asked without memory"), ("+memory", "Asked again with memory")):
        rows = effects.of_claims(study, runs, suffix)
        if rows:
            parts += [f"## {title}", claims(rows)]
    parts += _left_out(results)
    (folder / REPORT).write_text("\n\n".join(map(_markdown, parts)) + "\n", encoding="utf-8")
    (folder / PAGE).write_text(_page(study.name, parts), encoding="utf-8")
    partial = folder / (RESULTS + ".part")
    partial.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    partial.replace(folder / RESULTS)


def complete(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Label -> seed -> run, of the runs that are complete."""
    found: dict[str, dict[str, Any]] = {}
    for label, seeds in results["runs"].items():
        done = {seed: run for seed, run in seeds.items() if run and "died" not in run}
        if done:
            found[label] = done
    return found


def claims(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The verdicts as a table."""
    head = ["the paper says", "by", "split", "pairs", "effect", "95 %", "verdict"]
    def told(row):
        needed, updates = row["pairs_needed"], row["updates_needed"]
        if row["verdict"] == effects.UNDECIDED and needed:
            return f"{row['verdict']}; about {needed} pairs would tell"
        if row["verdict"] == effects.TOO_SHORT:
            how_long = f"some {updates} updates might do" if updates else "the curves do not say how long would do"
            return f"{row['verdict']}: no arm is ahead of the training mean; {how_long}"
        return row["verdict"]
    return head, [[row["claim"], tables.NAMES[row["metric"]], row["split"], str(row["pairs"]),
                   f"{row['effect']:+.3f}", _interval(row["interval"], "+.3f"), told(row)] for row in rows]


def _how(results: Mapping[str, Any]) -> str:
    runs = [run for seeds in complete(results).values() for run in seeds.values()]
    hours = sum(run.get("processor_s", 0.0) for run in runs) / 3600.0
    judged = next((f"{run['protocol']}; {', '.join(run['cards'].values())}" for run in runs), "no run is complete yet")
    return (f"`{results['command']}` at commit {results['commit']} (code {results['code']}), on {results['machine']}; "
            f"{len(runs)} runs, {hours:.1f} processor hours. Protocol: {judged}. An effect is the mean difference of "
            f"pairs of runs under one seed, positive where the claim's first arm is better, with Student's interval "
            f"over the pairs, or over the seeds where a claim's pairs share an arm.")


def _scores(study: tables.Study, runs: Mapping[str, Mapping[str, Any]], results, split: str) -> Table:
    head = ["arm", "seeds", *(tables.NAMES[metric] for metric in study.metrics), "updates", "parameters", "note"]
    notes = {arm.name: arm.note for arm in study.arms}
    rows = []
    for label, seeds in runs.items():
        every = list(seeds.values())
        rows.append([label, str(len(every)), *(_cell([effects.value(run, split, metric) for run in every])
                                               for metric in study.metrics),
                     f"{every[0]['steps']}", f"{every[0]['parameters'] / 1e6:.2f} M",
                     notes.get(label.removesuffix("+memory"), "")])
    for source, title in (("training_mean", "training mean"), ("warp_last", "warp-last")):
        found = {}
        for run in (run for seeds in runs.values() for run in seeds.values()):  # one without occupancy judges none
            found |= run["baselines"].get(source, {}).get(split, {})
        rows.append([title, "", *(f"{float(found[metric]['mean']):.3f}" if metric in found else ""
                                  for metric in study.metrics), "", "", "a baseline"])
    return head, rows


def _cell(values: Sequence[float]) -> str:
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    spread = f" ({min(finite):.3f}..{max(finite):.3f})" if len(finite) > 1 else ""
    return f"{np.mean(finite):.3f}{spread}"


def _interval(interval: Sequence[float], form: str) -> str:
    return "" if math.isnan(interval[0]) else f"{interval[0]:{form}}..{interval[1]:{form}}"


def _draw(path: pathlib.Path, study: tables.Study, runs: Mapping[str, Mapping[str, Any]]) -> bool:
    plots = []
    for metric in study.curves:
        for split in tables.SPLITS:
            series, bands = {}, {}
            for label, seeds in runs.items():
                points = [np.array(run["curves"].get(split, {}).get(metric, []), float) for run in seeds.values()]
                points = [table for table in points if len(table)]
                if points and all(table.shape == points[0].shape for table in points):
                    values = np.stack(points)[..., 1]
                    series[label] = (points[0][:, 0].tolist(), values.mean(0).tolist())
                    bands[label] = (values.min(0).tolist(), values.max(0).tolist())
            if series:
                plots.append(curves.curve(series, f"{tables.NAMES[metric]}, {split}", size_px=(330, 560), bands=bands))
    if plots:
        curves.write_curves(path, plots, study.name, per_row=2)
    return bool(plots)


def _left_out(results: Mapping[str, Any]) -> list[str]:
    died = [f"{label}, seed {seed}" for label, seeds in results["runs"].items()
            for seed, run in seeds.items() if run and "died" in run]
    missing = sum(run is None for seeds in results["runs"].values() for run in seeds.values())
    said = [f"Left out, died twice: {'; '.join(died)} ({len(died)} in all)."] if died else []
    return said + ([f"Not complete yet: {missing} of the planned runs. The same command goes on."] if missing else [])


def _markdown(part: Any) -> str:
    if isinstance(part, pathlib.Path):
        return f"![{part.stem}]({part.name})"
    if isinstance(part, str):
        return part
    return markdown_table(part)


def markdown_table(table: Table) -> str:
    """A table as lines of Markdown."""
    head, rows = table
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *rows])


def _page(title: str, parts: Sequence[Any]) -> str:
    """One file that a browser opens by itself, pictures included."""
    body = []
    for part in parts:
        if isinstance(part, pathlib.Path):
            data = base64.b64encode(part.read_bytes()).decode()
            body.append(f'<img alt="{part.stem}" src="data:image/png;base64,{data}">')
        elif isinstance(part, str):
            level = len(part) - len(part.lstrip("#"))
            text = html.escape(part.lstrip("# ")).replace("`", "")
            body.append(f"<h{level}>{text}</h{level}>" if level else f"<p>{text}</p>")
        else:
            head, rows = part
            lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"]
            lines += ["<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
            body.append("<table>" + "".join(lines) + "</table>")
    style = ("body{font:15px sans-serif;max-width:1200px;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
             "td,th{border:1px solid #ccc;padding:3px 8px;text-align:left}img{max-width:100%}")
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
            f"<style>{style}</style>{''.join(body)}</html>\n")
