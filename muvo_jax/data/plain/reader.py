"""The plain recording format: PNG, NPZ, CSV and TOML in folders that any tool can read (no pickle).

    ROOT/recording.toml                         what holds for all of it: sensors, voxel grid, action contract
    ROOT/<split>/<run>/frames.csv               one line a frame, written last: a run without it is incomplete; with the
                                                camera's place in the line where that is another one than the described
    ROOT/<split>/<run>/image/000012.png         RGB, 8 bit (or .jpg, .jpeg)
    ROOT/<split>/<run>/lidar/000012.npz         points_m float32 [N, 3], ego frame
    ROOT/<split>/<run>/occupancy/000012.npz     occupancy uint8 [X, Y, Z]
    ROOT/<split>/<run>/route_map/000012.png     8 bit
    ROOT/<split>/<run>/moving/000012.npz        image_moving_mask bool [H, W] and occupancy_moving_mask bool [X, Y, Z]:
                                                where road users on the move are (for scores of them)

and, read only where a head learns from them,

    ROOT/<split>/<run>/depth/000012.png         16 bit, centimetres along the optical axis, 65535 where nothing is hit
                                                (or .npz: depth_m float32 [H, W], infinite there)
    ROOT/<split>/<run>/classes/000012.png       8 bit, index into `classes` of recording.toml (left out: the town's);
                                                those named vehicle and pedestrian make image_instance_mask
    ROOT/<split>/<run>/lidar/000012.npz         also point_tags uint8 [N], the class of each point
    ROOT/<split>/<run>/birds_eye/000012.npz     birds_eye_classes uint8 and birds_eye_instances int32 [X, Y]

fields.py is the table of all this; writer.py writes it. Files may be named by the frame's number with any number of
leading zeros, and in upper case.
"""

from __future__ import annotations

import dataclasses
import pathlib
import warnings
from collections.abc import Collection
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import description, fields, files, pictures, runs, schema, sequences
from muvo_jax.data.plain import cameras, frames_table

SCHEMA_VERSION = 1
DESCRIPTION_FILE = "recording.toml"
FRAMES_FILE = frames_table.FRAMES_FILE
_DIGITS = 6
_NEEDED = frozenset(("speed_mps", "action", "timestamp_s", "frame_id"))
_TOP_LEVEL = ("schema_version", "name", "rate_hz", "splits", "classes")
_MODES = {"image": "RGB", "route_map": "L", "image_classes": "classes", "depth_m": "depth_m"}
_OF_IMAGE = frozenset(field.name for field in cameras.FIELDS)


@dataclasses.dataclass(frozen=True)
class Run:
    """A complete run: its split, its folder and the columns of its frames.csv (name -> [F])."""

    split: str
    folder: pathlib.Path
    columns: dict[str, np.ndarray]

    @property
    def name(self) -> str:
        return f"{self.split}/{self.folder.name}"


@dataclasses.dataclass(frozen=True)
class _Files:
    """The files of one field of a run.

    Attributes:
      present: bool [F], which frames have one.
      unusual: frame number -> name, of those that are not named as the writer would.
    """

    present: np.ndarray
    unusual: dict[int, str]


