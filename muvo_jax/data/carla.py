"""Recordings in the MUVO / MILE CARLA layout, exactly as the authors' DataWriter and generate_voxels leave them.

    ROOT/trainval/<mode>/<Town>/<run>/pd_dataframe.pkl    one row a frame, paths relative to the run (carla_runs.py)
    ROOT/trainval/<mode>/<Town>/<run>/occupancy/*.npz     ours, optional: muvo_jax.voxelize separates empty and unknown
    ROOT/sensors.toml                                     ours, optional: [camera], [lidar], [voxels], [action], rate_hz

The path may also be the version's folder (trainval), a mode's (train), a town's or a run's. Modes are the splits; where
there is no mode above the towns, all is "train". The layout does not say how the sensors are mounted: without
sensors.toml they are the authors' (data_preprocess.yaml: camera with a field of view of 110 degrees and lidar at
(1, 0, 2) m, voxels of 0.5 m).

As in the authors' dataset class, runs with a mean reward below 0.6 and the first second of each run are left out. Runs
without pd_dataframe.pkl, which they skip in silence, are counted in a warning here. Pickles are read without executing
anything (safe_pickle.py).
"""

from __future__ import annotations

import dataclasses
import math
import pathlib

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import carla_files, carla_runs, description, ego_motion, files, schema

SENSORS_FILE = "sensors.toml"
OCCUPANCY_FOLDER = "occupancy"
RATE_HZ = 10.0
MIN_MEAN_REWARD = 0.6
SKIPPED_S = 1.0
MOUNT_M = (1.0, 0.0, 2.0)
FOV_RAD = math.radians(110.0)
LIDAR = config_lib.RangeViewGeometry(position_m=MOUNT_M)
VOXELS = config_lib.VoxelGrid()
# A pedal is not an acceleration: nothing can be computed from it without the car's engine.
CONTRACT = config_lib.ActionContract(kinematics="none", source="recorded", rate_hz=RATE_HZ)
_ROUTE_PX = 64
# RawFrame key -> kind of file.
_FILES = {"image": "image", "points_m": "points_semantic", "occupancy": "voxel", "route_map": "routemap"}
_LABEL_FILES = {"depth_m": "depth_semantic", "image_classes": "depth_semantic",
                "image_instance_mask": "depth_semantic", "point_classes": "points_semantic",
                "birds_eye_classes": "birdview", "birds_eye_instances": "birdview"}


