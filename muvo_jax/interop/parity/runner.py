"""Runs the checks of a folder of golden files and counts what passed, failed and was left out."""

from __future__ import annotations

import collections
import dataclasses
import math
import pathlib
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from muvo_jax.interop.parity import cases, golden, rounding
from muvo_jax.training import screen

Print = Callable[[str], None]
RECORDINGS_REASON = "needs recordings: give their folder with --recordings=PATH"
SUBFOLDERS = (".", "p4_full")


@dataclasses.dataclass
class Report:
    """The outcome of a folder.

    Attributes:
      passed, failed: how many entries.
      left_out: reason -> how many entries.
      stopped: groups that raised and files that are unreadable, with what they said; their entries count as failed.
      unexplained: entries that were neither checked nor left out for a stated reason, and files that no check reads.
    """

    passed: int = 0
    failed: int = 0
    left_out: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    stopped: list[str] = dataclasses.field(default_factory=list)
    unexplained: list[str] = dataclasses.field(default_factory=list)

    @property
    def ok(self) -> bool:
        return self.passed > 0 and not self.failed and not self.stopped and not self.unexplained

    def lines(self) -> list[str]:
        """The summary, a line each."""
        checked = self.passed + self.failed
        out = [f"{checked} entries checked: {self.passed} passed, {self.failed} failed; "
               f"{sum(self.left_out.values()) + len(self.unexplained)} left out"]
        out += [f"left out, {count}: {reason}" for reason, count in self.left_out.items()]
        out += [f"stopped: {problem}" for problem in self.stopped]
        return out + [f"left out WITHOUT A REASON: {name}" for name in self.unexplained]


def run_folder(folder: pathlib.Path, registry: Sequence[cases.FileChecks], *, only: Iterable[str] = (),
               recordings: pathlib.Path | None = None, write: Print = print) -> Report:
    """Checks every file in a folder, and in its subfolder p4_full.

    Args:
      folder: holds npz files and pack.json; a folder with golden files of recordings alone needs no pack.json.
      registry: all kinds of golden files that can be checked.
      only: names of kinds or their beginnings ("p3" stands for p3_1d and p3_2d); none means all.
      recordings: folder of recordings, for the golden files that need some.
      write: gets one line for each entry.

    Raises:
      golden.GoldenError: where the folder holds no golden file, or pack.json is unreadable. An unreadable golden file
        counts as failed.
      ValueError: for an unknown name in `only`.
    """
    chosen = _chosen(registry, tuple(only))
    report, tasks = Report(), []
    for path in _files(folder):
        checks = next((checks for checks in registry if checks.reads(path.name)), None)
        if checks is None and not only:
            report.unexplained.append(f"{path.name}: no check reads this file")
        elif checks in chosen:
            tasks.append((checks, path))
    tasks.sort(key=lambda task: registry.index(task[0]))
    if not tasks:
        raise golden.GoldenError(f"{folder}: expected golden files such as p1_losses_metrics.npz, found none"
                              f"{' of ' + ', '.join(only) if only else ''}.")
    optional = all(checks.needs_recordings for checks, _ in tasks)
    settings = golden.Settings(None if optional and not (folder / "pack.json").exists() else folder)
    for checks, path in tasks:
        try:
            file = golden.File(path)
        except golden.GoldenError as error:
            report.failed += 1
            report.stopped.append(str(error))
            write(f"{path.stem:28s} FAIL  ({error})")
        else:
            run_file(checks, cases.Context(file, settings, recordings), report, write)
    return report


def run_file(checks: cases.FileChecks, context: cases.Context, report: Report, write: Print) -> None:
    """Checks the entries of one file, adding to `report`.

    A group that stops does not hide the others. Which entries it would have checked is not known: all that no other
    group checks fail.
    """
    done: set[str] = set()
    label = context.file.path.stem
    skipped = checks.needs_recordings and context.recordings is None
    stopped = []
    for group in () if skipped else checks.groups:
        try:
            for check in group(context):
                if (check.stands_alone or check.entry in context.file) and check.entry not in done:
                    done.add(check.entry)
                    _record(check, context.file, label, report, write)
        except Exception as error:
            stopped.append(f"{_name(group)} stopped with {screen.said(error)}")
    report.stopped += [f"{label}: {problem}" for problem in stopped]
    for entry in context.file.names:
        if entry not in done:
            reason = RECORDINGS_REASON if skipped else checks.reason(entry)
            if reason is not None:
                report.left_out[f"{label}: {reason}"] += 1
            elif stopped:
                report.failed += 1
                write(f"{label:28s} {entry:44s} FAIL  ({'; '.join(stopped)})")
            else:
                report.unexplained.append(f"{label} {entry}")


def _record(check: cases.Check, file: golden.File, label: str, report: Report, write: Print) -> None:
    """Counts one entry and writes its line; one whose error cannot be computed fails."""
    try:
        error, note = _error(check, file)
    except Exception as problem:
        error, note = math.inf, str(problem) if isinstance(problem, ValueError) else screen.said(problem)
    passed = error <= check.tolerance
    report.passed += passed
    report.failed += not passed
    write(f"{label:28s} {check.entry:44s} error {error:8.1e}  tolerance {check.tolerance:7.0e}  "
          f"{'pass' if passed else 'FAIL'}{f'  ({note})' if note else ''}")


def _error(check: cases.Check, file: golden.File) -> tuple[float, str]:
    """The error of an entry and what to say of it. Other roundings are asked for only where the first one misses."""
    first = error = check.measure(file, check.entry, check.got)
    if error <= check.tolerance:
        return error, check.note
    for tries, value in enumerate(check.again() if check.again else (), start=1):
        error = min(error, check.measure(file, check.entry, value))
        if error <= check.tolerance:
            return error, f"{first:.1e} as first rounded, this in try {tries}"
    if check.noise:
        noise = check.noise()
        return (rounding.error_beyond(file, check.entry, check.got, noise),
                f"{first:.1e} with the noise of the reference's formula, at most {np.max(noise):.1e}")
    if check.roundings and rounding.is_near_zero(file, check.entry, check.tolerance):
        error, note = rounding.error_near_zero(file, check.entry, check.roundings(), check.tolerance)
        return min(first, error), f"{first:.1e} as first rounded; {note}"
    return error, check.note


def _files(folder: pathlib.Path) -> list[pathlib.Path]:
    if not folder.is_dir():
        found = "a file" if folder.exists() else "none"
        raise golden.GoldenError(f"{folder}: expected a folder of golden files, found {found}.")
    return sorted(path for name in SUBFOLDERS for path in (folder / name).glob("*.npz"))


def _chosen(registry: Sequence[cases.FileChecks], only: tuple[str, ...]) -> list[cases.FileChecks]:
    unknown = [name for name in only if not any(checks.name.startswith(name) for checks in registry)]
    if unknown:
        raise ValueError(f"--only={','.join(unknown)}: expected some of "
                         f"{', '.join(checks.name for checks in registry)}.")
    return [checks for checks in registry if not only or checks.name.startswith(only)]


def _name(group: cases.Group) -> str:
    return getattr(group, "__name__", str(group))
