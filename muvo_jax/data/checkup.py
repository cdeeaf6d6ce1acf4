"""What is in a recording and what is wrong with it, whatever its format: the findings of `python -m muvo_jax.doctor`.

Frames are looked at in stretches without a gap, spread over the recording, since motion needs neighbours.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from muvo_jax.data import alignment as alignment_lib
from muvo_jax.data import judgements, schema

STRETCH_FRAMES = 60
_PICTURES = 16


class Sample(NamedTuple):
    """A frame that was looked at, and the sequence that it comes from."""

    sequence: schema.Sequence
    frame: schema.RawFrame


@dataclasses.dataclass(frozen=True)
class Checkup:
    """The result: facts by name, findings with problems first, and what pictures need."""

    facts: dict[str, str]
    findings: tuple[judgements.Finding, ...]
    motion: judgements.DrivingLog
    pictures: tuple[Sample, ...]
    alignment: alignment_lib.Alignment | None

    @property
    def problems(self) -> int:
        return sum(finding.level == "problem" for finding in self.findings)


def facts(recording: schema.Recording) -> dict[str, str]:
    """What is there, in words, from the description alone."""
    described, sequences = recording.description, recording.sequences
    runs = {sequence.name for sequence in sequences}
    frames = sum(sequence.length for sequence in sequences)
    known = {"recording": f"{described.name} ({described.kind}, {described.rate_hz:g} Hz)",
             "length": f"{len(runs)} runs, {len(sequences)} gap-free sequences, {frames} frames, "
                       f"{frames / described.rate_hz / 3600:.3f} h"}
    for split in described.splits:
        mine = [sequence for sequence in sequences if sequence.split == split]
        known[f"split {split}"] = (f"{sum(s.length for s in mine)} frames in {len(mine)} sequences, the longest "
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


def examine(recording: schema.Recording, warned: Iterable[str] = (), *, frames: int = 600,
            progress: Callable[[int, int], None] | None = None) -> Checkup:
    """Reads frames and judges them.

    Args:
      warned: what opening the recording warned of; each becomes a problem.
      frames: about how many to read (0: all), in stretches spread evenly over the sequences.
      progress: called with (frames done, frames in all).
    """
    plan = _stretches(recording.sequences, frames)
    total = sum(stop - start for _, start, stop in plan)
    pictures_at = set(np.linspace(0, max(total - 1, 0), _PICTURES).round().astype(int).tolist())
    samples: list[Sample] = []
    scalars: list[tuple] = []
    unreadable: list[str] = []
    figures = judgements.Figures(recording.description)
    done = 0
    for stretch, (sequence, start, stop) in enumerate(plan):
        for index in range(start, stop):
            try:
                frame = recording.read(sequence, index)
            except schema.DataError as error:
                unreadable.append(str(error))
            else:
                figures.add(frame)
                scalars.append((stretch, *frame["action"], frame.get("speed_mps", np.nan),
                                frame.get("yaw_rate_radps", np.nan), frame["timestamp_s"]))
                if done in pictures_at:
                    samples.append(Sample(sequence, frame))
            done += 1
            if progress is not None:
                progress(done, total)
    motion = _motion(scalars)
    fit = _alignment(recording, samples)
    found = [judgements.Finding("problem", text) for text in warned]
    if unreadable:
        found.append(judgements.Finding("problem", f"{len(unreadable)} of {total} frames cannot be read: "
                                        f"{' | '.join(unreadable[:3])}"))
    found += [*judgements.of_splits(recording), *judgements.of_actions(motion, recording.description.contract),
              *judgements.of_time(motion, recording.description.rate_hz), *figures.findings()]
    if fit is not None:
        found += judgements.of_alignment(fit, recording)
    found += [judgements.Finding("remark", note) for note in recording.description.notes]
    known = facts(recording) | {"read": f"{total - len(unreadable)} of {total} frames looked at"}
    found.sort(key=lambda finding: finding.level != "problem")
    return Checkup(known, tuple(found), motion, tuple(samples), fit)


def refused(recording: str, error: schema.DataError) -> Checkup:
    """What can be said of a recording whose reader refuses it: why.

    Args:
      recording: its name, for the facts.
    """
    finding = judgements.Finding("problem", f"{error} Until then nothing else can be looked at.")
    return Checkup({"recording": recording, "read": "nothing"}, (finding,), _motion([]), (), None)


def _motion(scalars: list[tuple]) -> judgements.DrivingLog:
    """From (stretch, acceleration, steering, speed, yaw rate, time stamp) of every frame."""
    table = np.array(scalars, np.float64).reshape(-1, 6)
    return judgements.DrivingLog(table[:, 0].astype(int), table[:, 1:3], table[:, 3], table[:, 4], table[:, 5])


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
    if described.camera is None or described.lidar is None or not samples:
        return None
    return alignment_lib.measure((sample.frame for sample in samples), described.lidar)
