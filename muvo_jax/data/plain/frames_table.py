"""frames.csv of the plain format: one row a frame, every number checked against the table of fields."""

from __future__ import annotations

import csv
import io
import math
import pathlib

import numpy as np

from muvo_jax.data import fields, files, schema, sequences

FRAMES_FILE = "frames.csv"
REQUIRED = tuple(column for column, field in fields.COLUMNS.items() if field.required)
_WORDS = {"true": 1.0, "false": 0.0}


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Returns the columns of the table of fields that are there, by name, [F]: frame_id int64, the others float64.

    A column without a single value counts as absent; a blank is_terminal as false. `yaw_rate_radps` is made of yaw_rad
    where it is not recorded.

    Raises:
      DataError: naming the line, the column, what came and what was expected.
    """
    header, rows, lines = _cells(path)
    columns: dict[str, np.ndarray] = {}
    for column, field in fields.COLUMNS.items():
        if column not in header:
            continue
        cells = [row[header.index(column)] for row in rows]
        if field.required or any(cells):
            where = [f"{path}, line {line}: {column}" for line in lines]
            columns[column] = _frame_ids(cells, where) if column == "frame_id" else np.array(
                [number(text, field, place) for text, place in zip(cells, where, strict=True)], np.float64)
    sequences.check_increasing(columns["timestamp_s"], [f"{path}, line {line}" for line in lines])
    if "yaw_rad" in columns and "yaw_rate_radps" not in columns:
        columns["yaw_rate_radps"] = _rates(columns["yaw_rad"], columns["timestamp_s"])
    return columns


def words(path: pathlib.Path, column: str) -> list[str]:
    """A column of text; empty where there is none. Raises DataError for a malformed table."""
    header, rows, _ = _cells(path)
    return [row[header.index(column)] for row in rows] if column in header else []


def line_of(path: pathlib.Path, row: int) -> int:
    """The line of the file that a row of its columns stands in. Raises DataError for a malformed table."""
    return _cells(path)[2][row]


def ends_with_a_line(path: pathlib.Path) -> bool:
    """Whether the last row of a table ends, as every writer of CSV ends it; editors may not."""
    return path.read_bytes().endswith((b"\n", b"\r"))


def _cells(path: pathlib.Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, rows and the line of each, without blanks around cells and without empty lines."""
    try:
        text = files.read_bytes(path, "the frames of a run").decode("utf-8-sig")  # editors may write a byte order mark
        reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
        table = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise schema.DataError(f"{path}: not a CSV table ({error}). Record the run again.") from error
    (_, header), *filled = [(line, row) for line, row in table if any(row)] or [(1, [])]
    lines, rows = [line for line, _ in filled], [row for _, row in filled]
    lacking = [name for name in REQUIRED if name not in header]
    if lacking:
        other = next((mark for mark in (";", "\t") if mark in ",".join(header)), None)
        hint = f" Cells are separated by {other!r}; write commas." if other else " Record the run again."
        raise schema.DataError(f"{path}: column {', '.join(lacking)} is missing; the header has "
                               f"{', '.join(header) or 'none'}.{hint}")
    twice = sorted({name for name in header if name in fields.COLUMNS and header.count(name) > 1})
    if twice:
        raise schema.DataError(f"{path}: column {', '.join(twice)} is there twice. Remove one of them.")
    for line, row in filled:
        if len(row) != len(header):
            raise schema.DataError(f"{path}, line {line}: {len(row)} cells under {len(header)} columns. Numbers have a "
                                   f"point, not a comma; every row has a cell for each column.")
    return header, rows, lines


def _frame_ids(cells: list[str], where: list[str]) -> np.ndarray:
    """Whole numbers, exactly: 64 bits do not fit through a float."""
    seen: dict[int, str] = {}
    for text, place in zip(cells, where, strict=True):
        try:
            value = int(text) if _is_plain(text) else -1
        except ValueError:
            value = _whole_float(text)
        if not 0 <= value < 2**63:
            raise schema.DataError(f"{place} is {text!r}, expected a whole number from 0 to 2**63 - 1.")
        if value in seen:
            raise schema.DataError(f"{place} is {value}, which is there already ({seen[value]}). Each frame has a "
                                   f"number of its own.")
        seen[value] = place
    return np.array(list(seen), np.int64)


def _is_plain(text: str) -> bool:
    """Whether a number is written as other programs write it: Python alone takes 1_000 for one."""
    return text.isascii() and "_" not in text


def _whole_float(text: str) -> int:
    """A number such as 12.0 that a float holds exactly; -1 for anything else."""
    try:
        value = float(text)
    except ValueError:
        return -1
    return int(value) if math.isfinite(value) and value.is_integer() and abs(value) < 2**53 else -1


def number(text: str, field: fields.Field, where: str) -> float:
    """A cell as a number; a blank is_terminal is 0. Raises DataError where the field cannot have it."""
    if not text and field.name == "is_terminal":
        return 0.0
    try:
        value = _WORDS.get(text.lower()) if field.dtype is np.bool_ else None
        value = (float(text) if _is_plain(text) else math.nan) if value is None else value
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise schema.DataError(f"{where} is {text!r}, expected a finite number.")
    if field.values and value not in field.values:
        raise schema.DataError(f"{where} is {text}; it must be one of {', '.join(map(str, field.values))}.")
    if not field.limits.holds(value):
        raise schema.DataError(f"{where} is {text}; it must be {field.limits}. Is it of another unit?")
    if np.issubdtype(field.dtype, np.integer) and not value.is_integer():
        raise schema.DataError(f"{where} is {text}, expected a whole number.")
    return value


def _rates(yaw_rad: np.ndarray, timestamps_s: np.ndarray) -> np.ndarray:
    """Turning between a frame and the next (the last frame: as the one before), rad/s; 0 in a run of one frame."""
    if len(yaw_rad) < 2:
        return np.zeros(len(yaw_rad))
    turned_rad = (np.diff(yaw_rad) + np.pi) % (2 * np.pi) - np.pi
    return np.append(turned_rad, turned_rad[-1:]) / np.append(np.diff(timestamps_s), np.diff(timestamps_s)[-1:])
