"""The order of a run's frames: time stamps checked, runs cut at gaps, and what sequences have."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Hashable, Iterable
from typing import TypeVar

import numpy as np

from muvo_jax.data import schema, words

GAP_PERIODS = 1.5  # a time step longer than this many periods is a gap
SAME_RATE = 0.1  # the share by which a run's usual step may differ from the recording's
FEW_SHARE = 0.05  # gaps at no more frames than these (or at one) are what recordings have; more are a fault

_Name = TypeVar("_Name", bound=Hashable)
_Value = TypeVar("_Value")


def named_twice(pairs: Iterable[tuple[_Name, _Value]]) -> tuple[_Name, _Value, _Value] | None:
    """The first name that two different things have, and both of them; None where every name is that of one."""
    first: dict[_Name, _Value] = {}
    for name, value in pairs:
        if first.setdefault(name, value) != value:
            return name, first[name], value
    return None


def check_increasing(timestamps_s: np.ndarray, where: Iterable[str]) -> None:
    """Raises DataError at the first time stamp that is not later than the one before; `where` names each."""
    steps = np.diff(timestamps_s)
    wrong = np.flatnonzero(~(steps > 0))
    if wrong.size:
        index = int(wrong[0]) + 1
        raise schema.DataError(f"{list(where)[index]}: time {timestamps_s[index]:.3f} s does not come after the frame "
                               f"before it ({timestamps_s[index - 1]:.3f} s); time stamps must increase. Sort the "
                               f"frames or remove the wrong ones.")


def after_gap(timestamps_s: np.ndarray, period_s: float) -> np.ndarray:
    """bool [F], the frames that come more than 1.5 periods after the one before; NaN times are no gap."""
    late = np.zeros(len(timestamps_s), bool)
    late[1:] = np.diff(timestamps_s) > GAP_PERIODS * period_s
    return late


def warn_of_rate(where: str, timestamps_s: np.ndarray, period_s: float) -> None:
    """Warns where a run's usual step is shorter or longer than the recording's; after_gap tells of steps left out."""
    if len(timestamps_s) < 3:
        return
    usual_s = float(np.median(np.diff(timestamps_s)))
    if usual_s < (1.0 - SAME_RATE) * period_s or (1.0 + SAME_RATE) * period_s < usual_s <= GAP_PERIODS * period_s:
        warnings.warn(f"{where}: frames follow each other after {usual_s:.4g} s, in the recording after {period_s:.4g} "
                      f"s: speeds and actions would count for another time. Correct rate_hz or the time stamps, or "
                      f"keep runs of another rate in a recording of their own.", schema.DataWarning, stacklevel=4)


def gap_free(present: np.ndarray, breaks: np.ndarray) -> list[tuple[int, int]]:
    """Cuts a run into (start, length) pieces.

    Args:
      present: bool [F], whether every sensor has the frame.
      breaks: bool [F], frames that start a new piece in any case.
    """
    pieces: list[tuple[int, int]] = []
    start: int | None = None
    for index in range(len(present)):
        if start is not None and (breaks[index] or not present[index]):
            pieces.append((start, index - start))
            start = None
        if start is None and present[index]:
            start = index
    if start is not None:
        pieces.append((start, len(present) - start))
    return pieces


class GapWarning(schema.DataWarning):
    """A few frames that a sensor lacks, or jumps in time: sequences are cut there, and the rest is whole."""


def warn_of_gaps(where: str, present: np.ndarray, absent: dict[str, int], late: np.ndarray, pieces: int) -> None:
    """Warns, with counts, of frames that a sensor lacks and of gaps in time; says nothing where there are none.

    Args:
      where: the run.
      present: bool [F].
      absent: sensor -> number of frames it lacks.
      late: bool [F], see after_gap.
      pieces: into how many sequences the run falls.
    """
    found = []
    if not present.all():
        lacking = ", ".join(f"{count} in {sensor}" for sensor, count in absent.items() if count)
        found.append(f"{int((~present).sum())} of {len(present)} frames are left out because a file is missing "
                     f"({lacking})")
    if late.any():
        found.append(f"time jumps by more than {GAP_PERIODS} periods at {int(late.sum())} of {len(present)} frames")
    if found:
        few = max(int((~present).sum()), int(late.sum())) <= max(1, FEW_SHARE * len(present))
        left = words.counted(pieces, "gap-free sequence")
        warnings.warn(f"{where}: {' and '.join(found)}; what is left makes {left}.",
                      GapWarning if few else schema.DataWarning, stacklevel=4)


def longest(sequences: tuple[schema.Sequence, ...], split: str, needed: Collection[str] = ()) -> int:
    """Frames in the longest sequence of a split that has the needed fields, 0 where there is none."""
    return max((sequence.length for sequence in sequences if sequence.split == split and sequence.has(needed)),
               default=0)


def in_every_frame(recording: schema.Recording) -> frozenset[str]:
    """The keys of RawFrame that no sequence lacks."""
    return recording.description.modalities.difference(*(sequence.lacks for sequence in recording.sequences))
