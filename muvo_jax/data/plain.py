"""The plain recording format: PNG, NPZ, CSV and TOML in folders that any tool can read (no pickle).

    ROOT/recording.toml                         what holds for all of it: sensors, voxel grid, action contract
    ROOT/<split>/<run>/frames.csv               one line a frame, written last: a run without it is incomplete
    ROOT/<split>/<run>/image/000012.png         RGB, 8 bit (or .jpg, .jpeg)
    ROOT/<split>/<run>/lidar/000012.npz         points_m float32 [N, 3], ego frame
    ROOT/<split>/<run>/occupancy/000012.npz     occupancy uint8 [X, Y, Z]
    ROOT/<split>/<run>/route_map/000012.png     8 bit
    ROOT/<split>/<run>/moving/000012.npz        image_moving_mask bool [H, W] and occupancy_moving_mask bool [X, Y, Z]:
                                                where road users on the move are (for scores of them)

and, read only where a head learns from them,

    ROOT/<split>/<run>/depth/000012.png         16 bit, centimetres along the optical axis, 65535 where nothing is hit
    ROOT/<split>/<run>/classes/000012.png       8 bit, index into `classes` of recording.toml (left out: the town's);
                                                those named vehicle and pedestrian make image_instance_mask
    ROOT/<split>/<run>/lidar/000012.npz         also point_tags uint8 [N], the class of each point
    ROOT/<split>/<run>/birds_eye/000012.npz     birds_eye_classes uint8 and birds_eye_instances int32 [X, Y]

recorder.py writes it.
"""

from __future__ import annotations

import csv
import dataclasses
import pathlib
import warnings

import numpy as np

from muvo_jax.data import description, files, schema
from muvo_jax.data.town import boxes

SCHEMA_VERSION = 1
DESCRIPTION_FILE = "recording.toml"
FRAMES_FILE = "frames.csv"
# RawFrame key -> (folder, suffixes) of the modalities that are files.
_FILES = {"image": ("image", (".png", ".jpg", ".jpeg")), "points_m": ("lidar", (".npz",)),
          "occupancy": ("occupancy", (".npz",)), "route_map": ("route_map", (".png",)),
          "image_moving_mask": ("moving", (".npz",)), "occupancy_moving_mask": ("moving", (".npz",))}
_LABEL_FILES = {"depth_m": ("depth", (".png",)), "image_classes": ("classes", (".png",)),
                "image_instance_mask": ("classes", (".png",)),
                "birds_eye_classes": ("birds_eye", (".npz",)), "birds_eye_instances": ("birds_eye", (".npz",))}
DEPTH_UNIT_M = 0.01
DEPTH_SKY = 65535
_COLUMNS = ("frame_id", "timestamp_s", "speed_mps", "acceleration", "steering")
_OPTIONAL_COLUMNS = ("reward", "is_terminal", "x_m", "y_m", "yaw_rad")
_POSE = ("x_m", "y_m", "yaw_rad")


@dataclasses.dataclass(frozen=True)
class Run:
    """A complete run: its split, its folder and the columns of its frames.csv (name -> [F])."""

    split: str
    folder: pathlib.Path
    columns: dict[str, np.ndarray]


