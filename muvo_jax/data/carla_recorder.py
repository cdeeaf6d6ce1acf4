"""Records drives in CARLA in the plain format: plan, estimate, decoding, health checks. Nothing here imports carla.

A `Simulator` (carla_client.py, or a test's) hands over the client's own measurements: BGRA images, depth in three
bytes, semantic tags in the red channel, lidar detections of 24 bytes. Right-handed from here on: y left.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import queue
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from PIL import Image, ImageDraw

from muvo_jax import config as config_lib
from muvo_jax.data import carla, carla_files, plain, recorder, schema
from muvo_jax.ops import camera as camera_ops

# The paper's section IV: 25 runs of 300 s in each town for training, 5 in each for either validation set.
TOWNS = ("Town01", "Town03", "Town04", "Town06")
WEATHERS = ("ClearNoon", "WetNoon", "HardRainNoon", "ClearSunset")
SHIFTED_WEATHERS = ("CloudyNoon", "WetSunset", "SoftRainSunset", "MidRainyNoon")  # the paper names none
SPLITS = ("train", "val_rl", "val_ds")
RUN_S = 300.0
CAMERAS = ("image", "depth", "classes")
SENSORS = (*CAMERAS, "lidar")
_DETECTION = np.dtype([("point", "<f4", 3), ("cos_angle", "<f4"), ("object", "<u4"), ("tag", "<u4")])
# The layout's route map: 192 pixels, 5 a metre, the ego vehicle 32 above the lower edge; its reader takes every third.
_ROUTE_PX, _ROUTE_PX_PER_M, _EGO_ROW, _ROUTE_WIDTH_PX, _ROUTE_STEP = 192, 5.0, 160, 16, 3
_ROUTE_AHEAD = 40  # points drawn, and searched for the nearest
ROUTE_SPACING_M = 2.0
ATTEMPTS = 3
MOVING_MPS = 1.0
FROZEN_FRAMES = 10
BLOCKED_S = 90.0
OFF_ROUTE_M = 12.0


class CarlaError(OSError):
    """The simulator or a sensor does not do what a recording needs; the message says which, when and what to try."""


class BadDriveError(CarlaError):
    """The car is stuck or off its route: the sensors are fine and another seed may do."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Sensors and rate; the defaults are the paper's (points_per_frame: its upper bound).

    Attributes:
      position_m: of cameras and lidar in the ego frame; they look straight ahead.
    """

    width_px: int = 960
    height_px: int = 600
    fov_rad: float = carla.FOV_RAD
    position_m: tuple[float, float, float] = carla.MOUNT_M
    lidar_rows: int = 64
    lidar_range_m: float = 100.0
    points_per_frame: int = 60_000
    rate_hz: float = carla.RATE_HZ

    @property
    def lidar(self) -> config_lib.RangeViewGeometry:
        return dataclasses.replace(carla.LIDAR, rows=self.lidar_rows, position_m=self.position_m)

    @property
    def raw_bytes(self) -> int:
        """A frame's size before compression: RGB, 16-bit depth, classes, points with tags, route map."""
        return self.width_px * self.height_px * (3 + 2 + 1) + self.points_per_frame * 13 + 64 * 64


class Job(NamedTuple):
    """One run to record."""

    split: str
    run: str
    town: str
    weather: str
    seed: int
    frames: int


class Observed(NamedTuple):
    """One tick. transform, velocity and control are the client's; `control` led from the tick before to this one."""

    frame: int
    timestamp_s: float
    transform: Any
    velocity: Any
    control: Any
    measurements: Mapping[str, Any]


class Simulator(Protocol):
    """All that the recorder asks of CARLA."""

    def start(self, job: Job) -> Observed:
        """Loads town and weather, places traffic, car and sensors, and returns the first tick to record."""
        ...

    def step(self) -> Observed:
        """One tick on."""
        ...

    def route_m(self) -> np.ndarray:
        """The planned route, float [P, 2], frame of the map (right-handed), points ROUTE_SPACING_M apart."""
        ...

    def stop(self) -> None:
        """Removes what `start` placed; also after a failure."""
        ...


def plan(*, towns: Sequence[str] = TOWNS, train_runs: int = 25, val_runs: int = 5, run_s: float = RUN_S,
         rate_hz: float = carla.RATE_HZ, seed: int = 0) -> list[Job]:
    """The paper's runs: train, val_rl (same weathers) and val_ds (others), weathers drawn at random."""
    jobs = []
    runs_of, weathers_of = (train_runs, val_runs, val_runs), (WEATHERS, WEATHERS, SHIFTED_WEATHERS)
    for number, (split, runs, weathers) in enumerate(zip(SPLITS, runs_of, weathers_of, strict=True)):
        for town in towns:
            for index in range(runs):
                rng = np.random.default_rng([seed, number, index, *town.encode()])
                jobs.append(Job(split, f"{town}_{index:03d}", town, str(rng.choice(weathers)),
                                int(rng.integers(1 << 30)), round(run_s * rate_hz)))
    return jobs