class PlainRecording:
    """A folder in the plain format."""

    def __init__(self, path: pathlib.Path | str, *, labels: frozenset[str] = frozenset()):
        """Reads the description and every frames.csv, and looks which files exist; frames are read by `read`.

        Args:
          labels: which of schema.LABELS the frames should have, where they are recorded.

        Raises:
          DataError: for a description of another version or with wrong fields or numbers, no complete run, or a
            malformed frames.csv.
        """
        root = pathlib.Path(path).expanduser()
        toml_path = root / DESCRIPTION_FILE
        header = read_header(root)
        splits = description.splits(header, toml_path)
        every = read_runs(root, splits)
        rate_hz = description.rate_hz(header, toml_path)
        self._class_names = _class_names(header, toml_path)
        self.stated_classes = self._class_names if "classes" in header else ()
        self._wanted = [field for field in fields.TABLE
                        if field.folder and (not field.is_label or field.name in labels)]
        for run in every:
            _check_case(run)
        self._files = {run.name: _files_of(run, self._wanted) for run in every}
        self._runs = {run.name: run for run in every}
        self._has_terminals = any("is_terminal" in run.columns for run in every)
        modalities, lacks = runs.shared([runs.Run(run.name, run.split, len(run.columns["frame_id"]),
                                                  self._fields_of(run)) for run in every], str(root))
        self.sequences = tuple(sequence for run in every
                               for sequence in self._cut(run, modalities, lacks[run.name], 1.0 / rate_hz))
        contract = description.contract(header, toml_path, rate_hz)
        if contract is None:
            raise schema.DataError(f"{toml_path}: section [action] is missing; it says what actions mean.")
        section = lambda name, needed: description.section(header, name, toml_path, required=needed)
        in_voxels = any("X" in fields.FIELDS[name].shape for name in modalities)
        voxels = section("voxels", True) if in_voxels else None  # [voxels] alone says what to make
        self.description = schema.RecordingDescription(
            name=str(description.field(header, "name", str, toml_path)), kind="plain", rate_hz=rate_hz,
            camera=section("camera", "image" in modalities), lidar=section("lidar", "points_m" in modalities),
            voxels=voxels, contract=contract, splits=splits,
            modalities=modalities | (_OF_IMAGE if "image" in modalities else frozenset()),
            classes=self._class_names if labels & {"image_classes", "point_classes"} else (),
            route_map=(section("route_map", False) or config_lib.RouteMap()) if "route_map" in modalities else None)
        for run in every:
            if self.description.camera is not None:
                cameras.check(run.columns, self.description.camera, run.folder / FRAMES_FILE)
            if "occupancy" in modalities and voxels is not None:
                description.check_rule(run.folder / fields.FIELDS["occupancy"].folder, voxels)

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        return self.read_fields(sequence, index, fields.FIELDS)

    def read_fields(self, sequence: schema.Sequence, index: int, names: Collection[str]) -> schema.RawFrame:
        """See schema.ReadsFields; what stands in frames.csv is always there."""
        run, position = self._runs[sequence.name], sequence.start + index
        frame: dict[str, Any] = {name: self._of_table(run, name, position) for name in fields.FIELDS
                                 if self._has(sequence, name) and fields.FIELDS[name].columns and name not in _OF_IMAGE}
        for name in fields.FIELDS:
            if name in names and self._has(sequence, name) and fields.FIELDS[name].folder:
                frame |= self._of_file(run, name, position, frame)
        if "points_m" in frame:
            frame["points_m"] = files.finite_points(frame["points_m"], self.path(sequence, index, "points_m"))
        camera = self.description.camera
        if "image" in frame and camera is not None:
            frame |= cameras.of_frame(run.columns, position, camera)
        return frame  # type: ignore[return-value]

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        return self._of_table(self._runs[sequence.name], "action", sequence.start + index)

    def words(self, sequence: schema.Sequence, column: str) -> list[str]:
        """A column of text of frames.csv, such as weather, for the frames of a sequence; empty where there is none."""
        run = self._runs[sequence.name]
        found = frames_table.words(run.folder / FRAMES_FILE, column)
        return found[sequence.start:sequence.start + sequence.length]

    def path(self, sequence: schema.Sequence, index: int, name: str) -> pathlib.Path:
        """The file that a field of a frame is read from; where there is none, as the writer would name it."""
        run = self._runs[sequence.name]
        return self._path(run, name, int(run.columns["frame_id"][sequence.start + index]))

    def _has(self, sequence: schema.Sequence, name: str) -> bool:
        return name in self.description.modalities and sequence.has((name,))

    def _of_table(self, run: Run, name: str, position: int) -> Any:
        field = fields.FIELDS[name]
        if name == "is_terminal" and name not in run.columns:
            return np.bool_(False)
        return field.of_cells([run.columns[column][position] for column in field.columns])

    def _of_file(self, run: Run, name: str, position: int, frame: dict[str, Any]) -> dict[str, Any]:
        """The field of a frame, and what comes with it; of points those that are not finite, too."""
        path = self._path(run, name, int(run.columns["frame_id"][position]))
        if name == "image_instance_mask":
            classes = frame["image_classes"] if "image_classes" in frame else self._read(path, "image_classes")
            return {"image_classes": classes, name: schema.instance_mask(classes, self._class_names)}
        values = self._read(path, name)
        if name == "point_classes":
            points_m = frame["points_m"] if "points_m" in frame else self._read(path, "points_m")
            if len(values) != len(points_m):
                raise schema.DataError(f"{path}: {len(values)} {fields.FIELDS[name].array} of {len(points_m)} points. "
                                       f"Write a class for each point, in the order of the points.")
            values = values[np.isfinite(points_m).all(axis=1)]  # finite_points leaves the others out
        return {name: values}

    def _read(self, path: pathlib.Path, name: str) -> np.ndarray:
        field = fields.FIELDS[name]
        if path.suffix.lower() == ".npz":
            values = files.read_npz(path, field.array)
        else:
            values = pictures.read(path, _MODES[name])
        values = fields.conform(name, values, str(path), self.description.shape_of(name))
        if name in ("image_classes", "point_classes"):
            fields.check_classes(name, values, self._class_names, str(path))
        return values

    def _path(self, run: Run, name: str, frame_id: int) -> pathlib.Path:
        field = fields.FIELDS[name]
        return _file(run, field, frame_id, self._files[run.name][field.folder].unusual)

    def _fields_of(self, run: Run) -> frozenset[str]:
        """The fields that a run has, in its table and in its folders."""
        found = {name for name, field in fields.FIELDS.items()
                 if field.columns and all(column in run.columns for column in field.columns)}
        found -= _OF_IMAGE  # a run without such columns has the description's
        if self._has_terminals:  # a run without the column never ends in one
            found.add("is_terminal")
        here = self._files[run.name]
        found |= {field.name for field in self._wanted if runs.has_files(here[field.folder].present)}
        for folder in {fields.FIELDS[name].folder for name in found} - {""}:
            found -= self._not_in_file(run, [fields.FIELDS[name] for name in found
                                             if fields.FIELDS[name].folder == folder and fields.FIELDS[name].array])
        if not set(schema.INSTANCE_CLASSES) & set(self._class_names):
            found.discard("image_instance_mask")
        return frozenset(found)

    def _not_in_file(self, run: Run, together: list[fields.Field]) -> set[str]:
        """Of fields that share a file those that the run's files do not hold; where they hold none: nothing.

        The first, the last and one in between are asked: a single file that is damaged says nothing of the others.
        """
        if len(together) < 2:
            return set()
        there = np.flatnonzero(self._files[run.name][together[0].folder].present)
        frame_ids = run.columns["frame_id"][there[[0, len(there) // 2, -1]]].tolist()
        held = [files.npz_names(self._path(run, together[0].name, frame_id)) for frame_id in frame_ids]
        known = frozenset().union(*(names for names in held if names is not None))
        missing = {field.name for field in together if not field.is_sensor and field.array not in known}
        return missing if len(missing) < len(together) else set()

    def _cut(self, run: Run, modalities: frozenset[str], lacks: tuple[str, ...],
             period_s: float) -> list[schema.Sequence]:
        """The gap-free sequences of a run (a terminal frame ends one); warns of gaps."""
        present = np.ones(len(run.columns["frame_id"]), bool)
        absent = {}
        for folder in sorted({fields.FIELDS[name].folder for name in modalities.difference(lacks)} - {""}):
            there = self._files[run.name][folder].present
            present &= there
            absent[folder] = int((~there).sum())
        sequences.warn_of_rate(str(run.folder), run.columns["timestamp_s"], period_s)
        late = sequences.after_gap(run.columns["timestamp_s"], period_s)
        restarts = np.zeros(len(present), bool)
        if "is_terminal" in run.columns:
            restarts[1:] = run.columns["is_terminal"][:-1] > 0
        pieces = sequences.gap_free(present, late | restarts)
        sequences.warn_of_gaps(str(run.folder), present, absent, late & ~restarts, len(pieces))
        return [schema.Sequence(run.split, run.name, start, length, lacks) for start, length in pieces]


def read_header(root: pathlib.Path) -> dict:
    """Returns recording.toml; raises DataError where it is missing, malformed or of another version."""
    path = root / DESCRIPTION_FILE
    header = files.read_toml(path)
    if header.get("schema_version") != SCHEMA_VERSION:
        raise schema.DataError(f"{path}: schema_version is {header.get('schema_version')!r}, this reader "
                               f"knows {SCHEMA_VERSION}. Record it again, or use the muvo_jax that wrote it.")
    description.check_names(header, path, _TOP_LEVEL)
    return header


def read_runs(root: pathlib.Path, splits: tuple[str, ...]) -> list[Run]:
    """The complete runs of these splits, whatever files of theirs are there; incomplete ones are warned of.

    Raises:
      DataError: where there is none, or a frames.csv is malformed.
    """
    found = [run for split in splits for run in _runs_of(root, split)]
    if not found:
        raise schema.DataError(f"{root}: no complete run (a folder <split>/<run> with {FRAMES_FILE}) in the splits "
                               f"{', '.join(splits)}. The root holds {files.listing(root)}. Record it again.")
    # A split linked to another one would be judged on what was trained.
    if twice := sequences.named_twice((run.folder.resolve(), run.name) for run in found):
        folder, one, other = twice
        raise schema.DataError(f"{root}: {one} and {other} are one folder, {folder}. Remove one of the links.")
    return found


def _runs_of(root: pathlib.Path, split: str) -> list[Run]:
    """The complete runs of a split, in the order of their names; incomplete ones are left out with a warning."""
    near = [path for path in root.iterdir() if path.name != split and path.name.lower() == split.lower()]
    if near and not (root / split).is_dir():
        raise schema.DataError(f"{near[0]}: expected the name {split}, as {DESCRIPTION_FILE} says. Rename the folder.")
    folders = sorted(path for path in (root / split).glob("*") if path.is_dir() and not path.name.startswith("."))
    for folder in folders:
        if any("\ud800" <= letter <= "\udfff" for letter in folder.name):  # Python's for bytes that are no UTF-8
            raise schema.DataError(f"{folder.parent}: a run is named {folder.name!r}, which is no UTF-8. Rename the "
                                   f"folder.")
    read = [Run(split, folder, frames_table.read(folder / FRAMES_FILE)) for folder in folders
            if (folder / FRAMES_FILE).is_file()]
    found = [run for run in read if len(run.columns["frame_id"])]
    complete = {run.folder for run in found}
    incomplete = [folder.name for folder in folders if folder not in complete]
    if incomplete:
        warnings.warn(f"{root / split}: {len(incomplete)} of {len(folders)} runs have no {FRAMES_FILE}, or no row in "
                      f"it, are left out as incomplete: {', '.join(incomplete[:6])}.", schema.DataWarning, stacklevel=4)
    return found


def frame_files(run: Run, name: str) -> list[pathlib.Path]:
    """The file of a field in each frame of a run, as it is named there or, where it is missing, as a writer would."""
    field = fields.FIELDS[name]
    unusual = _files_of(run, [field])[field.folder].unusual
    return [_file(run, field, frame_id, unusual) for frame_id in run.columns["frame_id"].tolist()]


def _file(run: Run, field: fields.Field, frame_id: int, unusual: dict[int, str]) -> pathlib.Path:
    return run.folder / field.folder / unusual.get(frame_id, f"{frame_id:0{_DIGITS}d}{field.suffixes[0]}")


def _check_case(run: Run) -> None:
    """Raises DataError for a folder that would be one of the format's in lower case: its files would not be read."""
    known = {field.folder for field in fields.TABLE if field.folder}
    names = {path.name for path in run.folder.iterdir()}
    for name in sorted(names - known):
        if name.lower() in known and name.lower() not in names:
            raise schema.DataError(f"{run.folder / name}: expected the name {name.lower()}. Rename the folder.")


def _files_of(run: Run, wanted: list[fields.Field]) -> dict[str, _Files]:
    """The files of a run by folder. Fields that share one have the same suffixes."""
    found, beyond = {}, {}
    frame_ids = run.columns["frame_id"].tolist()
    last = max(frame_ids)  # a counter that wraps ends elsewhere
    for field in wanted:
        if field.folder in found:
            continue
        names = files.numbered(run.folder / field.folder, field.suffixes)
        beyond[field.folder] = sum(number > last for number in names)
        usual = f"{{:0{_DIGITS}d}}{field.suffixes[0]}"
        found[field.folder] = _Files(np.array([frame_id in names for frame_id in frame_ids], bool), {
            frame_id: names[frame_id] for frame_id in frame_ids
            if frame_id in names and names[frame_id] != usual.format(frame_id)})
    _check_rows(run, {folder: count for folder, count in beyond.items() if count})
    return found


def _check_rows(run: Run, beyond: dict[str, int]) -> None:
    """Warns of files (folder -> how many) that come after the last row of frames.csv, the table that is written last.

    Raises:
      DataError: where that row is cut off, too: what it says cannot be trusted.
    """
    if not beyond:
        return
    path, counts = run.folder / FRAMES_FILE, ", ".join(f"{count} in {folder}" for folder, count in beyond.items())
    if not frames_table.ends_with_a_line(path):
        raise schema.DataError(f"{path}: its last row does not end, and files come after it ({counts}): the table was "
                               f"copied in part. Copy it again.")
    warnings.warn(f"{path}: files that come after its last row are left out ({counts}). Was all of it copied?",
                  schema.DataWarning, stacklevel=4)


def _class_names(header: dict, path: pathlib.Path) -> tuple[str, ...]:
    """The names of the classes, those of the town where the recording does not say."""
    if "classes" not in header:
        return fields.TOWN_CLASSES
    found = description.names(header, "classes", path)
    if len(found) > fields.UNKNOWN:
        raise schema.DataError(f"{path}: classes names {len(found)}; a pixel has one of at most {fields.UNKNOWN} "
                               f"({fields.UNKNOWN} is unknown). Put some together.")
    return found