class PlainRecording:
    """A folder in the plain format."""

    def __init__(self, path: pathlib.Path | str, *, labels: frozenset[str] = frozenset()):
        """Reads the description and every frames.csv, and looks which files exist; frames are read by `read`.

        Args:
          labels: which of schema.LABELS the frames should have, where they are recorded.

        Raises:
          DataError: for a description of another version or with wrong fields, no complete run, or a malformed
            frames.csv.
        """
        root = pathlib.Path(path)
        toml_path = root / DESCRIPTION_FILE
        header = read_header(root)
        splits = tuple(description.field(header, "splits", list, toml_path))
        runs = read_runs(root, splits)
        rate_hz = description.rate_hz(header, toml_path)
        self._files = _FILES | {key: place for key, place in _LABEL_FILES.items() if key in labels}
        modalities = _modalities(runs, self._files)
        self._class_names = _class_names(header, toml_path) if labels else ()
        if not set(schema.INSTANCE_CLASSES) & set(self._class_names):
            modalities -= {"image_instance_mask"}
        if "point_classes" in labels and _has_point_tags(runs):
            modalities |= {"point_classes"}
        self._runs = {f"{run.split}/{run.folder.name}": run for run in runs}
        self.sequences = tuple(sequence for name, run in self._runs.items()
                               for sequence in _cut(run, name, modalities, self._files, 1.0 / rate_hz))
        lidar = description.section(header, "lidar", toml_path, required="points_m" in modalities)
        voxels = None
        if "occupancy" in modalities or "birds_eye_classes" in modalities:  # [voxels] alone says what to make
            voxels = description.section(header, "voxels", toml_path, required=True)
        contract = description.section(header, "action", toml_path, required=True)
        camera = description.section(header, "camera", toml_path, required="image" in modalities)
        self.description = schema.RecordingDescription(
            name=str(description.field(header, "name", str, toml_path)), kind="plain", rate_hz=rate_hz, camera=camera,
            lidar=lidar, voxels=voxels, contract=contract, modalities=modalities, splits=splits,
            classes=self._class_names if labels & {"image_classes", "point_classes"} else ())

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        run = self._runs[sequence.name]
        position = sequence.start + index
        columns, described = run.columns, self.description
        frame_id = int(columns["frame_id"][position])
        frame: schema.RawFrame = {
            "speed_mps": np.float32(columns["speed_mps"][position]),
            "action": self.action(sequence, index),
            "timestamp_s": np.float64(columns["timestamp_s"][position]),
            "frame_id": np.int64(frame_id),
        }
        if "pose" in described.modalities:
            frame["pose"] = np.array([columns[name][position] for name in _POSE])
        if "yaw_rate_radps" in described.modalities:
            frame["yaw_rate_radps"] = np.float32(columns["yaw_rate_radps"][position])
        if "reward" in described.modalities:
            frame["reward"] = np.float32(columns["reward"][position])
        if "is_terminal" in described.modalities:
            frame["is_terminal"] = np.bool_(columns["is_terminal"][position])
        paths = {key: _path(run.folder / folder, frame_id, suffixes)
                 for key, (folder, suffixes) in self._files.items() if key in described.modalities}
        if described.camera is not None and "image" in paths:
            camera = described.camera
            frame["image"] = files.read_image(paths["image"], "RGB")
            _check_shape(frame["image"], (camera.height_px, camera.width_px, 3), paths["image"])
            frame["intrinsics"] = np.asarray(camera.intrinsics, np.float32)
            frame["camera_to_ego"] = np.asarray(camera.camera_to_ego, np.float32)
        if "points_m" in paths:
            points_m = files.read_npz(paths["points_m"], "points_m")
            _check_shape(points_m, (len(points_m), 3), paths["points_m"])
            frame["points_m"] = files.finite_points(points_m.astype(np.float32, copy=False), paths["points_m"])
        if described.voxels is not None and "occupancy" in paths:
            frame["occupancy"] = files.read_npz(paths["occupancy"], "occupancy").astype(np.uint8, copy=False)
            _check_shape(frame["occupancy"], described.voxels.shape, paths["occupancy"])
        if "route_map" in paths:
            frame["route_map"] = files.read_image(paths["route_map"], "L")
            _check_shape(frame["route_map"], (64, 64), paths["route_map"])
        self._read_moving(frame, paths)
        self._read_labels(frame, paths)
        return frame

    def _read_moving(self, frame: schema.RawFrame, paths: dict[str, pathlib.Path]) -> None:
        described = self.description
        if "image_moving_mask" in paths and described.camera is not None:
            place, size = paths["image_moving_mask"], (described.camera.height_px, described.camera.width_px)
            frame["image_moving_mask"] = files.read_npz(place, "image_moving_mask").astype(bool, copy=False)
            _check_shape(frame["image_moving_mask"], size, place)
        if "occupancy_moving_mask" in paths and described.voxels is not None:
            place = paths["occupancy_moving_mask"]
            frame["occupancy_moving_mask"] = files.read_npz(place, "occupancy_moving_mask").astype(bool, copy=False)
            _check_shape(frame["occupancy_moving_mask"], described.voxels.shape, place)

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        columns = self._runs[sequence.name].columns
        return np.array([columns[name][sequence.start + index] for name in ("acceleration", "steering")], np.float32)

    def _read_labels(self, frame: schema.RawFrame, paths: dict[str, pathlib.Path]) -> None:
        """Adds what was asked for of schema.LABELS."""
        described = self.description
        if described.camera is not None:
            size = (described.camera.height_px, described.camera.width_px)
            if "depth_m" in paths:
                frame["depth_m"] = decode_depth(files.read_image(paths["depth_m"], None))
                _check_shape(frame["depth_m"], size, paths["depth_m"])
            place = paths.get("image_classes", paths.get("image_instance_mask"))
            if place is not None:
                classes = files.read_image(place, "L")
                _check_shape(classes, size, place)
                frame["image_classes"] = classes
                frame["image_instance_mask"] = schema.instance_mask(classes, self._class_names)
        if "point_classes" in described.modalities:
            frame["point_classes"] = files.read_npz(paths["points_m"], "point_tags").astype(np.uint8, copy=False)
            _check_shape(frame["point_classes"], frame["points_m"].shape[:1], paths["points_m"])
        if "birds_eye_classes" in paths and described.voxels is not None:
            place, ground = paths["birds_eye_classes"], described.voxels.shape[:2]
            frame["birds_eye_classes"] = files.read_npz(place, "birds_eye_classes").astype(np.uint8, copy=False)
            frame["birds_eye_instances"] = files.read_npz(place, "birds_eye_instances").astype(np.int32, copy=False)
            _check_shape(frame["birds_eye_classes"], ground, place)
            _check_shape(frame["birds_eye_instances"], ground, place)


