"""The tables of nuScenes v1.0, as far as frames are made of them, read row by row.

Those of v1.0-trainval are 2 GB of JSON, of which sample_data and ego_pose are nearly all: no table is in memory whole,
only the rows of the sensors that are asked for stay, as columns.
"""

from __future__ import annotations

import itertools
import json
import os
import pathlib
import re
from collections.abc import Iterator
from typing import Any, NamedTuple, TextIO

import numpy as np

from muvo_jax import geometry
from muvo_jax.data import files, schema

NAMES = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose")
_CHUNK_CHARS, _LONGEST_ROW_CHARS = 1 << 20, 1 << 22
_BETWEEN_ROWS = re.compile(r"\s*,?\s*")
_NAME_BYTES = 160  # of a file's name; nuScenes' have up to 84
_UNIT = 0.01  # how far the norm of a quaternion may be from 1
_US_END = 2**63 // 1000
_FARTHEST = 1e8  # of any number of a calibration or pose
ROW = np.dtype([("scene", np.int32), ("time_us", np.int64), ("is_key_frame", np.bool_), ("calibration", np.int32),
                ("pose", np.int32), ("width_px", np.int32), ("height_px", np.int32), ("name", f"S{_NAME_BYTES}")])


class Calibration(NamedTuple):
    """A sensor on a car: what it is called, its place in the ego frame [4, 4] and, of a camera, intrinsics [3, 3]."""

    channel: str
    to_ego: np.ndarray
    intrinsics: np.ndarray | None


class Tables(NamedTuple):
    """What the tables say of some sensors.

    Attributes:
      calibrations: what rows["calibration"] counts.
      rows: of dtype ROW, sorted by scene and time; "scene" counts the scenes that were asked for, "name" is a path
        below the data's root.
      poses: float64 [P, 4, 4], ego frame to that of the map, what rows["pose"] counts.
    """

    calibrations: tuple[Calibration, ...]
    rows: np.ndarray
    poses: np.ndarray

    def of(self, channel: str) -> np.ndarray:
        """The rows of one sensor."""
        wanted = [index for index, calibration in enumerate(self.calibrations) if calibration.channel == channel]
        return self.rows[np.isin(self.rows["calibration"], wanted)]


def folders(path: pathlib.Path) -> list[pathlib.Path]:
    """The folders of tables: `path` itself, or those in it; both are named v1.0-something."""
    is_one = os.path.basename(os.path.abspath(path)).startswith("v1.0-")
    candidates = [path] if is_one else sorted(path.glob("v1.0-*"))
    return [folder for folder in candidates if any((folder / f"{name}.json").is_file() for name in NAMES)]


def scene_names(folder: pathlib.Path) -> dict[str, str]:
    """Token of each scene -> its name, such as scene-0061.

    Raises:
      DataError: as `rows`.
    """
    path = folder / "scene.json"
    return {_get(row, "token", str, path): _get(row, "name", str, path) for row in rows(path)}


def read(folder: pathlib.Path, scenes: list[str], channels: tuple[str, ...], *, key_frames: bool) -> Tables:
    """Reads what concerns some scenes and sensors.

    Args:
      scenes: their tokens.
      channels: names of sensors, such as LIDAR_TOP.
      key_frames: whether key frames alone count.

    Raises:
      DataError: where a table is missing or malformed, or refers to what is not there; naming table and row.
    """
    calibrations, calibration_of = _calibrations(folder, channels)
    scene_of = _scene_of_samples(folder, {token: index for index, token in enumerate(scenes)})
    pose_of: dict[str, int] = {}
    found = np.fromiter(_sample_data(folder, scene_of, calibration_of, pose_of, key_frames=key_frames), ROW)
    found = found[np.lexsort((found["time_us"], found["scene"]))]
    return Tables(calibrations, found, _poses(folder, pose_of))


def rows(path: pathlib.Path) -> Iterator[dict[str, Any]]:
    """The rows of a table, one after the other.

    Raises:
      DataError: where the table is missing, truncated or no list of JSON objects; naming the row.
    """
    if not path.is_file():
        raise files.missing(path, "a table of nuScenes (unpack its metadata)")
    number = 0
    try:
        with path.open(encoding="utf-8-sig") as file:
            for row in _objects(file):
                if not isinstance(row, dict):
                    raise ValueError(f"found {str(row)[:40]!r} instead of an object")
                yield row
                number += 1
    except (ValueError, RecursionError) as error:
        raise schema.DataError(f"{path}: row {number + 1} is not readable ({error}). A table of nuScenes is a JSON "
                               f"list of objects; unpack the metadata again.") from error


