"""What a recording is, whatever its format: a description, gap-free sequences and raw frames.

A reader (plain/reader.py and its like) turns a folder into a `Recording`; prepare.py turns raw frames into what the
model eats; pipeline.py cuts windows. Ego frame and time convention: muvo_jax.types.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Collection
from typing import Annotated, Protocol, TypedDict, runtime_checkable

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import geometry
from muvo_jax.data.errors import DataError, DataWarning
from muvo_jax.data.fields import FIELDS, LABELS
from muvo_jax.limits import RangeError, between, check
from muvo_jax.ops import camera as camera_ops

__all__ = ["INSTANCE_CLASSES", "LABELS", "Camera", "DataError", "DataWarning", "ListsFiles", "RawFrame", "ReadsFields",
           "Recording", "RecordingDescription", "Sequence", "instance_mask"]

_SIDE_PX = between(1, 100_000, "px")
_RIGID = 0.02  # calibrations are printed with a few digits
_FOCAL_SIDES = between(0.01, 60)  # fields of view of 178 degrees to 1
_CENTRE_SIDES = between(-2, 3)
INSTANCE_CLASSES = ("vehicle", "pedestrian")  # what image_instance_mask shows, by the names of a recording's classes


class RawFrame(TypedDict, total=False):
    """One frame as recorded. A modality that the recording lacks has no key.

    Keys:
      image: uint8 [H, W, 3], RGB.
      intrinsics: float32 [3, 3], of `image`.
      camera_to_ego: float32 [4, 4].
      points_m: float32 [N, 3], ego frame.
      occupancy: uint8 [X, Y, Z], 0 empty, 1 occupied, 255 unknown, in the grid `RecordingDescription.voxels`.
      route_map: uint8 [64, 64].
      image_moving_mask: bool [H, W] and occupancy_moving_mask: bool [X, Y, Z], where road users on the move are.
      depth_m: float32 [H, W], along the optical axis, infinite in the sky; image_classes: uint8 [H, W], index into
        RecordingDescription.classes; image_instance_mask: bool [H, W], where these are INSTANCE_CLASSES;
        point_classes: uint8 [N], of points_m; birds_eye_classes: uint8 [X, Y] and birds_eye_instances: int32 [X, Y],
        on the ground plan of the voxels (muvo_jax.types.Batch). Only if asked for.
      action: float32 [2], applied from this frame to the next.
      speed_mps, reward, is_terminal, timestamp_s: scalars.
      command, next_command: int32 scalars, 0 to 5; target_m, next_target_m: float32 [2] (muvo_jax.types.Batch).
      pose: float64 [3], x, y (m) and yaw (rad) of the ego in a frame that stands still during the run.
      yaw_rate_radps: measured, left positive; for checks, no model sees it.
      frame_id: the recording's own number.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    camera_to_ego: np.ndarray
    points_m: np.ndarray
    occupancy: np.ndarray
    route_map: np.ndarray
    image_moving_mask: np.ndarray
    occupancy_moving_mask: np.ndarray
    depth_m: np.ndarray
    image_classes: np.ndarray
    image_instance_mask: np.ndarray
    point_classes: np.ndarray
    birds_eye_classes: np.ndarray
    birds_eye_instances: np.ndarray
    speed_mps: np.float32
    pose: np.ndarray
    yaw_rate_radps: np.float32
    command: np.int32
    next_command: np.int32
    target_m: np.ndarray
    next_target_m: np.ndarray
    action: np.ndarray
    reward: np.float32
    is_terminal: np.bool_
    timestamp_s: np.float64
    frame_id: np.int64


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion: x right, y down, z forward.

    Attributes:
      width_px, height_px: size of the recorded image.
      intrinsics: 3x3 rows, pixels.
      camera_to_ego: 4x4 rows, metres.
    """

    width_px: Annotated[int, _SIDE_PX]
    height_px: Annotated[int, _SIDE_PX]
    intrinsics: tuple[tuple[float, ...], ...]
    camera_to_ego: tuple[tuple[float, ...], ...]

    def __post_init__(self):
        check(self)
        self._check_intrinsics()
        pose = self._matrix("camera_to_ego", 4)
        turn = pose[:3, :3]
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 0 or np.abs(turn @ turn.T - np.eye(3)).max() > _RIGID or (
                np.linalg.det(turn) < 0):
            raise RangeError("Camera", "camera_to_ego", f"is {self.camera_to_ego}; it must be a rotation and a place "
                                                        f"(m) in the ego frame, with the last row 0, 0, 0, 1.")
        if not all(geometry.MOUNTING_M.holds(value) for value in pose[:3, 3]):
            raise RangeError("Camera", "camera_to_ego", f"puts the camera at {pose[:3, 3].tolist()}; each coordinate "
                                                        f"must be {geometry.MOUNTING_M}.")

    def _check_intrinsics(self):
        matrix = self._matrix("intrinsics", 3)
        if matrix[2].tolist() != [0, 0, 1] or matrix[1, 0] != 0:
            raise RangeError("Camera", "intrinsics", f"are {self.intrinsics}; expected [[fx, skew, cx], [0, fy, cy], "
                                                     f"[0, 0, 1]] in pixels.")
        for name, value, side_px in (("fx", matrix[0, 0], self.width_px), ("fy", matrix[1, 1], self.height_px)):
            if not _FOCAL_SIDES.holds(value / side_px):
                raise RangeError("Camera", "intrinsics", f"have {name} = {value:g} for {side_px} pixels; a focal "
                                                         f"length must be {_FOCAL_SIDES} times that, in pixels.")
        for name, value, side_px in (("cx", matrix[0, 2], self.width_px), ("cy", matrix[1, 2], self.height_px)):
            if not _CENTRE_SIDES.holds(value / side_px):
                raise RangeError("Camera", "intrinsics", f"have {name} = {value:g} for {side_px} pixels; the middle "
                                                         f"must be {_CENTRE_SIDES} times that, in pixels.")

    def _matrix(self, name: str, size: int) -> np.ndarray:
        rows = getattr(self, name)
        if [len(row) for row in rows] != [size] * size:
            raise RangeError("Camera", name, f": got {rows}, expected {size} rows of {size} numbers.")
        return np.asarray(rows, np.float64)

    @classmethod
    def of(cls, width_px: int, height_px: int, intrinsics: np.ndarray, camera_to_ego: np.ndarray) -> Camera:
        """From arrays [3, 3] and [4, 4]."""
        return cls(width_px, height_px, tuple(map(tuple, intrinsics.tolist())),
                   tuple(map(tuple, camera_to_ego.tolist())))

    @classmethod
    def level(cls, width_px: int, height_px: int, fov_rad: float, position_m: tuple[float, float, float]) -> Camera:
        """One that looks straight ahead from a place in the ego frame; the field of view is the horizontal one."""
        return cls.of(width_px, height_px, camera_ops.intrinsics_from_fov(width_px, height_px, fov_rad),
                      camera_ops.level_camera_to_ego(position_m))


@dataclasses.dataclass(frozen=True)
class Sequence:
    """A run of consecutive frames without a gap, a restart or a change of split; windows stay inside one.

    Attributes:
      split: "train", "val", "val_rl" or "val_ds".
      name: the run it comes from.
      start: index within the run of its first frame.
      length: number of frames.
      lacks: keys of RawFrame that the recording has but these frames have not; a model that needs one of them passes
        the sequence over.
    """

    split: str
    name: str
    start: int
    length: int
    lacks: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "lacks", tuple(self.lacks))  # JSON has lists

    def has(self, fields: Collection[str]) -> bool:
        """Whether its frames have all of these fields, as far as the recording has them."""
        return set(fields).isdisjoint(self.lacks)


@dataclasses.dataclass(frozen=True)
class RecordingDescription:
    """What holds for all of a recording.

    Attributes:
      name, kind: what it is called, and the format it was recognised as.
      rate_hz: recorded frames per second.
      camera: None without images.
      lidar: field of view and mounting, with the sensor's own rows and columns; None without points.
      voxels: the grid of stored occupancy; None where none is stored.
      contract: what an action means.
      modalities: the keys of RawFrame that frames have, but for what their sequence lacks.
      splits: in the order in which they should be reported.
      notes: sentences that whoever starts a run should read.
      classes: names of image_classes and point_classes, in order; empty where the recording has neither.
      route_map: scale of its route maps; None without them.
    """

    name: str
    kind: str
    rate_hz: float
    camera: Camera | None
    lidar: config_lib.RangeViewGeometry | None
    voxels: config_lib.VoxelGrid | None
    contract: config_lib.ActionContract
    modalities: frozenset[str]
    splits: tuple[str, ...]
    notes: tuple[str, ...] = ()
    classes: tuple[str, ...] = ()
    route_map: config_lib.RouteMap | None = None

    def shape_of(self, name: str) -> tuple[int | None, ...]:
        """See the function `shape_of`."""
        return shape_of(name, self.camera, self.voxels)


def shape_of(name: str, camera: Camera | None, voxels: config_lib.VoxelGrid | None) -> tuple[int | None, ...]:
    """Of a recorded field, as camera and voxels say it; None where they do not."""
    sizes: dict[str, int] = {}
    if camera is not None:
        sizes |= {"H": camera.height_px, "W": camera.width_px}
    if voxels is not None:
        sizes |= dict(zip("XYZ", voxels.shape, strict=True))
    return tuple(sizes.get(size) if isinstance(size, str) else size for size in FIELDS[name].shape)


class Recording(Protocol):
    """What a reader offers. `read` is called from several threads at once."""

    @property
    def description(self) -> RecordingDescription: ...

    @property
    def sequences(self) -> tuple[Sequence, ...]: ...

    def read(self, sequence: Sequence, index: int) -> RawFrame:
        """Returns frame `index` (0 is the first) of `sequence`.

        Raises:
          DataError: naming the file that is missing, truncated or of another shape than the rest.
        """
        ...

    def action(self, sequence: Sequence, index: int) -> np.ndarray:
        """Returns the action of that frame alone, float32 [2], opening as little of the frame as can be.

        Raises:
          DataError: as `read`.
        """
        ...


@runtime_checkable
class ReadsFields(Protocol):
    """A reader that opens no more of a frame than is asked for."""

    def read_fields(self, sequence: Sequence, index: int, names: Collection[str]) -> RawFrame:
        """Returns of a frame the fields of these names that it has, and those that come with them.

        Raises:
          DataError: as Recording.read.
        """
        ...


@runtime_checkable
class ListsFiles(Protocol):
    """A reader of a format that keeps the files of all runs together, so that it alone knows which are whose."""

    def run_files(self, name: str) -> list[pathlib.Path]:
        """Returns the files that the frames of a run are made of, in a fixed order."""
        ...


def instance_mask(classes: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """bool [...], where `classes`, indices into `names`, show INSTANCE_CLASSES."""
    return np.isin(classes, [index for index, name in enumerate(names) if name in INSTANCE_CLASSES])
