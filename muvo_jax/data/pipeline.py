"""Batches of windows for training (endless, shuffled, resumable) and evaluation, and their way to the devices."""

from __future__ import annotations

import dataclasses
import functools
import os
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar

import grain
import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.data import ego_motion, prepare, schema, sequences
from muvo_jax.data import windows as windows_lib

State = dict[str, Any]  # plain JSON types
_READ_AHEAD = 4  # batches, at least
_FEWEST_WORKERS, _MOST_WORKERS = 2, 16
_UNTIMED = ("intrinsics", "camera_to_ego")
_HOST_ONLY = ("timestamp_s", "frame_id")
_Item = TypeVar("_Item")


class Frames:
    """The prepared frames of a recording, made on demand and kept within `config.data.cache_gib`.

    Training and evaluation of one run share one, so that memory is bounded once.
    """

    def __init__(self, recording: schema.Recording, config: config_lib.Config):
        """`config` must be adapted to the recording (fitting.adapt)."""
        self.recording = recording
        self.config = config
        self.cache = windows_lib.FrameCache(int(config.data.cache_gib * 2**30))
        self._actions = windows_lib.StepActions(recording)
        self.needs = prepare.needed(config, recording.description.modalities)
        self._read = {judged: prepare.read_of(config, recording.description.modalities, judged=judged)
                      for judged in (False, True)}
        self._not_in_all = recording.description.modalities - sequences.in_every_frame(recording) - self.needs

    def get(self, sequence: schema.Sequence, index: int, *, judged: bool = False) -> prepare.PreparedFrame:
        """Frame `index` of `sequence`; called from several threads at once.

        Args:
          judged: with what prepare.judged_only names; without, that is not even read.
        """
        names = self._read[judged]
        return self.cache.get((sequence.name, sequence.start + index, names),
                              functools.partial(self._make, sequence, index, names))

    def batch(self, windows: Sequence[windows_lib.Window], *, judged: bool = False) -> types.Batch:
        """The windows, all of one length, as one Batch of NumPy arrays.

        Args:
          judged: with the fields that scores and baselines alone read (prepare.judged_only).

        Raises:
          DataError: for a damaged file, naming it.
        """
        rows = [[self.get(window.sequence, index, judged=judged) for index in window.indices] for window in windows]
        left_out = {*_HOST_ONLY, *(() if judged else prepare.judged_only(self.config))}
        fields: dict[str, np.ndarray] = {}
        for name, example in rows[0][0].items():
            if name in left_out:
                continue
            if name in _UNTIMED:
                fields[name] = np.stack([row[0][name] for row in rows])
                continue
            values = np.empty((len(rows), len(rows[0]), *np.shape(example)), np.asarray(example).dtype)
            for index, row in enumerate(rows):
                for step, frame in enumerate(row):
                    values[index, step] = frame[name]
            fields[name] = values
        if self.config.contract.step_action == "mean":
            fields["action"] = self.actions(windows)
        if "ego_motion" in fields:
            fields["ego_motion"] = ego_motion.between(fields["ego_motion"])
        is_first = np.zeros(fields["action"].shape[:2], bool)
        is_first[:, 0] = True
        return types.Batch(is_first=is_first, **fields).validate()

    def actions(self, windows: Sequence[windows_lib.Window]) -> np.ndarray:
        """Their actions, float32 [B, T, 2]."""
        if self.config.contract.step_action == "mean":
            return np.stack([self._actions.mean(window) for window in windows])
        return np.stack([np.stack([self.get(window.sequence, index, judged=True)["action"] for index in window.indices])
                         for window in windows])

    def scans(self, window: windows_lib.Window, start: int) -> list[np.ndarray]:
        """The scans of a window from its frame `start` on, as recorded: float32 [P, 3] each, ego frame, m."""
        read = functools.partial(_raw, self.recording, names=frozenset({"points_m"}))
        return [read(window.sequence, index)["points_m"] for index in window.indices[start:]]

    def _make(self, sequence: schema.Sequence, index: int, names: frozenset[str]) -> prepare.PreparedFrame:
        raw = _raw(self.recording, sequence, index, names)
        for name in self._not_in_all:  # frames of one batch have the same fields
            raw.pop(name, None)  # type: ignore[misc]
        return prepare.prepare_frame(raw, self.config)


