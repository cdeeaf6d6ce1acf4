"""Which drives are recorded in CARLA: the paper's plan, the sensors, and what disk and hours it takes."""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer

# The paper's section IV: 25 runs of 300 s in each town for training, 5 in each for either validation set.
TOWNS = ("Town01", "Town03", "Town04", "Town06")
WEATHERS = ("ClearNoon", "WetNoon", "HardRainNoon", "ClearSunset")
SHIFTED_WEATHERS = ("CloudyNoon", "WetSunset", "SoftRainSunset", "MidRainyNoon")  # the paper names none
SPLITS = ("train", "val_rl", "val_ds")
RUN_S = 300.0
# What the recorder writes of each frame, beside frames.csv: folder -> suffix.
FILES = {"image": "png", "depth": "png", "classes": "png", "route_map": "png", "lidar": "npz"}


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
    fov_rad: float = muvo_reader.FOV_RAD
    position_m: tuple[float, float, float] = muvo_reader.MOUNT_M
    lidar_rows: int = 64
    lidar_range_m: float = 100.0
    points_per_frame: int = 60_000
    rate_hz: float = muvo_reader.RATE_HZ

    @property
    def lidar(self) -> config_lib.RangeViewGeometry:
        return dataclasses.replace(muvo_reader.LIDAR, rows=self.lidar_rows, position_m=self.position_m)

    @property
    def raw_bytes(self) -> int:
        """A frame's size before compression: RGB, 16-bit depth, classes, points with tags, route map."""
        return self.width_px * self.height_px * (3 + 2 + 1) + self.points_per_frame * 13 + 64 * 64


class CarlaDrive(NamedTuple):
    """One run to record."""

    split: str
    run: str
    town: str
    weather: str
    seed: int
    frames: int


def plan(*, towns: Sequence[str] = TOWNS, train_runs: int = 25, val_runs: int = 5, run_s: float = RUN_S,
         rate_hz: float = muvo_reader.RATE_HZ, seed: int = 0) -> list[CarlaDrive]:
    """The paper's runs: train, val_rl (same weathers) and val_ds (others), weathers drawn at random.

    Raises:
      ValueError: where that is no run, or none with a frame.
    """
    if not towns or min(train_runs, val_runs) < 0 or not train_runs + val_runs or not 1 <= run_s * rate_hz < math.inf:
        raise ValueError(f"{len(towns)} towns, {train_runs} runs to train, {val_runs} to validate, {run_s:g} s each: "
                         f"expected a town, a run and a frame at least.")
    jobs = []
    runs_of, weathers_of = (train_runs, val_runs, val_runs), (WEATHERS, WEATHERS, SHIFTED_WEATHERS)
    for number, (split, runs, weathers) in enumerate(zip(SPLITS, runs_of, weathers_of, strict=True)):
        for town in towns:
            for index in range(runs):
                rng = np.random.default_rng([seed, number, index, *town.encode()])
                jobs.append(CarlaDrive(split, f"{town}_{index:03d}", town, str(rng.choice(weathers)),
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


def estimate(out: pathlib.Path, jobs: Sequence[CarlaDrive], settings: Settings) -> Estimate:
    """See Estimate."""
    out = out.expanduser()
    complete = [job for job in jobs if plain_writer.is_complete(out, job.split, job.run)]
    frames = sum(job.frames for job in jobs)
    missing = frames - sum(job.frames for job in complete)
    frame_bytes, frame_s = float(settings.raw_bytes), 1.0 / settings.rate_hz
    if complete:
        folder = out / complete[0].split / complete[0].run
        # Occupancy that was made of the run later is no part of its recording.
        patterns = [plain_reader.FRAMES_FILE, *(f"{name}/*.{suffix}" for name, suffix in FILES.items())]
        written = [path.stat() for pattern in patterns for path in folder.glob(pattern)]
        times = [status.st_mtime for status in written]
        lines = (folder / plain_reader.FRAMES_FILE).read_text(encoding="utf-8").splitlines()
        rows = max(len(lines) - 1, 1)
        frame_bytes = sum(status.st_size for status in written) / rows
        frame_s = (max(times) - min(times)) / rows
    return Estimate(frames, missing, missing * frame_bytes, missing * frame_s / 3600, bool(complete))