def _objects(file: TextIO) -> Iterator[Any]:
    """What a JSON list holds, with no more of it in memory than a chunk and an item. Raises ValueError."""
    decode = json.JSONDecoder().raw_decode
    text, at = "", 1
    while not text and (chunk := file.read(_CHUNK_CHARS)):
        text = chunk.lstrip()
    if not text.startswith("["):
        raise ValueError("the file does not begin with [")
    while True:
        at = _BETWEEN_ROWS.match(text, at).end()  # type: ignore[union-attr]  # it matches nothing too
        if text.startswith("]", at):
            _check_end(text[at + 1:], file)
            return
        try:
            item, at = decode(text, at)
        except json.JSONDecodeError:
            more = file.read(_CHUNK_CHARS)
            if not more or len(text) - at > _LONGEST_ROW_CHARS:
                raise
            text, at = text[at:] + more, 0
            continue
        yield item


def _check_end(text: str, file: TextIO) -> None:
    """Raises ValueError where more than spaces follows the list: two tables in one file, or one overwritten in part."""
    for more in itertools.chain([text], iter(lambda: file.read(_CHUNK_CHARS), "")):
        if rest := more.strip():
            raise ValueError(f"the list ends before {rest[:40]!r}")


def _calibrations(folder: pathlib.Path, channels: tuple[str, ...]) -> tuple[tuple[Calibration, ...], dict[str, int]]:
    """Those of the named sensors, and token -> place among them."""
    path = folder / "sensor.json"
    every = {_get(row, "token", str, path): _get(row, "channel", str, path) for row in rows(path)}
    for channel in channels:
        if channel not in every.values():
            raise schema.DataError(f"{path}: there is no sensor {channel}; there are "
                                   f"{', '.join(sorted(set(every.values()))) or 'none'}.")
    path = folder / "calibrated_sensor.json"
    found: list[Calibration] = []
    places: dict[str, int] = {}
    for row in rows(path):
        channel = every.get(_get(row, "sensor_token", str, path), "")
        if channel not in channels:
            continue
        place = matrices(_pose(row, path)[None])[0]
        if not all(geometry.MOUNTING_M.holds(value) for value in place[:3, 3]):
            raise schema.DataError(f"{path}: row {_token(row)} puts {channel} at {place[:3, 3].tolist()}; each "
                                   f"coordinate must be {geometry.MOUNTING_M}.")
        intrinsics = _get(row, "camera_intrinsic", list, path)
        places[_get(row, "token", str, path)] = len(found)
        found.append(Calibration(channel, place, _matrix(intrinsics, row, path) if intrinsics else None))
    return tuple(found), places


def _scene_of_samples(folder: pathlib.Path, scenes: dict[str, int]) -> dict[str, int]:
    path = folder / "sample.json"
    found = {}
    for row in rows(path):
        scene = scenes.get(_get(row, "scene_token", str, path))
        if scene is not None:
            found[_get(row, "token", str, path)] = scene
    return found


def _sample_data(folder: pathlib.Path, scene_of: dict[str, int], calibration_of: dict[str, int],
                 pose_of: dict[str, int], *, key_frames: bool) -> Iterator[tuple]:
    """The rows that are wanted, as ROW has them; fills `pose_of`, token -> place of a pose, as they come."""
    path = folder / "sample_data.json"
    for row in rows(path):
        calibration = calibration_of.get(_get(row, "calibrated_sensor_token", str, path))
        scene = scene_of.get(_get(row, "sample_token", str, path))
        is_key_frame = _get(row, "is_key_frame", bool, path)
        if calibration is None or scene is None or (key_frames and not is_key_frame):
            continue
        name = _get(row, "filename", str, path).encode("utf-8", "replace")
        place = pathlib.PurePosixPath(name.decode())
        if not 0 < len(name) <= _NAME_BYTES or b"\0" in name or place.is_absolute() or ".." in place.parts:
            raise schema.DataError(f"{path}: row {_token(row)} has the filename {name.decode()[:200]!r}, expected a "
                                   f"path below the data's folder of at most {_NAME_BYTES} bytes.")
        yield (scene, _time_us(row, path), is_key_frame, calibration,
               pose_of.setdefault(_get(row, "ego_pose_token", str, path), len(pose_of)), _side_px(row, "width", path),
               _side_px(row, "height", path), name)