def _raw(recording: schema.Recording, sequence: schema.Sequence, index: int, names: frozenset[str]) -> schema.RawFrame:
    """A frame, of which only these fields are needed."""
    if isinstance(recording, schema.ReadsFields):
        return recording.read_fields(sequence, index, names)
    return recording.read(sequence, index)


class TrainBatches:
    """Endless training batches: every window once an epoch, each epoch in another order, the same for the same seed.

    `get_state` after n batches and a new TrainBatches with that `start_state` give exactly the batches from n + 1 on.
    """

    def __init__(self, frames: Frames, *, seed: int, batch: int | None = None, start_state: State | None = None,
                 process: int = 0, processes: int = 1, accumulate: int = 1):
        """Opens the stream.

        Args:
          batch: windows per batch over all processes, by default config.train.batch.
          process, processes: which share of each batch is read here, such as jax.process_index() of
            jax.process_count(). The order of the windows, and so the saved position, is the same for any number.
          accumulate: micro-batches in a batch; of each of them every process reads its share.
          start_state: from `get_state` of a stream with the same recording, seed and sizes.

        Raises:
          DataError: where no training window fits, or the state belongs to another stream.
        """
        data = frames.config.data
        windows = windows_lib.find_windows(frames.recording, "train", frames=data.frames, stride=data.stride,
                                           needs=frames.needs)
        size = batch or frames.config.train.batch
        self.windows_per_epoch = len(windows)
        if size % (processes * accumulate) or not 0 <= process < processes:
            raise schema.DataError(f"process {process} of {processes}: a batch of {size} windows in {accumulate} "
                                   f"micro-batches needs a number of processes that divides each of them, and a "
                                   f"process from 0 to that number - 1.")
        share = np.arange(size).reshape(accumulate, processes, -1)[:, process].ravel()
        self._identity = {"seed": seed, "windows": len(windows), "batch": size, "frames": data.frames,
                          "stride": data.stride}
        # There is no remainder to drop; without the flag Grain's length of batches of one overflows.
        dataset = grain.MapDataset.source(windows).seed(seed).shuffle().repeat().batch(
            size, drop_remainder=True, batch_fn=lambda chosen: frames.batch([chosen[index] for index in share]))
        # Threads, not processes: decoding and NumPy let go of the interpreter, and all share one cache of frames.
        threads = data.workers or default_workers()
        options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=max(_READ_AHEAD, threads))
        self._iterator = iter(dataset.to_iter_dataset(options))
        if start_state is not None:
            if start_state.get("identity") != self._identity:
                raise schema.DataError(f"the saved position in the data is of {start_state.get('identity')}, this run "
                                       f"has {self._identity}. Resume with the same data and settings, or start anew.")
            self._iterator.set_state(start_state["position"])

    def __iter__(self) -> TrainBatches:
        return self

    def __next__(self) -> types.Batch:
        return next(self._iterator)

    def get_state(self) -> State:
        """Where the stream stands; plain JSON types."""
        return {"identity": dict(self._identity), "position": self._iterator.get_state()}