class Estimate(NamedTuple):
    """What recording the missing runs takes. `measured`: from a complete run; else sizes before compression and the
    time that the drives themselves last."""

    frames: int
    missing: int
    disk_bytes: float
    hours: float
    measured: bool

    def __str__(self) -> str:
        how = "measured on a run that is there" if self.measured else (
            "bounds before the first run: disk before compression, hours if the simulator keeps up with the clock")
        return (f"{self.missing} of {self.frames} frames are missing: {self.disk_bytes / 1e9:.1f} GB and "
                f"{self.hours:.1f} hours ({how}).")


def estimate(out: pathlib.Path, jobs: Sequence[Job], settings: Settings) -> Estimate:
    """See Estimate."""
    complete = [job for job in jobs if recorder.is_complete(out, job.split, job.run)]
    frames = sum(job.frames for job in jobs)
    missing = frames - sum(job.frames for job in complete)
    frame_bytes, frame_s = float(settings.raw_bytes), 1.0 / settings.rate_hz
    if complete:
        folder = out / complete[0].split / complete[0].run
        written = [path.stat() for path in folder.rglob("*") if path.is_file()]
        times = [status.st_mtime for status in written]
        rows = len((folder / plain.FRAMES_FILE).read_text(encoding="utf-8").splitlines()) - 1
        frame_bytes = sum(status.st_size for status in written) / rows
        frame_s = (max(times) - min(times)) / rows
    return Estimate(frames, missing, missing * frame_bytes, missing * frame_s / 3600, bool(complete))


def record(out: pathlib.Path, simulator: Simulator, jobs: Sequence[Job], settings: Settings, *,
           progress: Callable[[int, int], None] | None = None) -> None:
    """Records every run that is not complete.

    Raises:
      FileExistsError: where OUT holds a recording of other sensors.
      CarlaError: where a sensor stalls, is blank or frozen, nothing is written, the disk is too small, or a drive
        fails ATTEMPTS times. The run in question stays incomplete and is recorded again next time.
    """
    _describe(out, settings)
    for job in jobs:
        if recorder.is_complete(out, job.split, job.run):
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


def record_run(out: pathlib.Path, simulator: Simulator, job: Job, settings: Settings) -> Iterator[int]:
    """Records one run, yielding the number of frames so far; frames.csv is written once all files are there."""
    writer = recorder.RunWriter(out, job.split, job.run)
    try:
        seen = simulator.start(job)
        first, route = seen, Route(simulator.route_m())
        health = Health(job, settings.rate_hz)
        for index in range(job.frames):
            following = simulator.step()
            pose, speed_mps = pose_of(seen.transform), forward_speed(seen.transform, seen.velocity)
            frame = decode(seen, settings)
            health.check(index, seen, following, frame, speed_mps, route.advance(pose))
            control = following.control  # in force from `seen` to `following`
            writer.write({**frame, "frame_id": index, "timestamp_s": round(seen.timestamp_s - first.timestamp_s, 6),
                          "x_m": pose[0], "y_m": pose[1], "yaw_rad": pose[2], "speed_mps": speed_mps,
                          "acceleration": control.throttle if control.throttle > 0 else -control.brake,
                          "steering": control.steer, "route_map": route.draw(pose), "weather": job.weather})
            seen = following
            yield index + 1
        check_written(writer.folder, job.frames)
        writer.close()
    finally:
        simulator.stop()


def collect(queues: Mapping[str, queue.Queue], frame: int, timeout_s: float) -> dict[str, Any]:
    """Each sensor's measurement of this frame; what is older is passed over.

    Raises:
      CarlaError: naming the sensor that sends nothing in time or has gone past the frame.
    """
    found = {}
    for name, waiting in queues.items():
        while name not in found:
            try:
                measurement = waiting.get(timeout=timeout_s)
            except queue.Empty:
                raise CarlaError(f"sensor {name} stalled: nothing for frame {frame} in {timeout_s:g} s. Restart the "
                                 f"server (and see that it renders), then run the command again.") from None
            if measurement.frame > frame:
                raise CarlaError(f"sensor {name} sent frame {measurement.frame} while {frame} was awaited: another "
                                 f"client ticks this server, or the sensor dropped a frame.")
            if measurement.frame == frame:
                found[name] = measurement
    return found


