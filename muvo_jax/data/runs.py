"""What the runs of a recording have in common: which fields count as recorded, and which run lacks one of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np

from muvo_jax.data import fields, schema

_WHOLE_SHARE = 0.5  # of a run's frames that need a file of a field, so that the run counts as one that has it
_SHOWN = 4


class Run(NamedTuple):
    """A run: its name, split, number of frames, and the fields that it has."""

    name: str
    split: str
    frames: int
    fields: frozenset[str]


def shared(runs: Sequence[Run], where: str) -> tuple[frozenset[str], dict[str, tuple[str, ...]]]:
    """The fields of a recording, and of each run which of them it lacks; warns of both, by name.

    A field counts where runs with half of the frames have it, and every split has such a run; whatever a few runs have
    beside that is not used, so that it takes no frame away from the others. A sensor counts without regard to splits
    (what is left without it is said where frames are asked for); where no sensor is in half of the frames, the one
    that is in most of them counts.
    """
    total = sum(run.frames for run in runs)
    every = frozenset().union(*(run.fields for run in runs))
    frames = {name: sum(run.frames for run in runs if name in run.fields) for name in every}
    splits = {run.split for run in runs}
    known = {name for name in every if 2 * frames[name] >= total and (
        name in fields.SENSORS or splits == {run.split for run in runs if name in run.fields})}
    if not known & fields.SENSORS and every & fields.SENSORS:
        known.add(max(sorted(every & fields.SENSORS), key=lambda name: frames[name]))
    lacks = {run.name: tuple(sorted(known - run.fields)) for run in runs}
    _warn(runs, every - known, where, lambda run, name: name in run.fields,
          "{fields} is recorded in {runs} only and is not used")
    _warn(runs, known, where, lambda run, name: name not in run.fields,
          "{fields} is missing in {runs}; models that need it pass those by")
    return frozenset(known), lacks


def has_files(present: np.ndarray) -> bool:
    """Whether a run has a field, given which of its frames have a file of it."""
    return bool(present.any() and present.mean() >= _WHOLE_SHARE)


def _warn(runs: Sequence[Run], names: Collection[str], where: str, concerns: Callable[[Run, str], bool],
          sentence: str) -> None:
    """One warning for all fields that the same runs have, or lack."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in sorted(names):
        concerned = tuple(run.name for run in runs if concerns(run, name))
        if concerned:
            groups.setdefault(concerned, []).append(name)
    for concerned, together in groups.items():
        shown = ", ".join(concerned[:_SHOWN]) + ", ..." * (len(concerned) > _SHOWN)
        warnings.warn(f"{where}: " + sentence.format(fields=", ".join(together),
                                                      runs=f"{len(concerned)} of {len(runs)} runs ({shown})") + ".",
                      schema.DataWarning, stacklevel=4)
