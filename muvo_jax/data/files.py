"""Single files of a recording: read with errors that name the file and how to fix it, written whole or not at all."""

from __future__ import annotations

import contextlib
import io
import math
import os
import pathlib
import struct
import tokenize
import tomllib
import uuid
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from muvo_jax.data import schema

LARGEST_ARRAY_BYTES = 1 << 30  # what a field of a frame may claim before memory is taken for it
BAD_POINT_SHARE = 0.01  # more non-finite points than this are a broken file, not noise
_HEADER_TRIES = 8
RULE_FILE = "rule.json"  # beside occupancy: how it was made
_NOT_FRAMES = ("Thumbs.db", "desktop.ini", RULE_FILE)
# Of damaged archives; the last ones come from Python's parser, with which NumPy reads headers.
_ARCHIVE_ERRORS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, struct.error, KeyError, IndexError,
                   TypeError, OverflowError, MemoryError, RecursionError, NotImplementedError, RuntimeError,
                   SyntaxError, tokenize.TokenError)


def read_bytes(path: pathlib.Path, what: str) -> bytes:
    """The content of a file; raises DataError, which calls it `what`, where it is missing or cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise missing(path, what) from error
    except OSError as error:
        raise schema.DataError(f"{path}: expected {what}, but it cannot be read ({error}). Correct its permissions, or "
                               f"copy it again.") from error


def read_npz(path: pathlib.Path, name: str) -> np.ndarray:
    """Returns one array of an NPZ file (pickled objects are refused).

    Raises:
      DataError: where the file is missing, damaged or lacks the array.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX:
                raise schema.DataError(f"{path}: a single array (NPY) under the name of an NPZ file; write it with "
                                       f"np.savez and the name {name!r}.")
            with zipfile.ZipFile(file) as archive:
                sizes = [entry.file_size for entry in archive.infolist() if entry.filename == f"{name}.npy"]
                names = archive.namelist()
            if not sizes:  # np.load would also give, as bytes of any size, a member without the suffix
                held = ", ".join(name.removesuffix(".npy") for name in names if name.endswith(".npy"))
                raise schema.DataError(f"{path}: holds {held or 'no array'}, expected an array {name!r}.")
            if max(sizes) > LARGEST_ARRAY_BYTES:
                raise schema.DataError(f"{path}: {name!r} unpacks to {max(sizes)} bytes, more than the "
                                       f"{LARGEST_ARRAY_BYTES} that a field of a frame may have.")
            file.seek(0)
            return _one_of(np.load(file, allow_pickle=False), f"{name}.npy")
    except FileNotFoundError as error:
        raise missing(path, f"an NPZ file with {name!r}") from error
    except schema.DataError:
        raise
    except _ARCHIVE_ERRORS as error:
        raise schema.DataError(f"{path}: not a readable NPZ file ({error}). The file is truncated or damaged: copy it "
                               f"again, or delete it so that the sequence is split there.") from error