def decode_depth(pixels: np.ndarray) -> np.ndarray:
    """Centimetres (16 bit) to float32 metres, infinite in the sky; the inverse of recorder.encode_depth."""
    return np.where(pixels == DEPTH_SKY, np.float32(np.inf), pixels.astype(np.float32) * np.float32(DEPTH_UNIT_M))


def _class_names(header: dict, path: pathlib.Path) -> tuple[str, ...]:
    """The names of the classes, those of the town where the recording does not say."""
    if "classes" not in header:
        return boxes.CLASSES
    return tuple(map(str, description.field(header, "classes", list, path)))


def _has_point_tags(runs: list[Run]) -> bool:
    """Whether the scans say what each point hit, judged by the first of each run."""
    first = [next(iter(sorted((run.folder / _FILES["points_m"][0]).glob("*.npz"))), None) for run in runs]
    return all(place is not None and files.npz_holds(place, "point_tags") for place in first)


def _path(folder: pathlib.Path, frame_id: int, suffixes: tuple[str, ...]) -> pathlib.Path:
    """The file of a frame with the first suffix that there is, else with the first."""
    places = [folder / f"{frame_id:06d}{suffix}" for suffix in suffixes]
    return next((place for place in places if place.is_file()), places[0])


def _check_shape(array: np.ndarray, expected: tuple[int, ...], path: pathlib.Path) -> None:
    if array.shape != expected:
        raise schema.DataError(f"{path}: shape {list(array.shape)}, but {DESCRIPTION_FILE} says {list(expected)}. Do "
                               f"not mix recordings of different settings in one folder.")


def read_header(root: pathlib.Path) -> dict:
    """Returns recording.toml; raises DataError where it is missing, malformed or of another version."""
    path = root / DESCRIPTION_FILE
    header = files.read_toml(path)
    if header.get("schema_version") != SCHEMA_VERSION:
        raise schema.DataError(f"{path}: schema_version is {header.get('schema_version')!r}, this reader "
                               f"knows {SCHEMA_VERSION}. Record it again, or use the muvo_jax that wrote it.")
    return header


def read_runs(root: pathlib.Path, splits: tuple[str, ...]) -> list[Run]:
    """The complete runs of these splits, whatever files of theirs are there; incomplete ones are warned of.

    Raises:
      DataError: where there is none, or a frames.csv is malformed.
    """
    runs = [run for split in splits for run in _runs_of(root, split)]
    if not runs:
        raise schema.DataError(f"{root}: no complete run (a folder <split>/<run> with {FRAMES_FILE}) in the splits "
                               f"{', '.join(splits)}. The root holds {files.listing(root)}. Record it again.")
    return runs


