"""Single files of a recording, read with errors that name the file and how to fix it; runs cut at gaps."""

from __future__ import annotations

import pathlib
import struct
import tokenize
import tomllib
import warnings
import zipfile
import zlib
from collections.abc import Iterable

import numpy as np
from PIL import Image

from muvo_jax.data import schema, words

BAD_POINT_SHARE = 0.01  # more non-finite points than this are a broken file, not noise
FEW_SHARE = 0.05  # gaps at no more frames than these (or at one) are what recordings have; more are a fault
GAP_PERIODS = 1.5  # a time step longer than this many periods is a gap
# Pillow raises any of these for broken chunks and for sizes that would fill the memory.
_IMAGE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, IndexError, OverflowError, MemoryError, zlib.error,
                 struct.error, Image.DecompressionBombError)
# Of damaged archives; the last ones come from Python's parser, with which NumPy reads headers.
_ARCHIVE_ERRORS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, struct.error, KeyError, IndexError,
                   TypeError, OverflowError, MemoryError, RecursionError, NotImplementedError, RuntimeError,
                   SyntaxError, tokenize.TokenError)


def read_image(path: pathlib.Path, mode: str | None) -> np.ndarray:
    """Returns a PNG or JPEG: [H, W, 3] for mode "RGB", [H, W, 4] for "RGBA", [H, W] for "L"; for None as it is stored.

    Raises:
      DataError: where the file is missing, truncated or no image.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert(mode) if mode else image)
    except FileNotFoundError as error:
        raise missing(path, "an image") from error
    except _IMAGE_ERRORS as error:
        raise schema.DataError(f"{path}: not a readable image ({error}). The file is truncated or damaged: copy it "
                               f"again, or delete it so that the sequence is split there.") from error


def read_npz(path: pathlib.Path, name: str) -> np.ndarray:
    """Returns one array of an NPZ file (pickled objects are refused).

    Raises:
      DataError: where the file is missing, damaged or lacks the array.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            if name not in arrays:
                raise schema.DataError(f"{path}: holds {', '.join(arrays) or 'nothing'}, expected an array {name!r}.")
            return arrays[name]
    except FileNotFoundError as error:
        raise missing(path, f"an NPZ file with {name!r}") from error
    except schema.DataError:
        raise
    except _ARCHIVE_ERRORS as error:
        raise schema.DataError(f"{path}: not a readable NPZ file ({error}). The file is truncated or damaged: copy it "
                               f"again, or delete it so that the sequence is split there.") from error


def npz_holds(path: pathlib.Path, name: str) -> bool:
    """Whether a readable NPZ file has an array of that name."""
    try:
        with zipfile.ZipFile(path) as archive:
            return f"{name}.npy" in archive.namelist()
    except _ARCHIVE_ERRORS:
        return False


def read_toml(path: pathlib.Path) -> dict:
    """Returns a parsed TOML file; raises DataError where it is missing or malformed."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise missing(path, "a TOML description") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise schema.DataError(f"{path}: not valid TOML ({error}).") from error


def missing(path: pathlib.Path, what: str) -> schema.DataError:
    """The error for a file or folder that is not there; names what its folder holds instead."""
    parent = path.parent
    if not parent.is_dir():
        return schema.DataError(f"{path} is missing (its folder too); expected {what} there.")
    return schema.DataError(f"{path} is missing; expected {what} there. Its folder holds {listing(parent)}.")


def listing(folder: pathlib.Path, limit: int = 6) -> str:
    """The first names in a folder, for messages."""
    names = sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def finite_points(points_m: np.ndarray, path: pathlib.Path) -> np.ndarray:
    """Returns the rows of points [N, 3] that are finite, with a counted warning where some are not.

    Raises:
      DataError: where more than 1 % are not finite.
    """
    finite = np.isfinite(points_m).all(axis=1)
    bad = len(points_m) - int(finite.sum())
    if not bad:
        return points_m
    if bad > BAD_POINT_SHARE * len(points_m):
        raise schema.DataError(f"{path}: {bad} of {len(points_m)} points are NaN or infinite (at most "
                               f"{BAD_POINT_SHARE:.0%} are tolerated). Export the scan again, or delete the file so "
                               f"that the sequence is split there.")
    warnings.warn(f"{path}: {bad} of {len(points_m)} points are NaN or infinite and are left out.",
                  schema.DataWarning, stacklevel=2)
    return points_m[finite]


def numbered(folder: pathlib.Path, suffix: str) -> set[int]:
    """The frame numbers for which `folder` has a file like 000012.png; empty where there is no folder."""
    if not folder.is_dir():
        return set()
    return {int(path.stem) for path in folder.iterdir() if path.suffix == suffix and path.stem.isdigit()}


def check_increasing(timestamps_s: np.ndarray, where: Iterable[str]) -> None:
    """Raises DataError at the first time stamp that is not later than the one before; `where` names each."""
    steps = np.diff(timestamps_s)
    wrong = np.flatnonzero(~(steps > 0))
    if wrong.size:
        index = int(wrong[0]) + 1
        raise schema.DataError(f"{list(where)[index]}: time {timestamps_s[index]:.3f} s does not come after the frame "
                               f"before it ({timestamps_s[index - 1]:.3f} s); time stamps must increase. Sort the "
                               f"frames or remove the wrong ones.")


def after_gap(timestamps_s: np.ndarray, period_s: float) -> np.ndarray:
    """bool [F], the frames that come more than 1.5 periods after the one before; NaN times are no gap."""
    late = np.zeros(len(timestamps_s), bool)
    late[1:] = np.diff(timestamps_s) > GAP_PERIODS * period_s
    return late


def gap_free(present: np.ndarray, breaks: np.ndarray) -> list[tuple[int, int]]:
    """Cuts a run into (start, length) pieces.

    Args:
      present: bool [F], whether every sensor has the frame.
      breaks: bool [F], frames that start a new piece in any case.
    """
    pieces: list[tuple[int, int]] = []
    start: int | None = None
    for index in range(len(present)):
        if start is not None and (breaks[index] or not present[index]):
            pieces.append((start, index - start))
            start = None
        if start is None and present[index]:
            start = index
    if start is not None:
        pieces.append((start, len(present) - start))
    return pieces


class GapWarning(schema.DataWarning):
    """A few frames that a sensor lacks, or jumps in time: sequences are cut there, and the rest is whole."""


def warn_of_gaps(where: str, present: np.ndarray, absent: dict[str, int], late: np.ndarray, pieces: int) -> None:
    """Warns, with counts, of frames that a sensor lacks and of gaps in time; says nothing where there are none.

    Args:
      where: the run.
      present: bool [F].
      absent: sensor -> number of frames it lacks.
      late: bool [F], see after_gap.
      pieces: into how many sequences the run falls.
    """
    found = []
    if not present.all():
        lacking = ", ".join(f"{count} in {sensor}" for sensor, count in absent.items() if count)
        found.append(f"{int((~present).sum())} of {len(present)} frames are left out because a file is missing "
                     f"({lacking})")
    if late.any():
        found.append(f"time jumps by more than {GAP_PERIODS} periods at {int(late.sum())} of {len(present)} frames")
    if found:
        few = max(int((~present).sum()), int(late.sum())) <= max(1, FEW_SHARE * len(present))
        left = words.counted(pieces, "gap-free sequence")
        warnings.warn(f"{where}: {' and '.join(found)}; what is left makes {left}.",
                      GapWarning if few else schema.DataWarning, stacklevel=4)