class CarlaRecording:
    """A folder in the MUVO / MILE CARLA layout."""

    def __init__(self, path: pathlib.Path | str, *, min_mean_reward: float = MIN_MEAN_REWARD,
                 skipped_s: float = SKIPPED_S, labels: frozenset[str] = frozenset()):
        """Reads every data frame and looks which files exist; frames are read by `read`.

        Args:
          min_mean_reward: runs below are left out.
          skipped_s: left out at the start of each run.
          labels: which of schema.LABELS the frames should have, where they are recorded.

        Raises:
          Refused: for a data frame that asks for more than data.
          DataError: where there is no run, none is good enough, or a data frame lacks what is needed.
        """
        path = pathlib.Path(path)
        header = files.read_toml(path / SENSORS_FILE) if (path / SENSORS_FILE).is_file() else {}
        rate_hz = description.rate_hz(header, path / SENSORS_FILE) if "rate_hz" in header else RATE_HZ
        every = carla_runs.find_runs(path)
        kept = [run for run in every if run.frames and not run.mean_reward < min_mean_reward]
        if not kept:
            raise schema.DataError(f"{path}: none of its {len(every)} runs has frames and a mean reward of "
                                   f"{min_mean_reward} or more. Record better ones.")
        self._is_carved = all((run.folder / OCCUPANCY_FOLDER).is_dir() for run in kept)
        self._kinds = _FILES | {key: kind for key, kind in _LABEL_FILES.items() if key in labels}
        if self._is_carved:
            self._kinds["occupancy"] = OCCUPANCY_FOLDER
            kept = [_with_occupancy(run) for run in kept]
        modalities = _modalities(kept, self._kinds)
        self._runs = {run.name: run for run in kept}
        self._actions = {run.name: carla_runs.actions(run) for run in kept}
        self._speeds = {run.name: run.numbers("speed", 1)[:, 0] for run in kept}
        self._yaw_rates = {run.name: carla_runs.yaw_rates(run) for run in kept if "imu" in run.columns}
        self._poses = {name: ego_motion.dead_reckoned(self._speeds[name], rates, rate_hz)
                       for name, rates in self._yaw_rates.items()}
        self._rewards = {run.name: np.clip(run.numbers("reward", 1)[:, 0], -1.0, 1.0) for run in kept}
        self.sequences = tuple(sequence for run in kept
                               for sequence in _cut(run, modalities, self._kinds, skipped_s, rate_hz))
        present = {sequence.split for sequence in self.sequences}
        notes = _notes(every, kept, min_mean_reward, is_binary="occupancy" in modalities and not self._is_carved)
        self.description = schema.RecordingDescription(
            name=path.resolve().name, kind="MUVO CARLA", rate_hz=rate_hz, modalities=modalities,
            splits=tuple(sorted(present, key=lambda split: (split != "train", split))), notes=notes,
            camera=_camera(header, path, kept) if "image" in modalities else None,
            lidar=(description.section(header, "lidar", path / SENSORS_FILE, required=False) or LIDAR),
            voxels=(description.section(header, "voxels", path / SENSORS_FILE, required=False) or VOXELS)
            if "occupancy" in modalities else None,
            classes=carla_files.CLASSES if labels & {"image_classes", "point_classes"} else (),
            contract=description.section(header, "action", path / SENSORS_FILE, required=False)
            or dataclasses.replace(CONTRACT, rate_hz=rate_hz))

    def run(self, name: str) -> carla_runs.Run:
        """The run of a sequence, for what RawFrame does not hold."""
        return self._runs[name]

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        run, row = self._runs[sequence.name], sequence.start + index
        described = self.description
        frame: schema.RawFrame = {
            "action": self.action(sequence, index), "speed_mps": self._speeds[run.name][row],
            "reward": self._rewards[run.name][row], "is_terminal": np.bool_(False),
            "timestamp_s": np.float64(row / described.rate_hz), "frame_id": np.int64(row),
        }
        if run.name in self._yaw_rates:
            frame["yaw_rate_radps"] = self._yaw_rates[run.name][row]
            frame["pose"] = self._poses[run.name][row]
        paths = {key: run.path(kind, row) for key, kind in self._kinds.items() if key in described.modalities}
        if described.camera is not None and "image" in paths:
            camera = described.camera
            frame["image"] = files.read_image(paths["image"], "RGB")
            if frame["image"].shape[:2] != (camera.height_px, camera.width_px):
                raise schema.DataError(f"{paths['image']}: {frame['image'].shape[1]}x{frame['image'].shape[0]} pixels, "
                                       f"the recording's first image has {camera.width_px}x{camera.height_px}. Do not "
                                       f"mix recordings of different settings in one folder.")
            frame["intrinsics"] = np.asarray(camera.intrinsics, np.float32)
            frame["camera_to_ego"] = np.asarray(camera.camera_to_ego, np.float32)
        if described.lidar is not None and "points_m" in paths:
            scan = carla_files.read_points(paths["points_m"], described.lidar.position_m)
            frame["points_m"] = scan.points_m
            if "point_classes" in paths:
                frame["point_classes"] = carla_files.point_classes(scan, paths["points_m"])
        if described.voxels is not None and "occupancy" in paths:
            frame["occupancy"] = (_read_occupancy if self._is_carved else carla_files.read_voxels)(
                paths["occupancy"], described.voxels)
        if "route_map" in paths:
            frame["route_map"] = _nearest(carla_files.read_route_map(paths["route_map"]), _ROUTE_PX)
        return frame | carla_files.read_labels(paths, described.voxels or VOXELS)

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        return self._actions[sequence.name][sequence.start + index]


def occupancy_name(row: int) -> str:
    """Path of a frame's occupancy, relative to the run."""
    return f"{OCCUPANCY_FOLDER}/{OCCUPANCY_FOLDER}_{row:09d}.npz"


