"""The table of recorded fields: of each key of schema.RawFrame what it is, what it may be, and where the plain format
keeps it. Readers, the plain writer, packs and the checks of both follow it; tests hold RawFrame and types.Batch to it.
"""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any

import numpy as np

from muvo_jax.config import BIRDS_EYE_CLASSES
from muvo_jax.data.errors import DataError
from muvo_jax.limits import FINITE, Limits, at_least, between

UNKNOWN = 255  # of classes and of occupancy
# What the classes of a plain recording are where it does not name them: the built-in town's.
TOWN_CLASSES = ("sky", "road", "marking", "pavement", "grass", "building", "vegetation", "pole", "vehicle",
                "pedestrian")


@dataclasses.dataclass(frozen=True)
class Field:
    """One recorded field.

    Attributes:
      name: its key in RawFrame.
      dtype, shape: of the array; letters stand for sizes that the recording decides, () is a number.
      unit: "" for none.
      limits: of every number.
      values: the only numbers there are; () for all within the limits.
      finite: whether every number must be; else NaN and infinity say that nothing was measured there.
      is_label: read only where a head learns from it.
      is_sensor: what a model sees; see runs.shared.
      folder, suffixes: of its files in the plain format, the first suffix being the one that is written.
      array: its name inside an NPZ file.
      columns: of frames.csv, in the plain format; of a matrix row by row, without the last row.
      required: whether frames.csv must have them.
    """

    name: str
    dtype: type
    shape: tuple[str | int, ...] = ()
    unit: str = ""
    limits: Limits = FINITE
    values: tuple[int, ...] = ()
    finite: bool = True
    is_label: bool = False
    is_sensor: bool = False
    folder: str = ""
    suffixes: tuple[str, ...] = ()
    array: str = ""
    columns: tuple[str, ...] = ()
    required: bool = False

    def to_cells(self, value: np.ndarray) -> np.ndarray:
        """The numbers of its columns [C]: all of them, but of a matrix not the last row, which is 0 ... 0 1."""
        return np.atleast_1d(value).ravel()[:len(self.columns)]

    def of_cells(self, values: Any) -> Any:
        """The inverse: an array, or a number where the field is one."""
        if not self.shape:
            return self.dtype(values[0])
        shape: Any = self.shape  # () or of numbers: what has columns has no letters
        last_row = np.eye(*shape)[-1] if len(shape) == 2 else ()
        return np.array([*values, *last_row], self.dtype).reshape(shape)


_NO_CLASS = f", {UNKNOWN} where the class is unknown"
# What whoever writes numbers of another type may not know.
_WIDTH_HINTS = {"image": " (a picture of more bits keeps its highest eight)", "image_classes": _NO_CLASS,
                "point_classes": _NO_CLASS}


def _matrix(name: str, rows: int, columns: int) -> tuple[str, ...]:
    return tuple(f"{name}_{row}{column}" for row in range(1, rows + 1) for column in range(1, columns + 1))


_COMMAND = between(0, 5)
_TARGET_M = between(-1e5, 1e5, "m")
_IMAGES = (".png", ".jpg", ".jpeg")
TABLE = (
    Field("image", np.uint8, ("H", "W", 3), is_sensor=True, folder="image", suffixes=_IMAGES),
    # In frames.csv where a frame's are others than the description's.
    Field("intrinsics", np.float32, (3, 3), "px", columns=_matrix("intrinsics", 2, 3)),
    Field("camera_to_ego", np.float32, (4, 4), "m", columns=_matrix("camera_to_ego", 3, 4)),
    Field("points_m", np.float32, ("N", 3), "m", between(-1e5, 1e5, "m"), finite=False, is_sensor=True,
          folder="lidar", suffixes=(".npz",), array="points_m"),
    Field("occupancy", np.uint8, ("X", "Y", "Z"), values=(0, 1, UNKNOWN), folder="occupancy", suffixes=(".npz",),
          array="occupancy"),
    Field("route_map", np.uint8, (64, 64), folder="route_map", suffixes=(".png",)),
    Field("image_moving_mask", np.bool_, ("H", "W"), values=(0, 1), folder="moving", suffixes=(".npz",),
          array="image_moving_mask"),
    Field("occupancy_moving_mask", np.bool_, ("X", "Y", "Z"), values=(0, 1), folder="moving", suffixes=(".npz",),
          array="occupancy_moving_mask"),
    Field("depth_m", np.float32, ("H", "W"), "m", at_least(0, "m"), finite=False, is_label=True, folder="depth",
          suffixes=(".png", ".npz"), array="depth_m"),
    Field("image_classes", np.uint8, ("H", "W"), is_label=True, folder="classes", suffixes=(".png",)),
    Field("image_instance_mask", np.bool_, ("H", "W"), is_label=True, folder="classes", suffixes=(".png",)),
    Field("point_classes", np.uint8, ("N",), is_label=True, folder="lidar", suffixes=(".npz",), array="point_tags"),
    Field("birds_eye_classes", np.uint8, ("X", "Y"), values=(*range(BIRDS_EYE_CLASSES), UNKNOWN), is_label=True,
          folder="birds_eye", suffixes=(".npz",), array="birds_eye_classes"),
    Field("birds_eye_instances", np.int32, ("X", "Y"), limits=at_least(0), is_label=True, folder="birds_eye",
          suffixes=(".npz",), array="birds_eye_instances"),
    Field("frame_id", np.int64, limits=between(0, 2**63 - 1), columns=("frame_id",), required=True),
    Field("timestamp_s", np.float64, unit="s", columns=("timestamp_s",), required=True),
    Field("speed_mps", np.float32, unit="m/s", limits=between(-100, 150, "m/s"), columns=("speed_mps",),
          required=True),
    # A little beyond 1 is rounding.
    Field("action", np.float32, (2,), limits=between(-1.001, 1.001), columns=("acceleration", "steering"),
          required=True),
    Field("reward", np.float32, limits=between(-1e9, 1e9), columns=("reward",)),
    Field("is_terminal", np.bool_, values=(0, 1), columns=("is_terminal",)),
    Field("pose", np.float64, (3,), "m and rad", columns=("x_m", "y_m", "yaw_rad")),
    Field("yaw_rate_radps", np.float32, unit="rad/s", limits=between(-20, 20, "rad/s"), columns=("yaw_rate_radps",)),
    Field("command", np.int32, limits=_COMMAND, columns=("command",)),
    Field("next_command", np.int32, limits=_COMMAND, columns=("next_command",)),
    Field("target_m", np.float32, (2,), "m", _TARGET_M, columns=("target_x_m", "target_y_m")),
    Field("next_target_m", np.float32, (2,), "m", _TARGET_M, columns=("next_target_x_m", "next_target_y_m")),
)
FIELDS = {field.name: field for field in TABLE}
LABELS = frozenset(field.name for field in TABLE if field.is_label)
SENSORS = frozenset(field.name for field in TABLE if field.is_sensor)
# Column of frames.csv -> its field.
COLUMNS = {column: field for field in TABLE for column in field.columns}


