"""The runs of a folder in the MUVO / MILE CARLA layout (reader.py), and the table of frames that each of them has."""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
import re
import warnings
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from muvo_jax.data import files, schema
from muvo_jax.data.muvo import safe_pickle
from muvo_jax.limits import between

FRAME_FILE = "pd_dataframe.pkl"
VERSION_FOLDER = "trainval"
MOST_LEVELS = 4  # from a run's folder up to the recording's root
_NUMBER = re.compile(r"(\d{1,18})$")
_NUMBERED = re.compile(r"(.*?)(\d{1,18})((?:\.[a-zA-Z]+)?)", re.DOTALL)
_PICTURES = (".png", ".jpg", ".jpeg")
_MODES = ("train", "val0", "val1", "val2")
# Columns that are kept beside the paths of files; a table has three times as many, most of it the expert's features.
_KEPT = ("action", "speed", "reward", "imu", "value", "n_classes")
_PEDAL = between(-0.001, 1.001)  # a little beyond 0 and 1 is rounding


class NumberedNames(Sequence[str]):
    """Names that differ in a number only, such as a path for each frame: a tenth of what the texts take."""

    def __init__(self, prefix: str, numbers: np.ndarray, digits: int, suffix: str):
        """Args:
          numbers: int64 [N], written with that many digits or more between prefix and suffix.
        """
        self.numbers = numbers
        self._prefix, self._digits, self._suffix = prefix, digits, suffix

    @classmethod
    def of(cls, names: Sequence[str]) -> NumberedNames | None:
        """The same names; None where they are of another form."""
        first = names[0] if len(names) and isinstance(names[0], str) else ""
        match = _NUMBERED.fullmatch(first)
        if match is None:
            return None
        prefix, digits, suffix = match.groups()
        if not all(isinstance(name, str) and len(name) == len(first) and name.startswith(prefix)
                   and name.endswith(suffix) for name in names):
            return None
        middles = [name[len(prefix):len(first) - len(suffix)] for name in names]
        if not all(middle.isascii() and middle.isdigit() for middle in middles):
            return None
        return cls(prefix, np.array(middles, np.int64), len(digits), suffix)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, row):
        if isinstance(row, slice):
            return NumberedNames(self._prefix, self.numbers[row], self._digits, self._suffix)
        return f"{self._prefix}{self.numbers[row]:0{self._digits}d}{self._suffix}"

    def __iter__(self) -> Iterator[str]:
        head, digits, tail = self._prefix, self._digits, self._suffix
        return (f"{head}{number:0{digits}d}{tail}" for number in self.numbers.tolist())


@dataclasses.dataclass(frozen=True)
class Run:
    """One run, as it lies there.

    Attributes:
      split, name: such as "train" and "train/Town01/0000".
      folder: where it is.
      columns: those of the data frame that frames are read from, by name: an array [F, ...], or a sequence of F cells.
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
          DataError: where it is missing, a cell is of another size or type, or a number is not finite.
        """
        path = self.folder / FRAME_FILE
        if column not in self.columns:
            raise schema.DataError(f"{path}: column {column!r} is missing; there are {', '.join(self.columns)}.")
        cells = self.columns[column]
        try:
            same = isinstance(cells, np.ndarray)  # cells of one size
            found = np.asarray(cells if same else [_of_cell(cell, size) for cell in cells]).reshape(len(cells), size)
            if found.dtype.kind not in "fiu":
                raise ValueError(f"found {found.dtype}")
        except (TypeError, ValueError) as error:
            raise schema.DataError(f"{path}: column {column!r} does not hold {size} real numbers a frame ({error}). "
                                   f"Write them as the authors' DataWriter does.") from error
        values = found.astype(np.float32)
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
        parts = pathlib.PurePosixPath(_with_slashes(relative)).parts if isinstance(relative, str) else ()
        if not parts or ".." in parts or parts[0] == "/" or "\0" in relative:
            found = repr(relative[:80]) if isinstance(relative, str) else f"a {type(relative).__name__}"
            raise schema.DataError(f"{self.folder / FRAME_FILE}, row {row}: {kind}_path is {found}, expected a path "
                                   f"inside the run's folder.")
        return self.folder.joinpath(*parts)


