"""Trains the runs of a study, one process after the other: resumes what stopped, retries once what died."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

import muvo_jax
from experiments.studies import tables

PACKAGE = pathlib.Path(muvo_jax.__file__).parent
# What decides the numbers of a run; other code may change between two sittings.
_NUMERIC = ("config", "data", "heads", "metrics", "model", "nn", "objectives", "ops", "town", "training", "types",
            "choices.py", "evaluate.py", "geometry.py", "head.py", "limits.py", "presets.py", "recordings.py",
            "train.py")
EVALUATION, LOG, DIED, COST = "evaluation.json", "log.txt", "died.txt", "cost.json"
ATTEMPTS = 2


@dataclasses.dataclass(frozen=True)
class Job:
    """One run: an arm, again with memory or not, under a seed."""

    arm: tables.Arm
    seed: int
    memory: bool = False

    @property
    def label(self) -> str:
        return self.arm.name + ("+memory" if self.memory else "")

    @property
    def name(self) -> str:
        return f"{self.label}-s{self.seed}"

    @property
    def after(self) -> str:
        """The name of the run that this one starts from."""
        return self.arm.after + self.name.removeprefix(self.arm.name)


def jobs(study: tables.Study, scale: str, seeds: int) -> list[Job]:
    """All runs without memory: every arm under the first seed, then under the next."""
    return [Job(arm, seed) for seed in range(seeds) for arm in study.planned(scale)]


def of_shard(planned: Sequence[Job], shard: int, shards: int) -> list[Job]:
    """The part of the runs that one of several hosts makes; what comes after another run stays with it."""
    root = lambda job: (job.arm.after or job.arm.name, job.seed)
    chains = list(dict.fromkeys(map(root, planned)))
    return [job for job in planned if chains.index(root(job)) % shards == shard]


def code_fingerprint() -> str:
    """Names the code that decides the numbers of a run, the flags of all studies' arms included."""
    recipes = [(study.base, [(arm.name, arm.flags, arm.after) for arm in study.arms])
               for study in tables.STUDIES.values()]
    digest = hashlib.sha256(repr((recipes, tables.MEMORY)).encode())
    for name in _NUMERIC:
        path = PACKAGE / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def commit() -> str:
    """The checkout's commit, "+" behind it where files differ from it; "unknown" outside a checkout."""
    ask = lambda *words: subprocess.run(["git", "-C", str(PACKAGE.parent), *words], capture_output=True, text=True,
                                        check=False).stdout.strip()
    found = ask("rev-parse", "--short", "HEAD")
    return found + ("+" if ask("status", "--porcelain", "--untracked-files=no") else "") if found else "unknown"


def flags(study: tables.Study, scale: str, job: Job, folder: pathlib.Path, extra: Sequence[str] = ()) -> list[str]:
    """What muvo_jax.train is called with for a fresh run; all --set of study, arm and memory become one."""
    plain, settings = [], []
    parts = [study.base[scale], job.arm.flags, tuple(tables.MEMORY.split()) if job.memory else (), tuple(extra)]
    for part in parts:
        words = list(part)
        cut = words.index("--set") if "--set" in words else len(words)
        plain += words[:cut]
        settings += words[cut + 1:]
    latest = dict(setting.split("=", 1) for setting in settings)  # a later one beats an earlier one
    result = [*plain, f"--seed={job.seed}", f"--name={job.name}", f"--runs-dir={folder}"]
    if latest:
        result += ["--set", *(f"{name}={value}" for name, value in latest.items())]
    return [word.replace("{after}", str(folder / job.after)) for word in result]


