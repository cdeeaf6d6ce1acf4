"""Records the town: rollouts of the expert in the plain format, made once and kept in the user's cache.

Runs are independent of each other, so worker processes share them. A worker is this module run as a program: unlike a
forked or spawned process it touches neither the devices nor the main module of whoever asked for the recording.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import IO, NamedTuple, cast

import numpy as np

from muvo_jax import cache
from muvo_jax import config as config_lib
from muvo_jax.data import processes, schema
from muvo_jax.data.plain import writer as plain_writer
from muvo_jax.town import driver, settings
from muvo_jax.town.simulator import WEATHER_NAMES, Town, TownState

# Raised by whatever changes the bytes of a recording, so that old caches are not taken for new ones.
RECORDING_VERSION = 2
# Frames before the first recorded one: the expert has settled and traffic has spread.
WARM_UP_FRAMES = 20
# Below this many frames a worker process costs more time than it saves.
WORKER_FRAMES = 200

REPORT_FRAMES = 10

Progress = Callable[[int, int], None]


class TownDrive(NamedTuple):
    """One run to record."""

    split: str
    run: str
    seed: int
    weather: str
    frames: int
    other_town: int = 0  # added to the town's seed
    restless: bool = False


def check_size(size: str) -> None:
    """Raises ValueError for a size that does not exist, naming those that do."""
    if size not in settings.SIZES:
        raise ValueError(f"town size {size!r} is unknown; known are {', '.join(settings.SIZES)}.")


def jobs(size: str) -> list[TownDrive]:
    """All runs of a size, in the order of splits.

    Raises:
      ValueError: for a size that does not exist.
    """
    check_size(size)
    return [TownDrive(split, f"{index:03d}_{plan.weathers[index % len(plan.weathers)]}", plan.first_seed + index,
                plan.weathers[index % len(plan.weathers)], plan.frames, 1 + index % 2 if restless else 0, restless)
            for split, plan in settings.SIZES[size].items() for index in range(plan.runs)
            for restless in [index >= plan.runs - plan.restless]]


def cached_town(config: config_lib.Config, progress: Progress | None = None, *,
                split: str | None = None) -> pathlib.Path:
    """Returns the folder of the recording that `config` asks for, recording what is missing of it first.

    It lies in the cache folder (cache.py), under town-<hash of everything that decides its content>.

    Args:
      config: data.town_size, data.town_seed, the model's sensors and the action contract are used.
      progress: called with (frames done, frames in all) now and then.
      split: record no other than this one.

    Raises:
      ValueError: for a size or split that does not exist.
      OSError: where there is no cache folder, or it cannot be written.
    """
    check_size(config.data.town_size)
    town_config = settings.from_config(config)
    directory = cache.folder() / f"town-{fingerprint(town_config, config.data.town_size)}"
    known = settings.SIZES[config.data.town_size]
    if split is not None and split not in known:
        raise ValueError(f"the town has no split {split!r}; it has {', '.join(known)}.")
    if _missing(directory, config.data.town_size, split):
        record_town(directory, town_config, config.data.town_size, progress=progress, split=split)
    return directory


def fingerprint(town_config: settings.TownConfig, size: str) -> str:
    """Names everything that decides the bytes of a recording: town, splits, weathers and version."""
    splits = {name: dataclasses.asdict(split) for name, split in settings.SIZES[size].items()}
    weathers = {name: dataclasses.asdict(weather) for name, weather in settings.WEATHERS.items()}
    town = dataclasses.asdict(town_config)
    del town["contract"]["step_action"]  # the same recording either way
    if not town_config.labels:
        del town["labels"]  # a recording without them is named as it was before there were any
    content = json.dumps([RECORDING_VERSION, WARM_UP_FRAMES, town, splits, weathers], sort_keys=True)
    return f"{size}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"


def record_town(directory: pathlib.Path | str, town_config: settings.TownConfig, size: str = "default", *,
                progress: Progress | None = None, workers: int | None = None,
                split: str | None = None) -> pathlib.Path:
    """Records all splits of a size, or one, into `directory`; complete runs that are there already are kept.

    Args:
      workers: processes; by default one for each processor, none for small recordings.

    Raises:
      ValueError: for a size that does not exist.
      FileExistsError: where the directory holds a recording of other settings.
      WorkerError: where a worker failed; its message is included.
    """
    directory = pathlib.Path(directory)
    describe(directory, town_config, tuple(settings.SIZES[size]))
    with processes.locked(directory / ".lock", "recording", wait=True):
        missing = _missing(directory, size, split)
        total = sum(job.frames for job in jobs(size) if split in (None, job.split))
        done = total - sum(job.frames for job in missing)
        if workers is None:
            workers = min(processes.processors(), (total - done) // WORKER_FRAMES)
        frames = (_record_here(directory, town_config, missing) if workers < 1
                  else _record_in_workers(directory, town_config, missing, workers))
        for count in frames:
            done += count
            if progress is not None:
                progress(done, total)
    return directory


def _missing(directory: pathlib.Path, size: str, split: str | None) -> list[TownDrive]:
    """The runs of a size, or of one of its splits, that are not complete."""
    return [job for job in jobs(size)
            if split in (None, job.split) and not plain_writer.is_complete(directory, job.split, job.run)]


def describe(directory: pathlib.Path, town_config: settings.TownConfig, splits: tuple[str, ...]) -> None:
    """Writes the recording's description."""
    camera = schema.Camera.level(town_config.camera_width_px, town_config.camera_height_px, town_config.camera_fov_rad,
                                 town_config.lidar.position_m)
    plain_writer.write_description(directory, name="town", rate_hz=town_config.contract.rate_hz, splits=splits,
                                   contract=town_config.contract, camera=camera, lidar=town_config.lidar,
                                   voxels=town_config.voxels)