def _of_cell(cell: Any, size: int) -> np.ndarray:
    """The numbers of a cell that is an array, a number or a list of numbers.

    Lists in lists are refused before NumPy sees them: a pickle that refers to one list again and again is small, and
    its array fills the memory.

    Raises:
      ValueError: for another size or something else.
    """
    if isinstance(cell, (list, tuple)) and not (
            len(cell) <= size and all(isinstance(item, (int, float, np.number)) for item in cell)):
        raise ValueError(f"found a list of {len(cell)}")
    return np.reshape(cell, size)


def _with_slashes(relative: str) -> str:
    """Tables that were written on Windows have its separators."""
    return relative.replace("\\", "/") if "\\" in relative else relative


@dataclasses.dataclass(frozen=True)
class KindFiles:
    """The files of one kind of a run.

    Attributes:
      run, kind: whose.
      present: bool [F], which rows have one.
      unusual: row -> the file, where it is not the one that the table names: another suffix or other case.
    """

    run: Run
    kind: str
    present: np.ndarray
    unusual: dict[int, pathlib.Path]

    def path(self, row: int) -> pathlib.Path:
        """The file of a frame; where there is none, the one that the table names."""
        return self.unusual.get(row) or self.run.path(self.kind, row)


def find_files(run: Run, kind: str) -> KindFiles:
    """Which files of a kind there are, whatever the case of their suffixes; images may have become JPEG.

    Raises:
      DataError: where files are there, but none that the table names.
    """
    present = np.zeros(run.frames, bool)
    unusual: dict[int, pathlib.Path] = {}
    if f"{kind}_path" not in run.columns:
        return KindFiles(run, kind, present, unusual)
    folders: dict[str, _Folder] = {}  # by the path in the table
    for row, relative in enumerate(run.columns[f"{kind}_path"]):
        head, _, name = _with_slashes(relative).rpartition("/") if isinstance(relative, str) else ("", "", "..")
        if head not in folders or name == ".." or "\0" in name:
            path = run.path(kind, row)  # checks it
            folders[head] = _Folder(path.parent)
        folder = folders[head]
        if name in folder.names:
            present[row] = True
        elif (found := folder.like(run.path(kind, row), kind)) is not None:
            present[row], unusual[row] = True, found
    if run.frames and not present.any() and any(folder.names for folder in folders.values()):
        path = run.path(kind, 0)
        raise schema.DataError(f"{path.parent}: holds {files.listing(path.parent)}, but {FRAME_FILE} names {path.name} "
                               f"and its like. Rename the files as the table names them, or take the folder away.")
    return KindFiles(run, kind, present, unusual)


class _Folder:
    """The files of a folder; none where there is no folder."""

    def __init__(self, path: pathlib.Path):
        self.names = {name for name in files.names_in(path) if not name.startswith(".")}

    @functools.cached_property
    def _by_stem(self) -> dict[str, dict[str, str]]:
        """stem -> suffix in lower case -> name."""
        found: dict[str, dict[str, str]] = {}
        for name in sorted(self.names):
            stem, suffix = os.path.splitext(name)
            found.setdefault(stem, {}).setdefault(suffix.lower(), name)
        return found

    def like(self, path: pathlib.Path, kind: str) -> pathlib.Path | None:
        """The file that stands in the place of one that the table names: of a suffix in other case, a JPEG image."""
        names = self._by_stem.get(path.stem, {})
        suffixes = (path.suffix, *_PICTURES) if path.suffix.lower() in _PICTURES and kind == "image" else (path.suffix,)
        found = next((names[suffix.lower()] for suffix in suffixes if suffix.lower() in names), None)
        return None if found is None else path.with_name(found)


def numbering(run: Run) -> np.ndarray:
    """The number of each frame, int64 [F], by the name of its first file; the row where names have no number.

    Raises:
      DataError: where they do not increase: rows were sorted otherwise than they were recorded.
    """
    columns = [column.removesuffix("_path") for column in run.columns if column.endswith("_path")]
    for kind in columns:
        names = run.columns[f"{kind}_path"]
        if isinstance(names, NumberedNames):
            return _increasing(names.numbers, run)
        found = [_NUMBER.search(run.path(kind, row).stem) for row in range(run.frames)]
        if all(found):
            return _increasing(np.array([int(match[1]) for match in found if match], np.int64), run)
    return np.arange(run.frames)