def _runs_of(root: pathlib.Path, split: str) -> list[Run]:
    """The complete runs of a split, in the order of their names; incomplete ones are left out with a warning."""
    folders = sorted(path for path in (root / split).glob("*") if path.is_dir())
    incomplete = [folder.name for folder in folders if not (folder / FRAMES_FILE).is_file()]
    if incomplete:
        warnings.warn(f"{root / split}: {len(incomplete)} of {len(folders)} runs have no {FRAMES_FILE}, are left out "
                      f"as incomplete: {', '.join(incomplete[:6])}.", schema.DataWarning, stacklevel=4)
    return [Run(split, folder, _read_table(folder / FRAMES_FILE)) for folder in folders
            if (folder / FRAMES_FILE).is_file()]


def _read_table(path: pathlib.Path) -> dict[str, np.ndarray]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            header = reader.fieldnames or ()
    except (UnicodeDecodeError, csv.Error) as error:
        raise schema.DataError(f"{path}: not a CSV table ({error}). Record the run again.") from error
    lacking = [name for name in _COLUMNS if name not in header]
    if lacking:
        raise schema.DataError(f"{path}: column {', '.join(lacking)} is missing; the header has "
                               f"{', '.join(header) or 'none'}. Record the run again.")
    optional = tuple(name for name in _OPTIONAL_COLUMNS if name in header and rows and rows[0][name])
    columns = {name: np.array([_number(path, line, name, row[name]) for line, row in enumerate(rows, start=2)])
               for name in _COLUMNS + optional}
    files.check_increasing(columns["timestamp_s"], [f"{path}, line {line + 2}" for line in range(len(rows))])
    if "yaw_rad" in columns and len(rows) > 1:
        columns["yaw_rate_radps"] = _rates(columns["yaw_rad"], columns["timestamp_s"])
    return columns


def _rates(yaw_rad: np.ndarray, timestamps_s: np.ndarray) -> np.ndarray:
    """Turning between a frame and the next (the last frame: as the one before), rad/s."""
    turned_rad = (np.diff(yaw_rad) + np.pi) % (2 * np.pi) - np.pi
    return np.append(turned_rad, turned_rad[-1:]) / np.append(np.diff(timestamps_s), np.diff(timestamps_s)[-1:])


def _number(path: pathlib.Path, line: int, name: str, text: str | None) -> float:
    words = {"true": 1.0, "false": 0.0}
    try:
        value = words.get((text or "").lower())
        value = float(text or "") if value is None else value
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise schema.DataError(f"{path}, line {line}: {name} is {text!r}, expected a finite number.")
    return value


def _modalities(runs: list[Run], kinds: dict[str, tuple[str, tuple[str, ...]]]) -> frozenset[str]:
    """The keys of RawFrame that at least one run has; where another run lacks one, its frames are left out."""
    names = {"speed_mps", "action", "timestamp_s", "frame_id"}
    names |= {key for key, (folder, _) in kinds.items() if any((run.folder / folder).is_dir() for run in runs)}
    names |= {name for name in ("reward", "is_terminal", "yaw_rate_radps")
              if all(name in run.columns for run in runs)}
    if all(run.columns.keys() >= set(_POSE) for run in runs):
        names.add("pose")
    if "image" in names:
        names |= {"intrinsics", "camera_to_ego"}
    return frozenset(names)


def _cut(run: Run, name: str, modalities: frozenset[str], kinds: dict[str, tuple[str, tuple[str, ...]]],
         period_s: float) -> list[schema.Sequence]:
    """The gap-free sequences of a run (a terminal frame ends one); warns of gaps."""
    frame_ids = run.columns["frame_id"].astype(np.int64).tolist()
    absent = {}
    present = np.ones(len(frame_ids), bool)
    for key, (folder, suffixes) in kinds.items():
        if key in modalities:
            have = set().union(*(files.numbered(run.folder / folder, suffix) for suffix in suffixes))
            there = np.array([frame_id in have for frame_id in frame_ids], bool)
            present &= there
            absent[folder] = int((~there).sum())
    late = files.after_gap(run.columns["timestamp_s"], period_s)
    restarts = np.zeros(len(frame_ids), bool)
    if "is_terminal" in modalities:
        restarts[1:] = run.columns["is_terminal"][:-1] > 0
    pieces = files.gap_free(present, late | restarts)
    files.warn_of_gaps(str(run.folder), present, absent, late & ~restarts, len(pieces))
    return [schema.Sequence(split=run.split, name=name, start=start, length=length) for start, length in pieces]
