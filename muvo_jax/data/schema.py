"""What a recording is, whatever its format: a description, gap-free sequences and raw frames.

A reader (plain.py, kitti.py) turns a folder into a `Recording`; prepare.py turns raw frames into what the model eats;
pipeline.py cuts windows. Ego frame and time convention: muvo_jax.types.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, TypedDict

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.ops import camera as camera_ops

# Keys of RawFrame that a reader fills only where `labels` names them: they cost time, and few models learn from them.
LABELS = frozenset({"depth_m", "image_classes", "image_instance_mask", "point_classes", "birds_eye_classes",
                    "birds_eye_instances"})
INSTANCE_CLASSES = ("vehicle", "pedestrian")  # what image_instance_mask shows, by the names of a recording's classes


class DataError(ValueError):
    """Recorded data that cannot be used; the message names the file, what was expected and how to go on."""


class DataWarning(UserWarning):
    """Recorded data that can be used in part; the message counts what is left out."""


class RawFrame(TypedDict, total=False):
    """One frame as recorded. A modality that the recording lacks has no key.

    Keys:
      image: uint8 [H, W, 3], RGB.
      intrinsics: float32 [3, 3], of `image`.
      camera_to_ego: float32 [4, 4].
      points_m: float32 [N, 3], ego frame.
      occupancy: uint8 [X, Y, Z], 0 empty, 1 occupied, 255 unknown, in the grid `RecordingDescription.voxels`.
      route_map: uint8 [64, 64].
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

    width_px: int
    height_px: int
    intrinsics: tuple[tuple[float, ...], ...]
    camera_to_ego: tuple[tuple[float, ...], ...]

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
    """

    split: str
    name: str
    start: int
    length: int


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
      modalities: the keys of RawFrame that every frame has.
      splits: in the order in which they should be reported.
      notes: sentences that whoever starts a run should read.
      classes: names of image_classes and point_classes, in order; empty where the recording has neither.
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


def instance_mask(classes: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """bool [...], where `classes`, indices into `names`, show INSTANCE_CLASSES."""
    return np.isin(classes, [index for index, name in enumerate(names) if name in INSTANCE_CLASSES])


def longest(sequences: tuple[Sequence, ...], split: str) -> int:
    """Frames in the longest sequence of a split, 0 where it has none."""
    return max((sequence.length for sequence in sequences if sequence.split == split), default=0)