def check_numbers(run: Run, kinds: Collection[str]) -> None:
    """Looks whether a row names files of one frame, by their numbers.

    Files of two kinds that are numbered otherwise are warned of: rows may have been joined wrongly.

    Raises:
      DataError: where the numbers of a kind do not increase.
    """
    numbers, first = numbering(run), next((column for column in run.columns if column.endswith("_path")), "")
    for kind in sorted(set(kinds)):
        names = run.columns.get(f"{kind}_path")
        if not isinstance(names, NumberedNames):
            continue
        wrong = np.flatnonzero(_increasing(names.numbers, run, f"{kind}_path") != numbers)
        if wrong.size:
            row = int(wrong[0])
            warnings.warn(f"{run.folder / FRAME_FILE}: {wrong.size} of {run.frames} rows name files of two numbers, "
                          f"such as row {row}: {kind}_path is number {names.numbers[row]}, {first} {numbers[row]}. "
                          f"Were rows joined wrongly?", schema.DataWarning, stacklevel=4)


def _increasing(numbers: np.ndarray, run: Run, column: str = "") -> np.ndarray:
    wrong = np.flatnonzero(np.diff(numbers) <= 0)
    if wrong.size:
        row = int(wrong[0]) + 1
        where = f"{run.folder / FRAME_FILE}, row {row}{column and f' of {column}'}"
        raise schema.DataError(f"{where}: frame {numbers[row]} comes after frame {numbers[row - 1]}; rows must be in "
                               f"the order of their recording. Sort the table.")
    return numbers


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
    seen = lambda folder: not any(part.startswith(".") for part in folder.relative_to(path).parts)
    # What lies beside the version's folder, such as a backup, is no part of it.
    for pattern, depth in ((f"{VERSION_FOLDER}/*/*/*", 4), ("*", 1), ("*/*", 2), ("*/*/*", 3), ("*/*/*/*", 4)):
        found = sorted(frame.parent for frame in path.glob(f"{pattern}/{FRAME_FILE}") if seen(frame.parent))
        if found:
            parents = {folder.parent for folder in found}
            beside = sorted(child for parent in parents for child in parent.iterdir()
                            if child.is_dir() and not child.name.startswith("."))
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
    if depth >= 3:
        return folder.parents[1].name
    # A link to a mode's folder may be named after the mode, or lead to it.
    names = (os.path.basename(os.path.abspath(path)), path.resolve().name)
    return next((name for name in names if name in _MODES), "train")


def _read_run(split: str, folder: pathlib.Path) -> Run:
    path = folder / FRAME_FILE
    columns = safe_pickle.load_table(path)
    lacking = [name for name in ("action", "speed", "reward") if name not in columns]
    if lacking:
        raise schema.DataError(f"{path}: column {', '.join(lacking)} is missing; there are "
                               f"{', '.join(columns) or 'none'}.")
    kept = {name: (NumberedNames.of(cells) or cells) if name.endswith("_path") else cells
            for name, cells in columns.items() if name in _KEPT or name.endswith("_path")}
    # As the folder is called here: what a link leads to may bear the name of another run.
    here = pathlib.Path(os.path.abspath(folder))
    run = Run(split, f"{split}/{here.parent.name}/{here.name}", folder, kept)
    run.numbers("reward", 1)  # checked before anything is summed
    return run


def actions(run: Run) -> np.ndarray:
    """(acceleration, steering) of every frame, float32 [frames, 2]: the throttle where it is pressed, else -brake.

    Raises:
      DataError: where the recording has no action of three numbers a frame, or a pedal is not between 0 and 1.
    """
    throttle, steer, brake = run.numbers("action", 3).T
    for name, pedal in (("throttle", throttle), ("brake", brake)):
        wrong = np.flatnonzero((pedal < _PEDAL.lowest) | (pedal > _PEDAL.highest))
        if wrong.size:
            raise schema.DataError(f"{run.folder / FRAME_FILE}, row {wrong[0]}: {name} is {pedal[wrong[0]]:g}, "
                                   f"expected 0 to 1. An action is throttle, steering (-1 to 1, right positive), "
                                   f"brake: write it so.")
    return np.stack([np.where(throttle > 0, throttle, -brake), steer], axis=1)


def yaw_rates(run: Run) -> np.ndarray:
    """Of every frame, rad/s, left positive, float32 [frames]: the gyroscope's z axis; CARLA counts it to the right."""
    return -run.numbers("imu", 7)[:, 5]
