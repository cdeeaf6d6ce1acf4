"""Recordings in the MUVO / MILE CARLA layout, exactly as the authors' DataWriter and generate_voxels leave them.

    ROOT/trainval/<mode>/<Town>/<run>/pd_dataframe.pkl    one row a frame, paths relative to the run (carla_files.py)
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
import warnings
from collections.abc import Sequence

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import carla_files, description, ego_motion, files, safe_pickle, schema
from muvo_jax.ops import camera as camera_ops

FRAME_FILE = "pd_dataframe.pkl"
SENSORS_FILE = "sensors.toml"
VERSION_FOLDER = "trainval"
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
_MODES = ("train", "val0", "val1", "val2")
# RawFrame key -> kind of file.
_FILES = {"image": "image", "points_m": "points_semantic", "occupancy": "voxel", "route_map": "routemap"}
_LABEL_FILES = {"depth_m": "depth_semantic", "image_classes": "depth_semantic",
                "image_instance_mask": "depth_semantic", "point_classes": "points_semantic",
                "birds_eye_classes": "birdview", "birds_eye_instances": "birdview"}


@dataclasses.dataclass(frozen=True)
class Run:
    """One run, as it lies there.

    Attributes:
      split, name: such as "train" and "train/Town01/0000".
      folder: where it is.
      columns: of the data frame, by name.
      frames: number of rows.
    """

    split: str
    name: str
    folder: pathlib.Path
    columns: dict[str, Sequence]

    @property
    def frames(self) -> int:
        return len(self.columns["reward"])

    @property
    def mean_reward(self) -> float:
        """What the authors filter by: of the rewards as recorded."""
        return float(np.sum(np.asarray(self.columns["reward"], np.float64))) / self.frames

    def numbers(self, column: str, size: int) -> np.ndarray:
        """A column whose cells are arrays of `size` numbers (or numbers, for 1), float32 [frames, size].

        Raises:
          DataError: where it is missing or a cell is of another size or not finite.
        """
        path = self.folder / FRAME_FILE
        if column not in self.columns:
            raise schema.DataError(f"{path}: column {column!r} is missing; there are {', '.join(self.columns)}.")
        cells = self.columns[column]
        try:
            values = np.array([np.reshape(cell, size) for cell in cells], np.float32).reshape(len(cells), size)
        except (TypeError, ValueError) as error:
            raise schema.DataError(f"{path}: column {column!r} does not hold {size} numbers a frame.") from error
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            raise schema.DataError(f"{path}, row {row}: {column} is not finite.")
        return values

    def path(self, kind: str, row: int) -> pathlib.Path:
        """The file of a frame.

        Raises:
          DataError: where the row names no file below the run's folder.
        """
        relative = self.columns[f"{kind}_path"][row]
        parts = pathlib.PurePosixPath(relative).parts if isinstance(relative, str) else ()
        if not parts or ".." in parts or parts[0] == "/" or "\0" in relative:
            raise schema.DataError(f"{self.folder / FRAME_FILE}, row {row}: {kind}_path is {str(relative)[:80]!r}, "
                                   f"expected a path inside the run's folder.")
        return self.folder.joinpath(*parts)


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
        every = find_runs(path)
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
        self._actions = {run.name: actions(run) for run in kept}
        self._speeds = {run.name: run.numbers("speed", 1)[:, 0] for run in kept}
        self._yaw_rates = {run.name: yaw_rates(run) for run in kept if "imu" in run.columns}
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

    def run(self, name: str) -> Run:
        """The run of a sequence, for what RawFrame does not hold."""
        return self._runs[name]

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        run, row = self._runs[sequence.name], sequence.start + index
        described = self.description
        frame: schema.RawFrame = {
            "action": self._actions[run.name][row], "speed_mps": self._speeds[run.name][row],
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


def actions(run: Run) -> np.ndarray:
    """(acceleration, steering) of every frame, float32 [frames, 2]: the throttle where it is pressed, else -brake.

    Raises:
      DataError: where the recording has no action of three numbers a frame.
    """
    throttle, steer, brake = run.numbers("action", 3).T
    return np.stack([np.where(throttle > 0, throttle, -brake), steer], axis=1)


def yaw_rates(run: Run) -> np.ndarray:
    """Of every frame, rad/s, left positive, float32 [frames]: the gyroscope's z axis; CARLA counts it to the right."""
    return -run.numbers("imu", 7)[:, 5]


def folders(path: pathlib.Path) -> list[tuple[str, pathlib.Path]]:
    """(split, folder) of every run below a root, version, mode, town or run folder; complete or not, sorted."""
    if (path / FRAME_FILE).is_file():
        return [("train", path)]
    for depth in (1, 2, 3, 4):
        pattern = "/".join("*" * depth)
        found = sorted(frame.parent for frame in path.glob(f"{pattern}/{FRAME_FILE}"))
        if not found:
            continue
        if depth == 4 and (path / VERSION_FOLDER).is_dir():
            found = [folder for folder in found if folder.is_relative_to(path / VERSION_FOLDER)]
        parents = {folder.parent for folder in found}
        beside = sorted(child for parent in parents for child in parent.iterdir() if child.is_dir())
        return [(_split(path, folder, depth), folder) for folder in beside]
    return []