def record_run(directory: pathlib.Path, town: Town, job: TownDrive) -> Iterator[int]:
    """Records one run, yielding 1 after each frame. A drive that ends early ends the run early."""
    writer = plain_writer.RunWriter(directory, job.split, job.run)
    state = town.reset(job.seed, job.weather)
    for _ in range(WARM_UP_FRAMES):
        state = town.step(state, town.expert(state))
    for frame in range(job.frames):
        seen = dict(town.render(state))
        action = _chosen(town, state, job.restless)
        x_m, y_m, yaw_rad = state.pose
        occupancy = town.occupancy(seen)
        del seen["range_view"]  # the points say the same
        writer.write({**seen, "occupancy": occupancy, "frame_id": frame,
                      "timestamp_s": round(frame / town.config.contract.rate_hz, 6), "x_m": x_m, "y_m": y_m,
                      "yaw_rad": yaw_rad, "acceleration": action[0], "steering": action[1],
                      "weather": WEATHER_NAMES[int(state.weather)]})
        yield 1
        if seen["is_terminal"]:
            break
        state = town.step(state, action)
    writer.close()


def _chosen(town: Town, state: TownState, restless: bool) -> np.ndarray:
    """The driver's action: the expert's, or what a burst makes of it; throttle only where there is room."""
    action = town.expert(state)
    sudden = driver.burst(int(state.seed), int(state.frame), town.config.contract.rate_hz) if restless else None
    if sudden is None or (sudden[0] > 0 and action[0] < 0):
        return action
    return np.clip(np.where(sudden != 0, sudden, action), -1, 1).astype(np.float32)


def _record_here(directory: pathlib.Path, town_config: settings.TownConfig, missing: list[TownDrive]) -> Iterator[int]:
    yield from (count for job in missing for count in record_run(directory, _town(town_config, job.other_town), job))


@functools.cache
def _town(town_config: settings.TownConfig, other: int) -> Town:
    return Town(dataclasses.replace(town_config, seed=town_config.seed + other))


def _record_in_workers(directory: pathlib.Path, town_config: settings.TownConfig, missing: list[TownDrive],
                       workers: int) -> Iterator[int]:
    """Deals the runs out to worker processes and yields the frames they report, a few at a time."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    root = str(pathlib.Path(__file__).parents[2])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    reports, report_end = os.pipe()
    children = []
    with os.fdopen(reports) as lines, tempfile.TemporaryFile("w+") as errors:
        try:
            for index in range(workers):
                process = subprocess.Popen([sys.executable, "-m", "muvo_jax.town.record"], stdin=subprocess.PIPE,
                                           stdout=report_end, stderr=errors, text=True, env=environment)
                children.append(process)
                order = json.dumps({"directory": str(directory), "town": dataclasses.asdict(town_config),
                                    "jobs": missing[index::workers]})
                with cast(IO[str], process.stdin) as pipe:
                    pipe.write(order)
        finally:
            os.close(report_end)
        try:
            for line in lines:
                yield int(line)
            failed = [process.wait() for process in children]
        finally:
            for process in children:
                process.terminate()
                process.wait()
        if any(failed):
            errors.seek(0)
            raise processes.WorkerError(f"recording the town into {directory} failed (exit codes {failed}):\n"
                                        f"{errors.read()[-2000:]}")


def _work() -> None:
    """What a worker does: reads its order from standard input and prints a line with the frames since the last one."""
    order = json.load(sys.stdin)
    town_config = config_lib.parse(settings.TownConfig, order["town"], "town")
    for job in order["jobs"]:
        frames, town = 0, _town(town_config, TownDrive(*job).other_town)
        for frames, _ in enumerate(record_run(pathlib.Path(order["directory"]), town, TownDrive(*job)), start=1):
            if frames % REPORT_FRAMES == 0:
                _report(REPORT_FRAMES)
        _report(TownDrive(*job).frames - frames // REPORT_FRAMES * REPORT_FRAMES)


def _report(frames: int) -> None:
    """Workers share one pipe: a line must be a single write."""
    os.write(sys.stdout.fileno(), f"{frames}\n".encode())


if __name__ == "__main__":
    _work()
