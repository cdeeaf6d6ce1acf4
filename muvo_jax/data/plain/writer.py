"""Writes the plain recording format that reader.py reads: folders of PNG, NPZ, CSV and TOML, nothing pickled.

A run counts once its frames.csv is there, and that is written last, by renaming: whatever interrupts a recording leaves
either a complete run or one that readers ignore, and recording again goes on where it stopped. Depth maps (16-bit PNG,
centimetres, 65535 in the sky) and class images are kept for people and other models, too.
"""

from __future__ import annotations

import csv
import io
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.data import description, fields, files, pictures, schema
from muvo_jax.data.plain import cameras, frames_table
from muvo_jax.data.plain import reader as plain_reader

COLUMNS = ("frame_id", "timestamp_s", "x_m", "y_m", "yaw_rad", "speed_mps", "acceleration", "steering", "reward",
           "is_terminal", "weather")
_NO_FILE = fields.Field("", np.uint8)
# Names of RawFrame and what recorders call them: both are taken.
_ALIASES = {"classes": "image_classes", "point_tags": "point_classes"}
_NOT_WRITTEN = ("image_instance_mask",)  # made of image_classes
KEYS = frozenset((*COLUMNS, *fields.COLUMNS, *fields.FIELDS, *_ALIASES))


def write_description(root: pathlib.Path | str, *, name: str, rate_hz: float, splits: tuple[str, ...],
                      contract: config_lib.ActionContract, camera: schema.Camera | None = None,
                      lidar: config_lib.RangeViewGeometry | None = None,
                      voxels: config_lib.VoxelGrid | None = None, classes: tuple[str, ...] = (),
                      route_map: config_lib.RouteMap | None = None) -> pathlib.Path:
    """Writes ROOT/recording.toml, what holds for every run; sensors that are None are left out.

    Args:
      classes: names of the classes, in their order; readers take the town's (fields.TOWN_CLASSES) where there are none.
      route_map: scale of the route maps; None is the town's.

    Raises:
      FileExistsError: where ROOT holds a different description (runs of different settings must not be mixed).
    """
    root = pathlib.Path(root).expanduser()
    path = root / plain_reader.DESCRIPTION_FILE
    files.write_description(path, {
        "schema_version": plain_reader.SCHEMA_VERSION, "name": name, "rate_hz": float(rate_hz),
        "splits": list(splits)} | ({"classes": list(classes)} if classes else {}) | description.tables(
            action=contract, camera=camera, lidar=lidar, voxels=voxels, route_map=route_map),
        "another recording (other sensors, splits or actions)")
    return path


def is_complete(root: pathlib.Path | str, split: str, run: str) -> bool:
    """Whether a run was recorded to its end, so that it need not be recorded again."""
    return (pathlib.Path(root).expanduser() / split / run / plain_reader.FRAMES_FILE).is_file()


