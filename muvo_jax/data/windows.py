"""Windows of evenly spaced frames inside gap-free sequences, and a bounded cache of the frames they share."""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import threading
from collections.abc import Callable, Collection, Hashable

import numpy as np

from muvo_jax.data import prepare, schema, sequences


@dataclasses.dataclass(frozen=True)
class Window:
    """`frames` frames of one sequence, the first at `start`, each `stride` recorded frames after the one before."""

    sequence: schema.Sequence
    start: int
    frames: int
    stride: int

    @property
    def indices(self) -> range:
        """Indices of the frames within the sequence."""
        return range(self.start, self.start + span(self.frames, self.stride), self.stride)


def span(frames: int, stride: int) -> int:
    """Recorded frames from the first to the last of a window."""
    return (frames - 1) * stride + 1


def find_windows(recording: schema.Recording, split: str, *, frames: int, stride: int,
                 needs: Collection[str] = ()) -> tuple[Window, ...]:
    """All windows of a split that fit into a sequence whose frames have what is needed, in recorded order.

    Raises:
      DataError: for an unknown split, or where every sequence is shorter than the window (naming both lengths).
    """
    if split not in recording.description.splits:
        raise schema.DataError(f"recording {recording.description.name!r} has no split {split!r}; it has "
                               f"{', '.join(recording.description.splits)}.")
    found = tuple(Window(sequence, start, frames, stride) for sequence in recording.sequences
                  if sequence.split == split and sequence.has(needs)
                  for start in range(sequence.length - span(frames, stride) + 1))
    if not found:
        raise too_short(recording, split, frames, stride, needs)
    return found


def too_short(recording: schema.Recording, split: str, frames: int, stride: int,
              needs: Collection[str] = ()) -> schema.DataError:
    """The error for a split without a single window of frames that have what is needed; names both lengths."""
    found = sequences.longest(recording.sequences, split, needs)
    every = sequences.longest(recording.sequences, split)
    start = f"recording {recording.description.name!r}: the longest gap-free sequence of split {split!r}"
    if every >= span(frames, stride) > found:
        lacking = sorted({name for sequence in recording.sequences if sequence.split == split
                          for name in sequence.lacks if name in needs})
        return schema.DataError(f"{start} that has {', '.join(lacking)} has {found} frames, but a window needs "
                                f"{span(frames, stride)}. Record these for that split too, or train a model that does "
                                f"not need them.")
    return schema.DataError(f"{start} has {found} frames, but a window of {frames} frames at stride {stride} needs "
                            f"{span(frames, stride)}. Choose fewer frames (data.frames, data.context, data.horizon) or "
                            f"a smaller data.stride, or record longer runs.")


def spread(windows: tuple[Window, ...], count: int) -> tuple[Window, ...]:
    """At most `count` of the windows (0: all), evenly spread over them, first and last included."""
    if count == 0 or count >= len(windows):
        return windows
    picked = np.linspace(0, len(windows) - 1, count).round().astype(int)
    return tuple(windows[index] for index in picked)


def fingerprint(windows: Collection[Window]) -> str:
    """16 hexadecimal digits that name a list of windows: drives, first frames, lengths and strides, in order."""
    lines = [f"{window.sequence.name} {window.sequence.start + window.start} {window.frames} {window.stride}"
             for window in windows]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def others(windows: tuple[Window, ...]) -> tuple[Window, ...]:
    """For each window another one: the first of another drive from half the list on, or what stands there; () of a
    single window, which has no other."""
    count, drives = len(windows), [window.sequence.name for window in windows]
    if count < 2:
        return ()
    ends = list(range(2 * count))  # of the stretch of one drive that a place lies in; the list goes round
    for place in range(2 * count - 2, -1, -1):
        if drives[place % count] == drives[(place + 1) % count]:
            ends[place] = ends[place + 1]
    found = []
    for index, drive in enumerate(drives):
        half = (index + count // 2) % count
        place = half if drives[half] != drive else (ends[half] + 1) % count
        found.append(windows[place if drives[place] != drive else half])
    return tuple(found)


class StepActions:
    """What was applied over each step of a window: the mean of the recorded actions from its frame to before the next.

    Every action is read once and kept: 8 bytes a frame.
    """

    def __init__(self, recording: schema.Recording):
        self._recording = recording
        self._known: dict[schema.Sequence, np.ndarray] = {}  # float32 [length, 2], NaN until read

    def mean(self, window: Window) -> np.ndarray:
        """float32 [frames, 2]; the last step of a sequence that ends within it is the mean of what there is.

        Safe to call from several threads. Raises DataError as schema.Recording.action.
        """
        sequence = window.sequence
        known = self._known.setdefault(sequence, np.full((sequence.length, 2), np.nan, np.float32))
        stop = min(window.indices[-1] + window.stride, sequence.length)
        for index in range(window.start, stop):
            if np.isnan(known[index]).any():
                known[index] = prepare.applied(self._recording.action(sequence, index))
        return np.stack([known[index:min(index + window.stride, stop)].mean(axis=0) for index in window.indices])


class FrameCache:
    """Prepared frames by key, the least recently used dropped first; safe to use from several threads.

    A frame larger than the whole cache is made every time and not kept.
    """

    def __init__(self, limit_bytes: int):
        self._limit_bytes = limit_bytes
        self._frames: collections.OrderedDict[Hashable, prepare.PreparedFrame] = collections.OrderedDict()
        self._lock = threading.Lock()
        self._bytes = 0

    @property
    def bytes_used(self) -> int:
        """Size of all arrays kept; never above the limit."""
        return self._bytes

    def get(self, key: Hashable, make: Callable[[], prepare.PreparedFrame]) -> prepare.PreparedFrame:
        """Returns the frame of that key, made now if it is not kept. Its arrays are shared: do not write to them.

        Two threads that miss the same key at once may both make it; the frames are equal.
        """
        with self._lock:
            frame = self._frames.get(key)
            if frame is not None:
                self._frames.move_to_end(key)
                return frame
        frame = make()
        size = _size_bytes(frame)
        with self._lock:
            if size <= self._limit_bytes and key not in self._frames:
                self._frames[key] = frame
                self._bytes += size
                while self._bytes > self._limit_bytes:
                    _, dropped = self._frames.popitem(last=False)
                    self._bytes -= _size_bytes(dropped)
        return frame


def _size_bytes(frame: prepare.PreparedFrame) -> int:
    return sum(np.asarray(value).nbytes for value in frame.values())
