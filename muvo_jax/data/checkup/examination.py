"""What is in a recording and what is wrong with it, whatever its format: the findings of `python -m muvo_jax.doctor`.

Frames are looked at in stretches without a gap, spread over the recording, since motion needs neighbours.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import threading
import warnings
from collections.abc import Callable, Iterable
from concurrent import futures
from typing import NamedTuple

import numpy as np

from muvo_jax.data import processes, schema, words
from muvo_jax.data.checkup import alignment as alignment_lib
from muvo_jax.data.checkup import figures as figures_lib
from muvo_jax.data.checkup import judgements

STRETCH_FRAMES = 60
_PICTURES = 16
_NO_POSE = (np.nan, np.nan, np.nan)


class Sample(NamedTuple):
    """A frame that was looked at, and the sequence that it comes from."""

    sequence: schema.Sequence
    frame: schema.RawFrame


class _Look(NamedTuple):
    """What one stretch showed: a row of numbers for each frame (see _motion), errors, frames for pictures, figures."""

    scalars: list[tuple]
    unreadable: list[str]
    samples: list[Sample]
    figures: figures_lib.Figures


@dataclasses.dataclass(frozen=True)
class Checkup:
    """The result: facts by name, findings with problems first, and what pictures need."""

    facts: dict[str, str]
    findings: tuple[judgements.Finding, ...]
    motion: judgements.DrivingLog
    pictures: tuple[Sample, ...]
    alignment: alignment_lib.Alignment | None

    def with_problems(self, texts: Iterable[str]) -> Checkup:
        """The same with more problems."""
        more = tuple(judgements.Finding("problem", text) for text in texts)
        return dataclasses.replace(self, findings=more + self.findings)

    @property
    def problems(self) -> int:
        return sum(finding.level == "problem" for finding in self.findings)


def facts(recording: schema.Recording) -> dict[str, str]:
    """What is there, in words, from the description alone."""
    described, sequences = recording.description, recording.sequences
    runs = {sequence.name for sequence in sequences}
    frames = sum(sequence.length for sequence in sequences)
    known = {"recording": f"{described.name} ({described.kind}, {described.rate_hz:g} Hz)",
             "length": f"{words.counted(len(runs), 'run')}, {words.counted(len(sequences), 'gap-free sequence')}, "
                       f"{words.counted(frames, 'frame')}, {frames / described.rate_hz / 3600:.3f} h"}
    for split in described.splits:
        mine = [sequence for sequence in sequences if sequence.split == split]
        known[f"split {split}"] = (f"{words.counted(sum(s.length for s in mine), 'frame')} in "
                                   f"{words.counted(len(mine), 'sequence')}, the longest "
                                   f"{max((s.length for s in mine), default=0)}")
    if described.camera is not None:
        camera = described.camera
        fov_rad = 2 * math.atan(camera.width_px / 2 / camera.intrinsics[0][0])
        known["camera"] = (f"{camera.width_px}x{camera.height_px} pixels, {math.degrees(fov_rad):.0f} degrees wide, at "
                           f"{_metres(row[3] for row in camera.camera_to_ego[:3])}")
    if described.lidar is not None:
        lidar = described.lidar
        known["lidar"] = (f"{lidar.rows} rows from {math.degrees(lidar.elevation_min_rad):.1f} to "
                          f"{math.degrees(lidar.elevation_max_rad):.1f} degrees, at {_metres(lidar.position_m)}")
    if described.voxels is not None:
        grid = described.voxels
        known["voxels"] = (f"{'x'.join(map(str, grid.shape))} of {grid.voxel_size_m:g} m from {_metres(grid.origin_m)}")
    contract = described.contract
    known["actions"] = (f"{contract.source}, kinematics {contract.kinematics}; 1 is {contract.accel_full_mps2:g} m/s2, "
                        f"-1 is {contract.brake_full_mps2:g} m/s2 of braking, {contract.steer_full_rad:g} rad of "
                        f"steering")
    known["modalities"] = ", ".join(sorted(described.modalities))
    return known


def examine(recording: schema.Recording, warned: Iterable[str] = (), *, frames: int = 600, workers: int | None = None,
            gaps: Iterable[str] = (), progress: Callable[[int, int], None] | None = None) -> Checkup:
    """Reads frames and judges them.

    Args:
      warned: what opening the recording warned of; each becomes a problem.
      frames: about how many to read (0: all), in stretches spread evenly over the sequences.
      workers: how many stretches are read side by side, each by a thread; by default one for each processor.
      gaps: what opening it said of frames that a sensor lacks here and there; each becomes a remark.
      progress: called with (frames done, frames in all), by one thread at a time.
    """
    plan = _stretches(recording.sequences, frames)
    total = sum(stop - start for _, start, stop in plan)
    pictures_at = np.unique(np.linspace(0, max(total - 1, 0), _PICTURES).round().astype(int))
    done, lock = itertools.count(1), threading.Lock()

    def tell() -> None:
        with lock:
            count = next(done)
            if progress is not None:
                progress(count, total)

    firsts = np.cumsum([0, *(stop - start for _, start, stop in plan)])
    look = lambda number: _look(recording, number, plan[number], set(pictures_at - firsts[number]), tell)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with futures.ThreadPoolExecutor(workers or processes.processors()) as pool:
            looks = list(pool.map(look, range(len(plan))))
    motion = _motion([row for look in looks for row in look.scalars])
    samples = [sample for look in looks for sample in look.samples]
    fit = _alignment(recording, samples)
    found = [judgements.Finding("problem", text) for text in warned]
    found += [judgements.Finding("remark", text) for text in gaps]
    found += _of_reading(looks, caught, total)
    figures = figures_lib.Figures(recording.description).merge([look.figures for look in looks])
    found += [*judgements.of_splits(recording), *judgements.of_actions(motion, recording.description.contract),
              *judgements.of_time(motion, recording.description.rate_hz), *judgements.of_units(motion),
              *figures.findings()]
    if (camera := recording.description.camera) is not None:
        own = [(frame["intrinsics"], frame["camera_to_ego"]) for _, frame in samples if "intrinsics" in frame]
        found += judgements.of_cameras([(np.array(camera.intrinsics), np.array(camera.camera_to_ego)), *own],
                                       camera.width_px, camera.height_px)
    if fit is not None:
        found += judgements.of_alignment(fit, recording)
    found += [judgements.Finding("remark", note) for note in recording.description.notes]
    read = total - sum(len(look.unreadable) for look in looks)
    known = facts(recording) | {"read": f"{read} of {words.counted(total, 'frame')} looked at"}
    found.sort(key=lambda finding: finding.level != "problem")
    return Checkup(known, tuple(found), motion, tuple(samples), fit)


def _look(recording: schema.Recording, number: int, stretch: tuple[schema.Sequence, int, int], pictures_at: set[int],
          tell: Callable[[], None]) -> _Look:
    """Reads one stretch; `pictures_at` counts from its first frame."""
    sequence, start, stop = stretch
    look = _Look([], [], [], figures_lib.Figures(recording.description))
    for index in range(start, stop):
        try:
            frame = recording.read(sequence, index)
        except schema.DataError as error:
            look.unreadable.append(str(error))
        else:
            look.figures.add(frame)
            look.scalars.append((number, *frame["action"], frame.get("speed_mps", np.nan),
                                 frame.get("yaw_rate_radps", np.nan), frame["timestamp_s"],
                                 *frame.get("pose", _NO_POSE)))
            if index - start in pictures_at:
                look.samples.append(Sample(sequence, frame))
        tell()
    return look


def _of_reading(looks: list[_Look], caught: list[warnings.WarningMessage], total: int) -> list[judgements.Finding]:
    """Frames that could not be read, in whole or in part."""
    found = []
    unreadable = [text for look in looks for text in look.unreadable]
    if unreadable:
        found.append(judgements.Finding("problem", f"{len(unreadable)} of {words.counted(total, 'frame')} cannot be "
                                        f"read: {' | '.join(unreadable[:3])}"))
    if not total:
        found.append(judgements.Finding("problem", "there is not one frame to look at."))
    said = list(dict.fromkeys(str(warning.message) for warning in caught
                              if issubclass(warning.category, schema.DataWarning)))
    if said:
        found.append(judgements.Finding("problem", f"reading warns {words.counted(len(said), 'time')}: "
                                        f"{' | '.join(said[:3])}"))
    return found


def refused(recording: str, error: schema.DataError) -> Checkup:
    """What can be said of a recording whose reader refuses it: why.

    Args:
      recording: its name, for the facts.
    """
    finding = judgements.Finding("problem", f"{error} Until then nothing else can be looked at.")
    return Checkup({"recording": recording, "read": "nothing"}, (finding,), _motion([]), (), None)


def _motion(scalars: list[tuple]) -> judgements.DrivingLog:
    """From (stretch, acceleration, steering, speed, yaw rate, time stamp, x, y, yaw) of every frame."""
    table = np.array(scalars, np.float64).reshape(-1, 9)
    speed_mps, yaw_rate_radps, timestamp_s = table[:, 3:6].T
    return judgements.DrivingLog(table[:, 0].astype(int), table[:, 1:3], speed_mps, yaw_rate_radps, timestamp_s,
                                 table[:, 6:])


def _metres(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ") m"


def _stretches(sequences: tuple[schema.Sequence, ...], frames: int) -> list[tuple[schema.Sequence, int, int]]:
    """(sequence, start, stop): all, or stretches evenly spread over every frame there is."""
    everything = [(sequence, start, min(start + STRETCH_FRAMES, sequence.length)) for sequence in sequences
                  for start in range(0, sequence.length, STRETCH_FRAMES)]
    wanted = max(1, frames // STRETCH_FRAMES)
    if frames == 0 or wanted >= len(everything):
        return everything
    return [everything[index] for index in np.linspace(0, len(everything) - 1, wanted).round().astype(int)]


def _alignment(recording: schema.Recording, samples: list[Sample]) -> alignment_lib.Alignment | None:
    described = recording.description
    both = [sample.frame for sample in samples if {"image", "points_m"} <= sample.frame.keys()]
    if described.camera is None or described.lidar is None or not both:
        return None
    return alignment_lib.measure(both, described.lidar)
