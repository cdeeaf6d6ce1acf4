"""Whether the files of a run were changed: a fingerprint of names, sizes and times, without opening them."""

from __future__ import annotations

import hashlib
import os
import pathlib
from collections.abc import Collection, Iterable, Iterator


def of_runs(source: pathlib.Path, runs: Collection[str]) -> dict[str, str]:
    """Name of a run -> the fingerprint of its files and of those that belong to no run (descriptions, calibrations).

    A run's files lie below a folder whose path in the source ends with the run's name, as in every format; where none
    does (the source is a run itself), all files count.
    """
    shared: list[str] = []
    states: dict[str, list[str]] = {run: [] for run in runs}
    folders = {pathlib.PurePosixPath(run).parts: run for run in runs}
    for folder, names in _walk(source):
        run = _run_of(folder.relative_to(source).parts, folders)
        state = shared if run is None else states[run]
        state += _states(source, (folder / name for name in names))
    common = combined(shared)
    return {run: combined([common, *state]) for run, state in states.items()}


def of_files(source: pathlib.Path, paths: Iterable[pathlib.Path]) -> str:
    """The fingerprint of some files, by their paths as seen from the source."""
    return combined(_states(source, paths))


def _states(source: pathlib.Path, paths: Iterable[pathlib.Path]) -> Iterator[str]:
    for path in paths:
        try:
            stat = path.stat()
        except OSError:  # a link to nowhere
            continue
        yield f"{pathlib.PurePath(os.path.relpath(path, source)).as_posix()} {stat.st_size} {stat.st_mtime_ns}"


def combined(texts: Iterable[str]) -> str:
    """Hexadecimal, of texts in their order."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(f"{len(text)} {text}\n".encode())
    return digest.hexdigest()[:32]


def _walk(source: pathlib.Path) -> Iterator[tuple[pathlib.Path, list[str]]]:
    """(folder, names of its files) in a fixed order, through links but nowhere twice; hidden ones are left out."""
    seen = set()
    for folder, inside, names in os.walk(source, followlinks=True):
        inside[:] = sorted(name for name in inside if not name.startswith("."))
        real = os.path.realpath(folder)
        if real in seen:
            inside.clear()
            continue
        seen.add(real)
        yield pathlib.Path(folder), sorted(name for name in names if not name.startswith("."))


def _run_of(parts: tuple[str, ...], folders: dict[tuple[str, ...], str]) -> str | None:
    """The run in whose folder this one is."""
    for length in {len(folder) for folder in folders}:
        for start in range(len(parts) - length + 1):
            run = folders.get(parts[start:start + length])
            if run is not None:
                return run
    return None