def decode(seen: Observed, settings: Settings) -> dict[str, np.ndarray]:
    """The measurements of a tick as recorder.RunWriter.write takes them."""
    pixels = {name: bgra(seen.measurements[name], name, settings) for name in CAMERAS}
    detections = np.frombuffer(seen.measurements["lidar"].raw_data, _DETECTION)
    points_m = carla_files.to_ego_frame(detections["point"], settings.position_m)
    keep = np.isfinite(points_m).all(axis=1) & ~carla_files.in_ego_box(points_m)
    return {"image": pixels["image"][..., 2::-1],
            # Blue is the most significant byte.
            "depth_m": carla_files.DEPTH_RANGE_M * carla_files.decode_depth(pixels["depth"]),
            "classes": carla_files.LAYOUT_TAGS[pixels["classes"][..., 2]], "points_m": points_m[keep],
            "point_tags": carla_files.LAYOUT_TAGS[np.minimum(detections["tag"][keep], 255)]}


def bgra(measurement: Any, name: str, settings: Settings) -> np.ndarray:
    """A camera's raw_data, uint8 [H, W, 4]; raises CarlaError for another size than asked for."""
    pixels = np.frombuffer(measurement.raw_data, np.uint8)
    shape = (settings.height_px, settings.width_px, 4)
    if (measurement.height, measurement.width) != shape[:2] or pixels.size != math.prod(shape):
        raise CarlaError(f"sensor {name}: {measurement.width}x{measurement.height} pixels in {pixels.size} bytes, "
                         f"expected {settings.width_px}x{settings.height_px} of 4 bytes.")
    return pixels.reshape(shape)


def pose_of(transform: Any) -> tuple[float, float, float]:
    """x_m, y_m, yaw_rad, right-handed, of a carla.Transform."""
    return transform.location.x, -transform.location.y, -math.radians(transform.rotation.yaw)


def forward_speed(transform: Any, velocity: Any) -> float:
    """Metres a second along the car's axis; negative when it rolls back."""
    pitch, yaw = math.radians(transform.rotation.pitch), math.radians(transform.rotation.yaw)
    return (math.cos(pitch) * (velocity.x * math.cos(yaw) + velocity.y * math.sin(yaw)) + velocity.z * math.sin(pitch))


class Route:
    """A planned route, and how far along it the car is."""

    def __init__(self, points_m: np.ndarray):
        self._points_m, self._next = np.asarray(points_m, np.float64), 0

    def advance(self, pose: tuple[float, float, float]) -> float:
        """Moves on to the nearest point ahead; returns the distance to it, metres."""
        ahead = self._points_m[self._next:self._next + _ROUTE_AHEAD]
        distances_m = np.hypot(*(ahead - pose[:2]).T)
        self._next += int(distances_m.argmin())
        return float(distances_m.min())

    def draw(self, pose: tuple[float, float, float]) -> np.ndarray:
        """The way ahead from above, uint8 [64, 64], 255 on the route, forward is up."""
        offset = self._points_m[self._next:self._next + _ROUTE_AHEAD] - pose[:2]
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        forward, left = offset[:, 0] * cosine + offset[:, 1] * sine, offset[:, 1] * cosine - offset[:, 0] * sine
        picture = Image.new("L", (_ROUTE_PX, _ROUTE_PX))
        line = np.stack([_ROUTE_PX / 2 - left * _ROUTE_PX_PER_M, _EGO_ROW - forward * _ROUTE_PX_PER_M], axis=1)
        ImageDraw.Draw(picture).line(list(map(tuple, line.tolist())), fill=255, width=_ROUTE_WIDTH_PX)
        return np.asarray(picture)[::_ROUTE_STEP, ::_ROUTE_STEP]


class Health:
    """Checks each frame of a run before it is written."""

    def __init__(self, job: Job, rate_hz: float):
        self._job, self._rate_hz = job, rate_hz
        self._same = dict.fromkeys(SENSORS, 0)
        self._checksums: dict[str, int] = {}
        self._still = 0

    def check(self, index: int, seen: Observed, following: Observed, frame: Mapping[str, np.ndarray],
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
    for name, suffix in (("image", "png"), ("depth", "png"), ("classes", "png"), ("route_map", "png"),
                         ("lidar", "npz")):
        count = sum(path.stat().st_size > 0 for path in (folder / name).glob(f"*.{suffix}"))
        if not frames or count != frames:
            raise CarlaError(f"{folder / name}: {count} files for {frames} frames. Is the disk full, or does another "
                             f"process record into this folder?")


def _describe(out: pathlib.Path, settings: Settings) -> None:
    intrinsics = camera_ops.intrinsics_from_fov(settings.width_px, settings.height_px, settings.fov_rad)
    pose = camera_ops.level_camera_to_ego(settings.position_m)
    camera = schema.Camera(settings.width_px, settings.height_px, tuple(map(tuple, intrinsics.tolist())),
                           tuple(map(tuple, pose.tolist())))
    recorder.write_description(out, name="CARLA", rate_hz=settings.rate_hz, camera=camera, lidar=settings.lidar,
                               splits=SPLITS,
                               contract=dataclasses.replace(carla.CONTRACT, rate_hz=settings.rate_hz))
