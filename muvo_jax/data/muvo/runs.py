"""The runs of a folder in the MUVO / MILE CARLA layout (reader.py), and the table of frames that each of them has."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import re
import warnings
from collections.abc import Sequence

import numpy as np

from muvo_jax.data import files, schema
from muvo_jax.data.muvo import safe_pickle

FRAME_FILE = "pd_dataframe.pkl"
VERSION_FOLDER = "trainval"
_NUMBER = re.compile(r"(\d{1,18})$")
_PICTURES = (".png", ".jpg", ".jpeg")
_MODES = ("train", "val0", "val1", "val2")


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
        # Tables that were written on Windows have its separators.
        parts = pathlib.PurePosixPath(relative.replace("\\", "/")).parts if isinstance(relative, str) else ()
        if not parts or ".." in parts or parts[0] == "/" or "\0" in relative:
            raise schema.DataError(f"{self.folder / FRAME_FILE}, row {row}: {kind}_path is {str(relative)[:80]!r}, "
                                   f"expected a path inside the run's folder.")
        return self.folder.joinpath(*parts)


@dataclasses.dataclass(frozen=True)
class KindFiles:
    """The files of one kind of a run.

    Attributes:
      present: bool [F], which rows have one.
      unusual: row -> the file, where it is not the one that the table names: another suffix or other case.
    """

    present: np.ndarray
    unusual: dict[int, pathlib.Path]


def find_files(run: Run, kind: str) -> KindFiles:
    """Which files of a kind there are, whatever the case of their suffixes; images may have become JPEG.

    Raises:
      DataError: where files are there, but none that the table names.
    """
    present = np.zeros(run.frames, bool)
    unusual: dict[int, pathlib.Path] = {}
    if f"{kind}_path" not in run.columns:
        return KindFiles(present, unusual)
    paths = [run.path(kind, row) for row in range(run.frames)]
    listed = {folder: _by_stem(folder) for folder in {path.parent for path in paths}}
    for row, path in enumerate(paths):
        names = listed[path.parent].get(path.stem, {})
        suffixes = (path.suffix, *_PICTURES) if path.suffix.lower() in _PICTURES and kind == "image" else (path.suffix,)
        found = next((names[suffix.lower()] for suffix in suffixes if suffix.lower() in names), None)
        present[row] = found is not None
        if found is not None and found != path.name:
            unusual[row] = path.with_name(found)
    if paths and not present.any() and any(listed.values()):
        folder = paths[0].parent
        raise schema.DataError(f"{folder}: holds {files.listing(folder)}, but {FRAME_FILE} names {paths[0].name} and "
                               f"its like. Rename the files as the table names them, or take the folder away.")
    return KindFiles(present, unusual)


def _by_stem(folder: pathlib.Path) -> dict[str, dict[str, str]]:
    """stem -> suffix in lower case -> name, of the files of a folder; empty where there is none."""
    found: dict[str, dict[str, str]] = {}
    if folder.is_dir():
        for name in sorted(os.listdir(folder)):
            if not name.startswith("."):
                stem, suffix = os.path.splitext(name)
                found.setdefault(stem, {}).setdefault(suffix.lower(), name)
    return found


def numbering(run: Run) -> np.ndarray:
    """The number of each frame, int64 [F], by the name of its first file; the row where names have no number.

    Raises:
      DataError: where they do not increase: rows were sorted otherwise than they were recorded.
    """
    columns = [column.removesuffix("_path") for column in run.columns if column.endswith("_path")]
    for kind in columns:
        found = [_NUMBER.search(run.path(kind, row).stem) for row in range(run.frames)]
        if all(found):
            numbers = np.array([int(match[1]) for match in found if match], np.int64)
            wrong = np.flatnonzero(np.diff(numbers) <= 0)
            if wrong.size:
                row = int(wrong[0]) + 1
                raise schema.DataError(f"{run.folder / FRAME_FILE}, row {row}: frame {numbers[row]} comes after frame "
                                       f"{numbers[row - 1]}; rows must be in the order of their recording. Sort the "
                                       f"table.")
            return numbers
    return np.arange(run.frames)


def root_levels(path: pathlib.Path) -> int:
    """How many folders above `path` (a root, version, mode, town or run folder) the recording's root may be."""
    depth = next((depth for depth in range(5) if any(path.glob("/".join(["*"] * depth + [FRAME_FILE])))), 4)
    above = [path.resolve(), *path.resolve().parents][:5 - depth]
    version = next((level for level, folder in enumerate(above) if folder.name == VERSION_FOLDER), None)
    return max(3 - depth, 0) if version is None else version + 1


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