def make(study: tables.Study, scale: str, job: Job, folder: pathlib.Path, say: Callable[[str], None],
         extra: Sequence[str] = ()) -> bool:
    """Makes one run, or goes on with it; returns whether it is complete.

    A run that died twice is left out until its died.txt is removed. An interrupt reaches the training, which saves.
    """
    run = folder / job.name
    if (run / EVALUATION).is_file():
        return True
    if (run / DIED).is_file():
        say(f"{job.name}: died {ATTEMPTS} times before, left out; {run / LOG} says why. "
            f"Remove {run / DIED} to try again.")
        return False
    if job.arm.after and (folder / job.after / DIED).is_file():
        say(f"{job.name}: waits for {job.after}, which died.")
        return False
    for attempt in range(ATTEMPTS):
        resumed = any((run / "checkpoints").glob("[0-9]*"))
        if not resumed and run.is_dir():
            _set_aside(run)
        arguments = ([f"--name={job.name}", f"--runs-dir={folder}", "--resume"] if resumed
                     else flags(study, scale, job, folder, extra))
        say(f"{job.name}: {'resumed' if resumed else 'started'}" + (" again" if attempt else ""))
        code, used_s = _run(["muvo_jax.train", *arguments, "--no-evaluate"], folder / f"{job.name}.{LOG}")
        if code == 0 and not (run / EVALUATION).is_file() and _trained(run):  # on what is compared, and no dream
            code, judging_s = _run(["muvo_jax.evaluate", str(run), "--splits", *tables.SPLITS],
                                   folder / f"{job.name}.{LOG}")
            used_s += judging_s
        if run.is_dir():
            cost = json.loads((run / COST).read_text(encoding="utf-8")) if (run / COST).is_file() else {}
            total_s = cost.get("processor_s", 0.0) + used_s
            (run / COST).write_text(json.dumps({"processor_s": round(total_s, 1)}), encoding="utf-8")
        if code == 0 and (run / EVALUATION).is_file():
            return True
        if code in (130, -2, 143, -15) or code == 0:  # interrupted, or stopped and saved
            raise KeyboardInterrupt
        say(f"{job.name}: ended with code {code}; {folder / f'{job.name}.{LOG}'} says why")
    run.mkdir(parents=True, exist_ok=True)
    (folder / f"{job.name}.{LOG}").replace(run / LOG)
    (run / DIED).write_text(f"died {ATTEMPTS} times, last with code {code}\n", encoding="utf-8")
    return False


def _trained(run: pathlib.Path) -> bool:
    """Whether a run has reached its last step."""
    steps = json.loads((run / "config.json").read_text(encoding="utf-8"))["train"]["steps"]
    return (run / "checkpoints" / str(steps)).is_dir()


def _run(command: Sequence[str], log: pathlib.Path) -> tuple[int, float]:
    """Exit code and processor seconds of python -m COMMAND; what it prints is added to `log`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    before = _children_s()
    with log.open("a", encoding="utf-8") as file:
        child = subprocess.Popen([sys.executable, "-m", *command], stdout=file, stderr=subprocess.STDOUT)
        try:
            code = child.wait()
        except KeyboardInterrupt:  # the terminal interrupted the child too, which saves
            child.wait()
            code = 130
    return code, _children_s() - before


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _set_aside(run: pathlib.Path) -> None:
    """A folder without a checkpoint holds nothing to go on from; it is kept under another name."""
    taken = [path.name for path in run.parent.glob(f"{run.name}.stopped*")]
    run.rename(run.with_name(f"{run.name}.stopped{len(taken)}"))


def read(folder: pathlib.Path, job: Job, study: tables.Study) -> dict[str, Any] | None:
    """What came out of one run: None where there is nothing, {"died": text}, or scores and curves.

    Returns:
      {"steps", "parameters", "processor_s", "protocol", "cards": {split: card and samples},
      "scores": {split: {metric: {"mean", "interval"}}},
      "baselines": the same of the training mean and of warp-last, "curves": {split: {metric: [[step, value], ...]}}}
    """
    run = folder / job.name
    if (run / DIED).is_file():
        return {"died": (run / DIED).read_text(encoding="utf-8").strip()}
    if not (run / EVALUATION).is_file():
        return None
    report = json.loads((run / EVALUATION).read_text(encoding="utf-8"))
    splits = {split: report["splits"][split]["imagined"] for split in tables.SPLITS if split in report["splits"]}

    def scores(source: str) -> dict[str, Any]:
        return {split: {metric: {"mean": found[source][metric]["mean"], "interval": found[source][metric]["interval"]}
                        for metric in study.metrics if metric in found[source]}
                for split, found in splits.items() if source in found}

    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines() if line]
    curves = {split: {metric: [[record["step"], record[name]] for record in records
                               if record["kind"] == "validation" and record.get("split") == split and name in record]
                      for metric, name in study.curves.items()} for split in splits}
    cost = json.loads((run / COST).read_text(encoding="utf-8")) if (run / COST).is_file() else {}
    return {"steps": report["step"], "parameters": report["parameters"], **cost, "protocol": report["protocol"],
            "cards": {split: report["splits"][split]["card"] for split in splits}, "scores": scores("model"),
            "baselines": {source: scores(source) for source in ("training_mean", "warp_last")}, "curves": curves}