def conform(name: str, values: Any, where: str, shape: tuple[int | None, ...] | None = None) -> np.ndarray:
    """The values as the table has them: its dtype, without a number that the field cannot have.

    Args:
      name: of the field.
      values: what was found.
      where: the file or frame, for messages.
      shape: what the recording's description says; None is any. By default only the number of axes counts.

    Raises:
      DataError: naming `where`, field, what came and what was expected.
    """
    field, array = FIELDS[name], np.asarray(values)
    wanted = tuple(None if isinstance(size, str) else size for size in field.shape) if shape is None else shape
    check_shape(name, array.shape, wanted, where)
    whole = np.issubdtype(field.dtype, np.integer) or field.dtype is np.bool_
    if array.dtype.kind not in ("biu" if whole else "f" if field.folder else "fiu"):
        raise DataError(f"{where}: {name} holds {array.dtype}, expected {np.dtype(field.dtype).name}"
                        f"{f' in {field.unit}' if field.unit else ''}. Write it with that type and unit.")
    _check_range(field, array, where)
    _check_width(field, array, where)
    return array.astype(field.dtype, copy=False)


def check_shape(name: str, shape: tuple[int, ...], wanted: tuple[int | None, ...], where: str) -> None:
    """Raises DataError where a field has another shape; None is any size."""
    if len(shape) != len(wanted) or any(want not in (None, size) for want, size in zip(wanted, shape, strict=True)):
        raise DataError(f"{where}: shape {list(shape)} of {name}, expected "
                        f"{['any' if size is None else size for size in wanted]}. Do not mix recordings of different "
                        f"settings in one folder.")


def _check_range(field: Field, array: np.ndarray, where: str) -> None:
    """Raises DataError where a number is none that the field can have."""
    if not array.size or (field.limits is FINITE and not field.values and array.dtype.kind != "f") or (
            array.dtype.kind == "b" and field.dtype is np.bool_):
        return
    if not field.finite and not np.isfinite([array.max(), array.min()]).all():
        array = array[np.isfinite(array) | ((array == -np.inf) & (field.limits.lowest >= 0))]
    if field.values:
        wrong = ~np.isin(array, field.values)
        expected = f"one of {', '.join(map(str, field.values))}"
    else:
        low, high = field.limits.lowest, field.limits.highest
        if array.size and low <= array.min() and array.max() <= high and np.isfinite(array.max()):  # false for NaN
            return
        wrong = ~((array >= low) & (array <= high) & np.isfinite(array))
        expected = f"numbers {field.limits}"
    if wrong.any():
        raise DataError(f"{where}: {field.name} has {int(wrong.sum())} of {array.size} values such as "
                        f"{array[wrong].ravel()[0]}; expected {expected}. Correct them, or leave the field out.")


def _check_width(field: Field, array: np.ndarray, where: str) -> None:
    """Raises DataError where a whole number does not fit into the field's type: astype would make another one of it."""
    dtype: np.dtype[Any] = np.dtype(field.dtype)
    if dtype.kind not in "iu" or array.dtype == dtype or not array.size:
        return
    low, high = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    ends = [end for end in (int(array.min()), int(array.max())) if not low <= end <= high]
    if ends:
        raise DataError(f"{where}: {field.name} holds {ends[0]} as {array.dtype}, expected {dtype.name}, {low} to "
                        f"{high}{_WIDTH_HINTS.get(field.name, '')}. Bring the numbers into that range, or leave the "
                        f"field out.")


def check_classes(name: str, classes: np.ndarray, names: tuple[str, ...], where: str) -> None:
    """Raises DataError where a class has no name: the recording means other classes than it says."""
    known = classes[classes != UNKNOWN]
    if known.size and known.max() >= len(names):
        raise DataError(f"{where}: {name} has the class {int(known.max())}, but the recording names only {len(names)} "
                        f"({', '.join(names)}). Name all of them, in their order, as classes = [...] in the "
                        f"description.")


def unknown(names: Any, known: Any, what: str) -> None:
    """Raises ValueError where one of `names` is not known, with the nearest that is."""
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(str(name), list(known), n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ValueError(f"{what}: {name!r} is unknown; known are {', '.join(sorted(known))}.{hint}")