class RunWriter:
    """Records one run: `write` each frame in order, then `close`. A run that is not closed stays incomplete.

    Opening a run removes what an interrupted attempt left there.
    """

    def __init__(self, root: pathlib.Path | str, split: str, run: str):
        """Raises ValueError for names that are none of folders, FileExistsError where the run is complete already."""
        for what, name in (("split", split), ("run", run)):
            if not files.is_folder_name(name):
                raise ValueError(f"{what} {name!r}: expected the name of a folder in {root}, which readers find: no "
                                 f"dot in front, no slash or colon, not empty.")
        self._root = pathlib.Path(root).expanduser()
        self.folder = self._root / split / run
        if is_complete(root, split, run):
            raise FileExistsError(f"{self.folder} is recorded already; remove it to record it again.")
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        self._rows: list[dict[str, str]] = []
        self._sections: dict[str, Any] | None = None  # of recording.toml, once it is there

    def write(self, frame: Mapping) -> None:
        """Writes the files of one frame.

        Args:
          frame: either as a reader gives it (schema.RawFrame), which is then read back bit for bit; or frame_id (int),
            timestamp_s, speed_mps, acceleration and steering, the other names of COLUMNS as far as they are known, and
            any of image uint8 [H, W, 3], depth_m float [H, W] (infinite in the sky; centimetres are kept), classes and
            route_map uint8 [H, W], image_moving_mask bool [H, W] and occupancy_moving_mask bool [X, Y, Z],
            points_m float [N, 3] (with point_tags uint8 [N], what each hit), occupancy uint8 [X, Y, Z],
            birds_eye_classes uint8 [X, Y] with birds_eye_instances int32 [X, Y].

        Raises:
          ValueError: where frame_id does not increase, a name is unknown (naming the nearest), or DataError where a
            field is missing, of another shape than described or as the others, or has numbers that it cannot have.
        """
        fields.unknown(frame, KEYS, f"{self.folder}: field")
        frame_id = int(frame["frame_id"])
        where = f"{self.folder}, frame {frame_id}"
        if self._rows and frame_id <= int(self._rows[-1]["frame_id"]):
            raise ValueError(f"frame_id {frame_id} after {self._rows[-1]['frame_id']}: frames must be written in "
                             f"order.")
        row = _row(frame, where)
        self._check_time(row, where)
        arrays = {name: fields.conform(name, value, where, self._shape_of(name)) for key, value in frame.items()
                  if fields.FIELDS.get(name := _ALIASES.get(key, key), _NO_FILE).folder and name not in _NOT_WRITTEN}
        if "point_classes" in arrays and len(arrays["point_classes"]) != len(arrays.get("points_m", ())):
            raise schema.DataError(f"{where}: {len(arrays['point_classes'])} classes of "
                                   f"{len(arrays.get('points_m', ()))} points. Write a class for each point.")
        depth_m = arrays.pop("depth_m", None)
        if depth_m is not None:
            self._write_depth(frame_id, depth_m, exactly="action" in frame)
        packed: dict[str, dict[str, np.ndarray]] = {}
        for name, array in arrays.items():
            field = fields.FIELDS[name]
            if field.array:
                packed.setdefault(field.folder, {})[field.array] = array
            else:
                self._save_png(field.folder, frame_id, array)
        for folder, contents in packed.items():
            self._path(folder, frame_id, ".npz").write_bytes(files.npz_bytes(contents))
        self._rows.append(row)

    def close(self) -> None:
        """Completes the run. The camera of the frames is left out where it is the description's in every frame."""
        table = io.StringIO(newline="")
        self._settle_cameras()
        more = [name for name in fields.COLUMNS if name not in COLUMNS and any(name in row for row in self._rows)]
        writer = csv.DictWriter(table, (*COLUMNS, *more), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        files.write_atomically(self.folder / plain_reader.FRAMES_FILE, table.getvalue())

    def _check_time(self, row: dict[str, str], where: str) -> None:
        lacking = [column for column in frames_table.REQUIRED if column not in row]
        if lacking:
            raise schema.DataError(f"{where}: no {', '.join(lacking)}, which every frame of the plain format has.")
        if self._rows and float(row["timestamp_s"]) <= float(before := self._rows[-1]["timestamp_s"]):
            raise schema.DataError(f"{where}: time {row['timestamp_s']} s does not come after the frame before it "
                                   f"({before} s). Take a clock that is not set back while you record.")

    def _shape_of(self, name: str) -> tuple[int | None, ...] | None:
        """Of a field, as recording.toml says; None where there is none yet."""
        if self._sections is None:
            try:
                header = plain_reader.read_header(self._root)
                self._sections = {section: description.section(header, section, self._root, required=False)
                                  for section in ("camera", "voxels")}
            except schema.DataError:  # not described yet
                return None
        return schema.shape_of(name, **self._sections)

    def _settle_cameras(self) -> None:
        self._shape_of("image")
        camera = (self._sections or {}).get("camera")
        for field in cameras.FIELDS if camera is not None else ():
            usual = _cells_of(field, np.asarray(getattr(camera, field.name), field.dtype))
            every = [usual | {column: row[column] for column in usual if column in row} for row in self._rows]
            is_usual = all(cells == usual for cells in every)
            for row, cells in zip(self._rows, every, strict=True):
                row |= cells
                for column in cells if is_usual else ():
                    del row[column]

    def _path(self, folder: str, frame_id: int, suffix: str) -> pathlib.Path:
        path = self.folder / folder / f"{frame_id:06d}{suffix}"
        path.parent.mkdir(exist_ok=True)
        return path

    def _write_depth(self, frame_id: int, depth_m: np.ndarray, *, exactly: bool) -> None:
        """As centimetres; where these would not give the same numbers again, and that is asked for, as they are."""
        centimetres = encode_depth(depth_m)
        if exactly and not np.array_equal(pictures.decode_depth(centimetres), depth_m):
            self._path("depth", frame_id, ".npz").write_bytes(files.npz_bytes({"depth_m": depth_m}))
        else:
            self._save_png("depth", frame_id, centimetres)

    def _save_png(self, folder: str, frame_id: int, pixels: np.ndarray) -> None:
        Image.fromarray(np.ascontiguousarray(pixels)).save(self._path(folder, frame_id, ".png"), compress_level=1)


def _row(frame: Mapping, where: str) -> dict[str, str]:
    """A line of frames.csv: the columns of the table of fields, and the weather.

    Raises:
      DataError: for a number that its field cannot have.
    """
    row = {name: _cell(frame[name]) for name in (*COLUMNS, *fields.COLUMNS) if name in frame}
    for name, field in fields.FIELDS.items():
        if name in frame and field.columns:
            value = fields.conform(name, frame[name], where)
            if field in cameras.FIELDS and (value[-1] != np.eye(len(value))[-1]).any():
                raise schema.DataError(f"{where}: the last row of {name} is {value[-1].tolist()}, expected 0, ..., 0, "
                                       f"1.")
            row = _cells_of(field, value) | row
    for column, field in fields.COLUMNS.items():
        if column in frame and field.shape:
            frames_table.number(row[column], field, f"{where}: {column}")
    return row


def _cells_of(field: fields.Field, value: np.ndarray) -> dict[str, str]:
    return {column: _cell(cell) for column, cell in zip(field.columns, field.to_cells(value), strict=True)}


def encode_depth(depth_m: np.ndarray) -> np.ndarray:
    """Metres along the optical axis to uint16 centimetres; what is infinite or beyond 655.34 m is sky."""
    centimetres = np.rint(np.where(np.isfinite(depth_m), depth_m, np.inf) / pictures.DEPTH_UNIT_M)
    return np.minimum(centimetres, pictures.DEPTH_SKY).astype(np.uint16)


def _cell(value) -> str:
    """A field of frames.csv; numbers keep all their digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    return str(value) if isinstance(value, np.floating) else repr(float(value))
