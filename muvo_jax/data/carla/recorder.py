"""Records drives in CARLA in the plain format: the loop, health checks, resuming. Nothing here imports carla.

A `Simulator` (client.py, or a test's) hands over the client's own measurements; frames.py decodes them.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from muvo_jax.data import processes, schema
from muvo_jax.data.carla import frames as carla_frames
from muvo_jax.data.carla.drives import FILES, SPLITS, BadDriveError, CarlaDrive, CarlaError, Settings, estimate
from muvo_jax.data.carla.frames import SENSORS, Tick
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.plain import writer as plain_writer

ATTEMPTS = 3
MOVING_MPS = 1.0
FROZEN_FRAMES = 10
BLOCKED_S = 90.0
OFF_ROUTE_M = 12.0
_IN_LANE_M = 2.0


class Simulator(Protocol):
    """All that the recorder asks of CARLA."""

    def start(self, job: CarlaDrive) -> Tick:
        """Loads town and weather, places traffic, car and sensors, and returns the first tick to record."""
        ...

    def step(self) -> Tick:
        """One tick on."""
        ...

    def route_m(self) -> np.ndarray:
        """The planned route, float [P, 2], frame of the map (right-handed), points ROUTE_SPACING_M apart."""
        ...

    def stop(self) -> None:
        """Removes what `start` placed; also after a failure."""
        ...


def record(out: pathlib.Path, simulator: Simulator, jobs: Sequence[CarlaDrive], settings: Settings, *,
           progress: Callable[[int, int], None] | None = None) -> None:
    """Records every run that is not complete.

    Raises:
      FileExistsError: where OUT holds a recording of other sensors.
      BlockingIOError: where another process records into OUT now.
      CarlaError: where a sensor stalls, is blank or frozen, nothing is written, the disk is too small, or a drive
        fails ATTEMPTS times. The run in question stays incomplete and is recorded again next time.
    """
    out = out.expanduser()
    _describe(out, settings)
    with processes.locked(out / ".recording", "recording"):
        _record_missing(out, simulator, jobs, settings, progress)


def _record_missing(out: pathlib.Path, simulator: Simulator, jobs: Sequence[CarlaDrive], settings: Settings,
                    progress: Callable[[int, int], None] | None) -> None:
    for job in jobs:
        if plain_writer.is_complete(out, job.split, job.run):
            continue
        needed, free = estimate(out, jobs, settings), shutil.disk_usage(out).free
        if needed.measured and needed.disk_bytes > free:
            raise CarlaError(f"{out}: {needed.disk_bytes / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free. Make "
                             f"room or record fewer runs; what is complete is kept.")
        done = needed.frames - needed.missing
        for attempt in range(ATTEMPTS):
            try:
                for count in record_run(out, simulator, job._replace(seed=job.seed + attempt), settings):
                    if progress is not None:
                        progress(done + count, needed.frames)
                break
            except BadDriveError:
                if attempt == ATTEMPTS - 1:
                    raise


def record_run(out: pathlib.Path, simulator: Simulator, job: CarlaDrive, settings: Settings) -> Iterator[int]:
    """Records one run, yielding the number of frames so far; frames.csv is written once all files are there."""
    writer = plain_writer.RunWriter(out, job.split, job.run)
    try:
        seen = simulator.start(job)
        first, route = seen, carla_frames.Route(simulator.route_m())
        health = Health(job, settings.rate_hz)
        for index in range(job.frames):
            following = simulator.step()
            pose = carla_frames.pose_of(seen.transform)
            speed_mps = carla_frames.forward_speed(seen.transform, seen.velocity)
            frame = carla_frames.decode(seen, settings)
            health.check(index, seen, following, frame, speed_mps, route.advance(pose))
            control = following.control  # in force from `seen` to `following`
            writer.write({**frame, "frame_id": index, "timestamp_s": round(seen.timestamp_s - first.timestamp_s, 6),
                          "x_m": pose[0], "y_m": pose[1], "yaw_rad": pose[2], "speed_mps": speed_mps,
                          "acceleration": control.throttle if control.throttle > 0 else -control.brake,
                          "steering": control.steer, "reward": reward(seen.collided, *route.deviation(pose)),
                          "is_terminal": seen.collided, "route_map": route.draw(pose), "weather": job.weather})
            seen = following
            yield index + 1
        check_written(writer.folder, job.frames)
        writer.close()
    finally:
        simulator.stop()


def reward(collided: bool, aside_m: float, turned_rad: float) -> float:
    """-1 on a collision, else how well the car keeps to its route: 1 on it and along it, 0 from 2 m or 90 degrees on.

    The town's reward without its term for the speed, since the speed that traffic allows is not known here.
    """
    if collided:
        return -1.0
    return max(0.0, 1.0 - aside_m / _IN_LANE_M) * max(0.0, math.cos(turned_rad))


class Health:
    """Checks each frame of a run before it is written."""

    def __init__(self, job: CarlaDrive, rate_hz: float):
        self._job, self._rate_hz = job, rate_hz
        self._same = dict.fromkeys(SENSORS, 0)
        self._checksums: dict[str, int] = {}
        self._still = 0

    def check(self, index: int, seen: Tick, following: Tick, frame: Mapping[str, np.ndarray],
              speed_mps: float, off_route_m: float) -> None:
        """Raises CarlaError for blank or frozen sensors and lost ticks, BadDriveError for a bad drive."""
        where = f"{self._job.split}/{self._job.run}, frame {index}"
        period_s = following.timestamp_s - seen.timestamp_s
        if following.frame != seen.frame + 1 or abs(period_s * self._rate_hz - 1) > 0.01:
            raise CarlaError(f"{where}: {following.frame - seen.frame} ticks, {period_s:.4f} s to the next frame; "
                             f"expected 1 of {1 / self._rate_hz:g} s. Another client ticks or configures this server.")
        blank = [name for name in ("image", "depth_m", "classes") if frame[name].min() == frame[name].max()]
        blank += ["lidar"] * (len(frame["points_m"]) == 0)
        if blank:
            raise CarlaError(f"{where}: nothing to see in {', '.join(blank)}. Is rendering switched off "
                             f"(no_rendering_mode, no graphics driver)?")
        moving = abs(speed_mps) > MOVING_MPS
        for name in SENSORS:
            checksum = zlib.crc32(seen.measurements[name].raw_data)
            same = moving and checksum == self._checksums.get(name)
            self._same[name], self._checksums[name] = (self._same[name] + 1 if same else 0), checksum
            if self._same[name] >= FROZEN_FRAMES:
                raise CarlaError(f"{where}: sensor {name} has sent the same bytes {FROZEN_FRAMES + 1} times while the "
                                 f"car moves. Restart the server, then run the command again.")
        self._still = 0 if moving else self._still + 1
        if self._still > BLOCKED_S * self._rate_hz:
            raise BadDriveError(f"{where}: the car has not moved for {BLOCKED_S:g} s.")
        if off_route_m > OFF_ROUTE_M:
            raise BadDriveError(f"{where}: the car is {off_route_m:.1f} m off its route.")


def check_written(folder: pathlib.Path, frames: int) -> None:
    """Raises CarlaError where a sensor has fewer files than frames, or empty ones."""
    for name, suffix in FILES.items():
        count = sum(path.stat().st_size > 0 for path in (folder / name).glob(f"*.{suffix}"))
        if not frames or count != frames:
            raise CarlaError(f"{folder / name}: {count} files for {frames} frames. Is the disk full, or does another "
                             f"process record into this folder?")


def _describe(out: pathlib.Path, settings: Settings) -> None:
    camera = schema.Camera.level(settings.width_px, settings.height_px, settings.fov_rad, settings.position_m)
    plain_writer.write_description(out, name="CARLA", rate_hz=settings.rate_hz, camera=camera, lidar=settings.lidar,
                                   voxels=muvo_reader.VOXELS, splits=SPLITS,
                                   contract=dataclasses.replace(muvo_reader.CONTRACT, rate_hz=settings.rate_hz),
                                   classes=muvo_files.CLASSES, route_map=muvo_reader.ROUTE_MAP)
