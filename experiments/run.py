"""python -m experiments.run NAME: repeats a study of the paper, from a clone."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import platform
import shlex
import sys
from typing import Annotated, Any

import tyro

from experiments.studies import cost, effects, queue, report, tables
from muvo_jax import command_line
from muvo_jax import config as config_lib
from muvo_jax.data import processes, sources
from muvo_jax.training import screen


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains every arm of a study under several seeds, one process after the other, then its best and its worst arm
    again with memory, and reports what the paper's claims come to.

    Stopped, it goes on when called again: with the runs in RUNS_DIR, and where those are gone, with the runs that
    results.json has no scores of. A run that dies is tried once more, then left out and counted.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """fusion, latent or occupancy (Fig. 3, 4, and 5 with 6)."""
    scale: str = "town"
    """smoke (does everything run?), town (hours on two cores) or paper (the paper's sizes, on --data)."""
    seeds: Annotated[int | None, command_line.shown("N", "smoke 1, town 2, paper 1")] = None
    """Runs of each arm."""
    data: Annotated[str | None, command_line.shown("PATH", "the built-in town")] = None
    """A recording to train on; the paper's scale needs one."""
    memory: bool = True
    """Ask the best and the worst arm again with memory (scale town)."""
    shard: Annotated[str, tyro.conf.arg(metavar="INDEX/COUNT")] = "0/1"
    """Which part of the runs this host makes. All hosts share the folder of the runs."""
    runs_dir: pathlib.Path = pathlib.Path("runs/studies")
    """Where runs are kept, in NAME-SCALE."""
    out: Annotated[pathlib.Path | None, command_line.shown("PATH", "beside the runs")] = None
    """Where results.json, curves.png, report.md and report.html go."""
    only_report: tyro.conf.FlagCreatePairsOff[bool] = False
    """Train nothing; report what is there."""
    yes: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start the paper's scale; without it, its cost is printed and nothing starts."""


EXAMPLES = """
python -m experiments.run fusion --scale=town --out=experiments/fusion
python -m experiments.run latent --scale=smoke
python -m experiments.run fusion --shard=0/4  (on the first of four hosts)
python -m experiments.run occupancy --scale=paper --data=/data/muvo  (says what it costs)
"""


def _shard(text: str) -> tuple[int, int]:
    try:
        index, count = (int(word) for word in text.split("/"))
    except ValueError:
        index, count = -1, 0
    if not 0 <= index < count:
        raise ValueError(f"--shard={text}: expected INDEX/COUNT with an index from 0 to COUNT - 1, such as 0/4.")
    return index, count


def _results(options: Options, study: tables.Study, folder: pathlib.Path, planned: list[queue.Job],
             existing: dict[str, Any] | None) -> dict[str, Any]:
    runs: dict[str, dict[str, Any]] = {}
    for job in planned:
        runs.setdefault(job.label, {})[str(job.seed)] = queue.read(folder, job, study) or _recorded(existing, job)
    for label, seeds in (existing or {}).get("runs", {}).items():  # of other seeds, or with memory, asked for or not
        for seed, found in seeds.items():
            if found and "died" not in found and not runs.setdefault(label, {}).get(seed):
                runs[label][seed] = found
    _check_one_card([run for seeds in runs.values() for run in seeds.values() if run and "died" not in run], folder)
    kept = {name: existing[name] for name in ("command", "commit", "machine")} if existing else {}
    words = shlex.join(["python", "-m", "experiments.run", *sys.argv[1:]])
    return {"study": study.name, "scale": options.scale, "code": queue.code_fingerprint(), "data": options.data,
            "command": words, "commit": queue.commit(),
            "machine": f"{os.cpu_count()} cores of {platform.machine()}, {platform.system()}", **kept, "runs": runs}


def _recorded(existing: dict[str, Any] | None, job: queue.Job) -> dict[str, Any] | None:
    """What results of an earlier sitting say of a run whose folder is gone."""
    found = (existing or {}).get("runs", {}).get(job.label, {}).get(str(job.seed))
    return found if found and "died" not in found else None


def _check_one_card(complete: list[dict[str, Any]], folder: pathlib.Path) -> None:
    """Refuses to compare runs that were judged by several cards or on other samples.

    Raises:
      ValueError: naming both.
    """
    for split in tables.SPLITS:
        cards = sorted({str(run["cards"].get(split)) for run in complete})
        if len(cards) > 1:
            raise ValueError(f"{folder} holds runs that were judged on {split} by {' and by '.join(cards)}. Evaluate "
                             f"them by one (python -m muvo_jax.evaluate RUN), or begin anew with another --runs-dir.")


def _known(paths: list[pathlib.Path], options: Options, study: tables.Study) -> dict[str, Any] | None:
    """What results of earlier sittings say, the runs of all of them together; None where there are none."""
    merged: dict[str, Any] | None = None
    for path in paths:
        found = json.loads(path.read_text(encoding="utf-8"))
        _check_same(found, options, study, path)
        merged = merged or found
        for label, seeds in found["runs"].items():
            held = merged["runs"].setdefault(label, {})
            for seed, scores in seeds.items():
                if not held.get(seed) or "died" in held[seed]:
                    held[seed] = scores
    return merged


def _check_splits(data: str) -> None:
    """Raises ValueError where a recording lacks a split that studies judge: before anything is trained."""
    held = sources.open_recording(data).description.splits
    if lacking := ", ".join(split for split in tables.SPLITS if split not in held):
        raise ValueError(f"recording {data} has the splits {', '.join(held)}, but a study judges "
                         f"{', '.join(tables.SPLITS)}: it lacks {lacking}. python -m muvo_jax.record_carla records "
                         f"drives that have them; of others rename what was held out.")


def _check_same(existing: dict[str, Any], options: Options, study: tables.Study, path: pathlib.Path) -> None:
    """Refuses to add runs of other code, another study or other data to results.

    Raises:
      ValueError: naming both.
    """
    mine = {"study": study.name, "scale": options.scale, "data": options.data, "code": queue.code_fingerprint()}
    for name, value in mine.items():
        if existing.get(name) != value:
            raise ValueError(f"{path} holds {name} {existing.get(name)!r} (commit {existing.get('commit')}); "
                             f"this is {name} {value!r} (commit {queue.commit()}). Go on from a checkout of that "
                             f"commit (git worktree add ../study {existing.get('commit', '').rstrip('+')}), or begin "
                             f"anew with another --runs-dir.")


def run(options: Options, show: screen.Screen) -> None:
    """Does what the command line asks for."""
    config_lib.check_choice("study", options.name, tuple(tables.STUDIES))
    config_lib.check_choice("--scale", options.scale, tables.SCALES)
    study, scale = tables.STUDIES[options.name], options.scale
    shard, seeds = _shard(options.shard), options.seeds or tables.SEEDS[scale]
    folder = options.runs_dir / f"{study.name}-{scale}"
    planned, extra = queue.jobs(study, scale, seeds), ([f"--data={options.data}"] if options.data else [])
    if options.data:
        _check_splits(options.data)
    if scale == "paper":
        if options.data is None:
            raise ValueError("the paper's scale trains on recordings of CARLA: give --data=PATH (python -m "
                             "muvo_jax.record_carla makes them, with the splits that a study judges).")
        for line in cost.told(study, planned, folder, extra):
            show.line(line)
        if not options.yes:
            show.line("nothing started: add --yes to start.")
            return
    folder.mkdir(parents=True, exist_ok=True)
    known = [place / report.RESULTS for place in (folder, options.out) if place and (place / report.RESULTS).is_file()]
    existing = _known(known, options, study)

    def save(jobs: list[queue.Job]) -> dict[str, Any]:
        with processes.locked(folder / ".lock", "reporting", wait=True):
            results = _results(options, study, folder, jobs, existing)
            report.write(folder, study, results)
            if options.out:
                report.write(options.out, study, results)
        return results

    def make(jobs: list[queue.Job]) -> None:
        started_from = {job.after for job in jobs if job.arm.after and not _recorded(existing, job)}
        for index, job in enumerate(mine := queue.of_shard(jobs, *shard)):
            recorded = _recorded(existing, job) and job.name not in started_from
            if not (options.only_report or recorded or (folder / job.name / queue.EVALUATION).is_file()):
                show.line(f"run {index + 1} of {len(mine)}:")
                queue.make(study, scale, job, folder, show.line, extra)
                save(planned)

    make(planned)
    results = save(planned)
    found = effects.best_and_worst(study, report.complete(results)) if options.memory and scale == "town" else None
    if found and all(run is not None for arms in results["runs"].values() for run in arms.values()):
        arms = {arm.name: arm for arm in study.arms}
        chosen = dict.fromkeys(name for label in found for name in (arms[label].after, label) if name)
        planned += [queue.Job(arms[name], seed, memory=True) for seed in range(seeds) for name in chosen]
        make(planned)
        save(planned)
    show.line(f"wrote {options.out or folder}/{report.REPORT} and {report.PAGE}")


def main() -> int:
    return command_line.run(Options, run, program="run", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