def _poses(folder: pathlib.Path, pose_of: dict[str, int]) -> np.ndarray:
    path = folder / "ego_pose.json"
    found = np.full((len(pose_of), 7), np.nan)
    for row in rows(path):
        place = pose_of.get(_get(row, "token", str, path))
        if place is not None:
            found[place] = _pose(row, path)
    lacking = np.isnan(found[:, 0])
    if lacking.any():
        token = next(token for token, place in pose_of.items() if lacking[place])
        raise schema.DataError(f"{path}: {int(lacking.sum())} of {len(found)} poses that sample_data.json names are "
                               f"missing, such as {token}. The tables are of two downloads, or cut off: unpack the "
                               f"metadata again.")
    return matrices(found)


def matrices(poses: np.ndarray) -> np.ndarray:
    """float64 [P, 4, 4] of [P, 7], translations (m) and unit quaternions w, x, y, z."""
    w, x, y, z = (poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)).T
    found = np.zeros((len(poses), 4, 4))
    found[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    found[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    found[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    found[:, :3, 3], found[:, 3, 3] = poses[:, :3], 1.0
    return found


def _token(row: dict) -> str:
    return str(row.get("token"))[:40]


def _get(row: dict, name: str, kind: type, path: pathlib.Path) -> Any:
    value = row.get(name)
    if type(value) is not kind:
        raise schema.DataError(f"{path}: row {_token(row)} has {name} = {str(value)[:80]!r} "
                               f"({type(value).__name__}), expected {kind.__name__}. Unpack the metadata again.")
    return value


def _time_us(row: dict, path: pathlib.Path) -> int:
    time_us = _get(row, "timestamp", int, path)
    if not 0 <= time_us < _US_END:
        raise schema.DataError(f"{path}: row {_token(row)} has the timestamp {str(time_us)[:40]}, expected "
                               f"microseconds since 1970.")
    return time_us


def _side_px(row: dict, name: str, path: pathlib.Path) -> int:
    """Of a picture; 0 of a scan."""
    side_px = _get(row, name, int, path) if row.get(name) is not None else 0
    if not 0 <= side_px <= 100_000:
        raise schema.DataError(f"{path}: row {_token(row)} has {name} = {str(side_px)[:40]}, expected pixels.")
    return side_px


def _numbers(values: Any, count: int, what: str) -> list[float]:
    """Raises ValueError where they are not so many finite numbers."""
    if not isinstance(values, list) or len(values) != count or not all(
            type(value) in (int, float) and abs(value) < _FARTHEST for value in values):  # NaN is not
        raise ValueError(f"{what} = {str(values)[:80]}, expected {count} numbers below {_FARTHEST:g}")
    return values


def _pose(row: dict, path: pathlib.Path) -> np.ndarray:
    """float64 [7], translation and rotation of a row."""
    try:
        place = _numbers(row.get("translation"), 3, "translation")
        turn = np.array(_numbers(row.get("rotation"), 4, "rotation"), np.float64)
        if abs(np.linalg.norm(turn) - 1.0) > _UNIT:
            raise ValueError(f"rotation = {turn.tolist()}, expected a unit quaternion w, x, y, z")
    except ValueError as error:
        raise schema.DataError(f"{path}: row {_token(row)} has {error}. Unpack the metadata again.") from error
    return np.concatenate([place, turn])


def _matrix(rows_: list, row: dict, path: pathlib.Path) -> np.ndarray:
    try:
        if len(rows_) != 3:
            raise ValueError(f"{len(rows_)} rows of camera_intrinsic, expected 3")
        return np.array([_numbers(numbers, 3, "a row of camera_intrinsic") for numbers in rows_], np.float64)
    except ValueError as error:
        raise schema.DataError(f"{path}: row {_token(row)} has {error}. Unpack the metadata again.") from error