def find_runs(path: pathlib.Path) -> list[Run]:
    """All runs with a data frame, good or not, in the authors' order; warns of those without.

    Raises:
      Refused: for a data frame that asks for more than data.
      DataError: where there is no run, or a data frame lacks the columns that a frame needs.
    """
    places = folders(path)
    if not places:
        raise files.missing(path / VERSION_FOLDER / "train" / "Town01" / "0000" / FRAME_FILE, "the frames of a run")
    lacking = [str(folder) for _, folder in places if not (folder / FRAME_FILE).is_file()]
    if lacking:
        warnings.warn(f"{path}: {len(lacking)} of {len(places)} runs have no {FRAME_FILE} and are left out as "
                      f"incomplete: {', '.join(lacking[:4])}.", schema.DataWarning, stacklevel=3)
    order = {split: position for position, split in enumerate(_MODES)}
    complete = sorted((place for place in places if (place[1] / FRAME_FILE).is_file()),
                      key=lambda place: (order.get(place[0], len(order)), place[0], place[1].parts))
    return [_read_run(split, folder) for split, folder in complete]


def _split(path: pathlib.Path, folder: pathlib.Path, depth: int) -> str:
    mode = folder.parents[1].name if depth >= 3 else path.resolve().name
    return mode if depth >= 3 or mode in _MODES else "train"


def _read_run(split: str, folder: pathlib.Path) -> Run:
    path = folder / FRAME_FILE
    columns = safe_pickle.load_table(path)
    lacking = [name for name in ("action", "speed", "reward") if name not in columns]
    if lacking:
        raise schema.DataError(f"{path}: column {', '.join(lacking)} is missing; there are "
                               f"{', '.join(columns) or 'none'}.")
    town = folder.resolve().parent.name
    run = Run(split, f"{split}/{town}/{folder.resolve().name}", folder, columns)
    run.numbers("reward", 1)  # checked before anything is summed
    return run


def occupancy_name(row: int) -> str:
    """Path of a frame's occupancy, relative to the run."""
    return f"{OCCUPANCY_FOLDER}/{OCCUPANCY_FOLDER}_{row:09d}.npz"


def _with_occupancy(run: Run) -> Run:
    names = [occupancy_name(row) for row in range(run.frames)]
    return dataclasses.replace(run, columns=run.columns | {f"{OCCUPANCY_FOLDER}_path": names})


def _read_occupancy(path: pathlib.Path, grid: config_lib.VoxelGrid) -> np.ndarray:
    occupancy = files.read_npz(path, "occupancy").astype(np.uint8, copy=False)
    if occupancy.shape != grid.shape:
        raise schema.DataError(f"{path}: a grid of {list(occupancy.shape)}, expected {list(grid.shape)}. Describe the "
                               f"grid in {SENSORS_FILE}, or make the occupancy again.")
    return occupancy


def _modalities(runs: list[Run], kinds: dict[str, str]) -> frozenset[str]:
    """The keys of RawFrame that at least one run has files of; where another run lacks one, its frames are left out."""
    names = {"speed_mps", "action", "reward", "is_terminal", "timestamp_s", "frame_id"}
    if all("imu" in run.columns for run in runs):
        names |= {"yaw_rate_radps", "pose"}
    names |= {key for key, kind in kinds.items()
              if any(f"{kind}_path" in run.columns and run.path(kind, 0).parent.is_dir() for run in runs)}
    if "image" in names:
        names |= {"intrinsics", "camera_to_ego"}
    return frozenset(names)


def _camera(header: dict, path: pathlib.Path, runs: list[Run]) -> schema.Camera:
    """As described, else the authors' with the size of the first image there is."""
    described = description.section(header, "camera", path / SENSORS_FILE, required=False)
    if described is not None:
        return described
    first = next(place for run in runs for row in range(run.frames) if (place := run.path("image", row)).is_file())
    height_px, width_px = files.read_image(first, "RGB").shape[:2]
    return schema.Camera(
        width_px=width_px, height_px=height_px,
        intrinsics=_rows(camera_ops.intrinsics_from_fov(width_px, height_px, FOV_RAD)),
        camera_to_ego=_rows(camera_ops.level_camera_to_ego(MOUNT_M)))


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in matrix)


def _nearest(picture: np.ndarray, side: int) -> np.ndarray:
    """The pixel in the upper left corner of each of side x side cells, as the reference resizes its route map."""
    rows, columns = (np.arange(side) * size // side for size in picture.shape)
    return np.ascontiguousarray(picture[rows[:, None], columns])


def _notes(every: list[Run], kept: list[Run], min_mean_reward: float, *, is_binary: bool) -> tuple[str, ...]:
    notes = ["MUVO layout: an action is (throttle where pressed, else -brake; steering); pedals, not accelerations."]
    if len(kept) < len(every):
        notes.append(f"MUVO layout: {len(every) - len(kept)} of {len(every)} runs are left out, their mean reward is "
                     f"below {min_mean_reward}.")
    if is_binary:
        notes.append("MUVO layout: stored voxels say what is occupied; every other voxel counts as empty, seen or not.")
    return tuple(notes)


def _cut(run: Run, modalities: frozenset[str], kinds: dict[str, str], skipped_s: float,
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