def _with_occupancy(run: carla_runs.Run) -> carla_runs.Run:
    names = [occupancy_name(row) for row in range(run.frames)]
    return dataclasses.replace(run, columns=run.columns | {f"{OCCUPANCY_FOLDER}_path": names})


def _read_occupancy(path: pathlib.Path, grid: config_lib.VoxelGrid) -> np.ndarray:
    occupancy = files.read_npz(path, "occupancy").astype(np.uint8, copy=False)
    if occupancy.shape != grid.shape:
        raise schema.DataError(f"{path}: a grid of {list(occupancy.shape)}, expected {list(grid.shape)}. Describe the "
                               f"grid in {SENSORS_FILE}, or make the occupancy again.")
    return occupancy


def _modalities(runs: list[carla_runs.Run], kinds: dict[str, str]) -> frozenset[str]:
    """The keys of RawFrame that at least one run has files of; where another run lacks one, its frames are left out."""
    names = {"speed_mps", "action", "reward", "is_terminal", "timestamp_s", "frame_id"}
    if all("imu" in run.columns for run in runs):
        names |= {"yaw_rate_radps", "pose"}
    names |= {key for key, kind in kinds.items()
              if any(f"{kind}_path" in run.columns and run.path(kind, 0).parent.is_dir() for run in runs)}
    if "image" in names:
        names |= {"intrinsics", "camera_to_ego"}
    return frozenset(names)


def _camera(header: dict, path: pathlib.Path, runs: list[carla_runs.Run]) -> schema.Camera:
    """As described, else the authors' with the size of the first image there is."""
    described = description.section(header, "camera", path / SENSORS_FILE, required=False)
    if described is not None:
        return described
    first = next(place for run in runs for row in range(run.frames) if (place := run.path("image", row)).is_file())
    height_px, width_px = files.read_image(first, "RGB").shape[:2]
    return schema.Camera.level(width_px, height_px, FOV_RAD, MOUNT_M)


def _nearest(picture: np.ndarray, side: int) -> np.ndarray:
    """The pixel in the upper left corner of each of side x side cells, as the reference resizes its route map."""
    rows, columns = (np.arange(side) * size // side for size in picture.shape)
    return np.ascontiguousarray(picture[rows[:, None], columns])


def _notes(every: list[carla_runs.Run], kept: list[carla_runs.Run], min_mean_reward: float, *,
           is_binary: bool) -> tuple[str, ...]:
    notes = ["MUVO layout: an action is (throttle where pressed, else -brake; steering); pedals, not accelerations."]
    if len(kept) < len(every):
        notes.append(f"MUVO layout: {len(every) - len(kept)} of {len(every)} runs are left out, their mean reward is "
                     f"below {min_mean_reward}.")
    if is_binary:
        notes.append("MUVO layout: stored voxels say what is occupied; every other voxel counts as empty, seen or not.")
    return tuple(notes)


def _cut(run: carla_runs.Run, modalities: frozenset[str], kinds: dict[str, str], skipped_s: float,
         rate_hz: float) -> list[schema.Sequence]:
    """The gap-free sequences of a run after its first second; warns of gaps."""
    present = np.ones(run.frames, bool)
    absent = {}
    for key, kind in kinds.items():
        if key not in modalities:
            continue
        if f"{kind}_path" not in run.columns:
            there = np.zeros(run.frames, bool)
        else:
            paths = [run.path(kind, row) for row in range(run.frames)]
            names = {folder: {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
                     for folder in {path.parent for path in paths}}
            there = np.array([path.name in names[path.parent] for path in paths])
        present &= there
        absent[kind] = int((~there).sum())
    late = np.zeros(run.frames, bool)
    pieces = files.gap_free(present, late)
    files.warn_of_gaps(str(run.folder), present, absent, late, len(pieces))
    first = round(skipped_s * rate_hz)
    cut = [(max(start, first), start + length) for start, length in pieces]
    return [schema.Sequence(split=run.split, name=run.name, start=start, length=stop - start)
            for start, stop in cut if stop > start]