def default_workers() -> int:
    """One for each processor this process may use but one, which is left to the training step; 2 to 16."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(max(usable - 1, _FEWEST_WORKERS), _MOST_WORKERS)


def train_batches(frames: Frames, *, seed: int, batch: int | None = None,
                  start_state: State | None = None) -> TrainBatches:
    """See TrainBatches."""
    return TrainBatches(frames, seed=seed, batch=batch, start_state=start_state)


@dataclasses.dataclass(frozen=True)
class EvaluationBatch:
    """A batch of always the same size, so that nothing is compiled twice.

    Attributes:
      batch: the windows; the last ones may be repetitions that fill the batch.
      count: how many of its windows are real; leave the others out of every sum.
      windows: the real windows.
      others: for each window of the batch another one, of another drive where there is one: whose actions a model that
        answers to actions must not confuse with the window's own. () where there is one window alone.
    """

    batch: types.Batch
    count: int
    windows: tuple[windows_lib.Window, ...]
    others: tuple[windows_lib.Window, ...]


def evaluation_batches(frames: Frames, split: str, *, windows: int, length: int | None = None,
                       batch: int | None = None, process: int = 0, processes: int = 1) -> Iterator[EvaluationBatch]:
    """Yields the windows of `evaluation_windows`.

    Args:
      windows, length: see there.
      batch: windows per batch, by default config.evaluation.batch.
      process, processes: yields batches `process`, `process + processes` and so on of all.

    Raises:
      DataError: see there; at the call, not at the first batch.
    """
    chosen = evaluation_windows(frames, split, windows=windows, length=length)
    size = batch or frames.config.evaluation.batch
    return _padded_batches(frames, chosen, size, range(process * size, len(chosen), processes * size))


def evaluation_windows(frames: Frames, split: str, *, windows: int,
                       length: int | None = None) -> tuple[windows_lib.Window, ...]:
    """At most `windows` windows of a split (0: all), evenly spread over it, in recorded order.

    Args:
      length: frames of a window, by default context + horizon.

    Raises:
      DataError: for an unknown split or one without a window that long.
    """
    data = frames.config.data
    found = windows_lib.find_windows(frames.recording, split, frames=length or data.context + data.horizon,
                                     stride=data.stride, needs=frames.needs)
    return windows_lib.spread(found, windows)


def _padded_batches(frames: Frames, chosen: tuple[windows_lib.Window, ...], size: int,
                    starts: range) -> Iterator[EvaluationBatch]:
    others = windows_lib.others(chosen)
    for start in starts:
        real, beside = chosen[start:start + size], others[start:start + size]
        missing = size - len(real)
        yield EvaluationBatch(frames.batch(real + real[-1:] * missing, judged=True), len(real), real,
                              beside + beside[-1:] * missing)


class Prefetch(Generic[_Item]):
    """Moves the batches of an iterator to the devices in a background thread, a few ahead.

    Close it (or use it in a `with`) when done; an error of the iterator is raised by the `next` that would have
    returned the failed batch.

    Attributes:
      waited_s: how long the consumer has waited for data so far.
    """

    def __init__(self, iterator: Iterator[_Item], sharding: Any = None, size: int = 2):
        """`sharding` is a jax.sharding.Sharding or device for all leaves; None is the default device."""
        self.waited_s = 0.0
        self._iterator = iterator
        self._sharding = sharding
        self._queue: queue.Queue = queue.Queue(maxsize=size)
        self._state = _state(iterator)
        self._stop = threading.Event()
        self._over = False
        self._thread = threading.Thread(target=self._work, name="prefetch_to_device", daemon=True)
        self._thread.start()

    def __iter__(self) -> Prefetch[_Item]:
        return self

    def __next__(self) -> _Item:
        if self._over:
            raise StopIteration
        start_s = time.perf_counter()
        item, state, error = self._queue.get()
        self.waited_s += time.perf_counter() - start_s
        if error is not None:
            self.close()
            raise error
        self._state = state
        return item

    def get_state(self) -> State | None:
        """The iterator's state after the last batch handed out (not the last read ahead); None where it has none."""
        return self._state

    def close(self) -> None:
        """Stops the thread; further `next` calls raise StopIteration."""
        self._over = True
        self._stop.set()
        while self._thread.is_alive():
            try:  # make room, lest the thread wait for ever
                self._queue.get_nowait()
            except queue.Empty:
                self._thread.join(timeout=0.01)

    def __enter__(self) -> Prefetch[_Item]:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                item = jax.device_put(next(self._iterator), self._sharding)
                self._queue.put((item, _state(self._iterator), None))
        except BaseException as error:  # StopIteration too: it ends the consumer's loop
            self._queue.put((None, None, error))


def _state(iterator: Any) -> State | None:
    return iterator.get_state() if hasattr(iterator, "get_state") else None


def prefetch_to_device(iterator: Iterator[_Item], sharding: Any = None, size: int = 2) -> Prefetch[_Item]:
    """See Prefetch."""
    return Prefetch(iterator, sharding, size)