def _one_of(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """The array; read again where CPython, parsing the headers of two threads at once, loses count of its recursion
    (SystemError "AST constructor recursion depth mismatch", seen with 3.11.7)."""
    for _ in range(_HEADER_TRIES - 1):
        with contextlib.suppress(SystemError):
            return arrays[name]
    return arrays[name]


class NpyHeader(NamedTuple):
    """Of an .npy file; `size` in bytes."""

    shape: tuple[int, ...]
    dtype: np.dtype
    size: int


def npy_header(path: pathlib.Path) -> NpyHeader | None:
    """The header of an .npy file; None where it is cut off or damaged."""
    with path.open("rb") as file:
        try:
            np.lib.format.read_magic(file)
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        except (ValueError, EOFError):
            return None
        return NpyHeader(shape, dtype, file.tell())


def is_whole_array(path: pathlib.Path) -> bool:
    """Whether an .npz or .npy file is there and complete, without reading all of it."""
    if not path.is_file():
        return False
    if path.suffix == ".npz":
        return zipfile.is_zipfile(path)
    header = npy_header(path)
    return (header is not None and not header.dtype.hasobject
            and path.stat().st_size == header.size + math.prod(header.shape) * header.dtype.itemsize)


def npz_names(path: pathlib.Path) -> frozenset[str] | None:
    """The names of the arrays in an NPZ file; None where it cannot be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            return frozenset(name.removesuffix(".npy") for name in archive.namelist())
    except _ARCHIVE_ERRORS:
        return None


def read_toml(path: pathlib.Path) -> dict:
    """Returns a parsed TOML file; raises DataError where it is missing or malformed, or a number has over 64 bits."""
    content = read_bytes(path, "a TOML description")
    try:
        text = content.decode("utf-8-sig")  # editors may write a byte order mark
        values = tomllib.loads(text.replace("\r\n", "\n").replace("\r", "\n"))
        name = _too_large(values, "")
    except (ValueError, RecursionError) as error:  # Python's own ValueError, too: a number of thousands of digits
        raise schema.DataError(f"{path}: not valid TOML ({error}).") from error
    if name is not None:
        raise schema.DataError(f"{path}: {name.removeprefix('.')} is a whole number of more than 64 bits; it must be "
                               f"at least -2**63 and below 2**63.")
    return values


def _too_large(value: Any, name: str) -> str | None:
    """The name of a whole number, in a table or list of this name, that TOML cannot have; None where there is none."""
    if isinstance(value, int):
        return None if -2**63 <= value < 2**63 else name
    items = ([(f"{name}.{key}", item) for key, item in value.items()] if isinstance(value, dict) else
             [(f"{name}[{index}]", item) for index, item in enumerate(value)] if isinstance(value, list) else [])
    return next((found for name, item in items if (found := _too_large(item, name)) is not None), None)


def is_folder_name(name: str) -> bool:
    """Whether a name is that of a folder inside another one, and of none that readers pass over."""
    return bool(name) and not name.startswith(".") and not set("/\\\0:") & set(name)


def names_in(folder: pathlib.Path | str | bytes) -> list:
    """The names in a folder, sorted; none where there is no folder. A link to nowhere, as git-annex and DVC leave it
    for what was not fetched, is no file.

    Raises:
      DataError: where the folder cannot be read.
    """
    try:
        with os.scandir(folder) as entries:  # type: ignore[type-var]
            return sorted(entry.name for entry in entries if not entry.is_symlink() or os.path.exists(entry.path))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise schema.DataError(f"{os.fsdecode(folder)}: the folder cannot be read ({error}). Correct its permissions."
                               ) from error


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


def check_written(rows: np.ndarray, path: pathlib.Path, most: float = BAD_POINT_SHARE) -> None:
    """Raises DataError where a larger share than `most` of a scan's rows [N, C] holds nothing but zeros, which is what
    was never written of a file."""
    empty = int((~rows.any(axis=1)).sum())
    if empty > most * len(rows):
        raise schema.DataError(f"{path}: {empty} of {len(rows)} points are 0 in all their numbers: the file is written "
                               f"or copied in part. Copy it again, or delete it so that the sequence is split there.")


def numbered(folder: pathlib.Path, suffixes: str | Sequence[str]) -> dict[int, str]:
    """The files of frames in a folder, frame number -> name: 12.png, 000012.png and 000012.PNG are all frame 12.

    Empty where there is no folder, or nothing in it. Of two suffixes of one name the first of `suffixes` counts.

    Raises:
      DataError: where two files are of one frame, or files are there but none is named by a number.
    """
    order = {suffix: place for place, suffix in enumerate([suffixes] if isinstance(suffixes, str) else suffixes)}
    found: dict[int, str] = {}
    others: list[str] = []
    for name in names_in(folder):
        stem, suffix = os.path.splitext(name)
        if name.startswith(".") or name in _NOT_FRAMES:
            continue
        if suffix.lower() not in order or not (stem.isascii() and stem.isdigit()):
            others.append(name)
            continue
        other = found.setdefault(int(stem), name)
        if other != name:
            other_stem, other_suffix = os.path.splitext(other)
            if other_stem != stem or other_suffix.lower() == suffix.lower():
                raise schema.DataError(f"{folder}: {other} and {name} are both frame {int(stem)}. Remove one of them.")
            if order[suffix.lower()] < order[other_suffix.lower()]:
                found[int(stem)] = name
    if others and not found:
        raise schema.DataError(f"{folder}: no file is named by the number of its frame, such as "
                               f"000012{next(iter(order))} ({', '.join(order)}); found {', '.join(others[:3])}. Rename "
                               f"them, or take the folder away.")
    return found


def write_atomically(path: pathlib.Path, content: str | bytes) -> None:
    """Writes a file such that it is there whole or not at all."""
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex}")  # other machines may have this process id, too
    try:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(draft, path)
    except OSError:
        draft.unlink(missing_ok=True)  # no later attempt writes over it
        raise


def npz_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """An NPZ file, at the fastest compression: half the size of none, a third of the time of NumPy's.

    The archive's time stamps are fixed, so that equal arrays give equal bytes.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, buffer.getbuffer(), compresslevel=1)
    return content.getvalue()


def _builtin(value: Any) -> Any:
    """Numbers of NumPy, in tables and lists, as Python's."""
    if isinstance(value, Mapping):
        return {name: _builtin(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_builtin(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def write_description(path: pathlib.Path, values: Mapping, other: str) -> None:
    """Writes a TOML file of these values; one that says the same stays as it is, comments and all.

    Args:
      other: what one describes that says something else, for messages.

    Raises:
      FileExistsError: where there is one that says something else.
    """
    text = tomli_w.dumps(_builtin(values))
    if path.is_file():
        try:
            before = read_toml(path)
        except schema.DataError:
            before = None
        if before != tomllib.loads(text):
            raise FileExistsError(f"{path} describes {other}; choose another folder or remove this one.")
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text)
