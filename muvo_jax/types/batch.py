"""What a model is given: windows of observations, and the fields that they have."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import flax.struct
import numpy as np

from muvo_jax.types.arrays import ArrayLike, Indexable


@flax.struct.dataclass
class Batch(Indexable):
    """Windows of consecutive observations, as the sensors gave them (the model normalises).

    A modality that the recording lacks is None, never a zero array.

    Attributes:
      action: float32 [B, T, 2], (acceleration, steering), each in [-1, 1]; steering > 0 is right. Where a step spans
        several recorded frames, the mean of theirs or the first, as config.ActionContract.step_action says.
      is_first: bool [B, T], true at the first step of a window and wherever a recording restarts.
      image: uint8 [B, T, H, W, 3], RGB.
      range_view: float32 [B, T, Hr, Wr, 4], x, y, z (ego frame, m) and range from the lidar (m);
        0, 0, 0 and -1 where nothing returned.
      points: float32 [B, T, N, 3], the scan, ego frame, m; only where PointPillars reads it.
      point_count: int32 [B, T], how many of the N rows are points; the others are ignored.
      occupancy: uint8 [B, T, X, Y, Z], 0 empty, 1 occupied, 255 unknown.
      route_map: uint8 [B, T, 64, 64], planned route from above, 255 on route; row 0 is farthest ahead.
      speed_mps: float32 [B, T].
      command, next_command: int32 [B, T], what the navigation says, 0 to 5, and what it will say then.
      target_m, next_target_m: float32 [B, T, 2], the places that the two commands belong to, seen from the ego.
      depth_m: float32 [B, T, H, W], along the optical axis of `image`; -1 where nothing is near enough to be measured.
      image_classes: uint8 [B, T, H, W], what each pixel shows; 255 unlabelled.
      image_instance_mask: bool [B, T, H, W], whether the pixel shows a vehicle or pedestrian.
      image_moving_mask: bool [B, T, H, W], where road users on the move are; only scores read it.
      occupancy_moving_mask: bool [B, T, X, Y, Z], the same of the voxels.
      range_view_classes: uint8 [B, T, Hr, Wr], what each pixel of `range_view` hit; 255 where nothing returned.
      birds_eye_classes: uint8 [B, T, X, Y], what lies on each cell of the ground plan of `occupancy`; 255 unknown.
      birds_eye_instances: int32 [B, T, X, Y], the vehicle or pedestrian there, numbered from 1 in each frame; 0 none.
      reward: float32 [B, T].
      is_terminal: bool [B, T].
      ego_motion: float32 [B, T, 4], forward and left (m) in the ego frame of the window's frame before, turn to the
        left (rad) since then, and speed (m/s); the first three are meaningless where is_first.
      intrinsics: float32 [B, 3, 3], of the image as it is here, after resizing and cropping.
      camera_to_ego: float32 [B, 4, 4], camera frame (x right, y down, z forward) to ego frame.
    """

    action: ArrayLike
    is_first: ArrayLike
    image: ArrayLike | None = None
    range_view: ArrayLike | None = None
    points: ArrayLike | None = None
    point_count: ArrayLike | None = None
    occupancy: ArrayLike | None = None
    depth_m: ArrayLike | None = None
    image_classes: ArrayLike | None = None
    image_instance_mask: ArrayLike | None = None
    image_moving_mask: ArrayLike | None = None
    occupancy_moving_mask: ArrayLike | None = None
    range_view_classes: ArrayLike | None = None
    birds_eye_classes: ArrayLike | None = None
    birds_eye_instances: ArrayLike | None = None
    route_map: ArrayLike | None = None
    speed_mps: ArrayLike | None = None
    command: ArrayLike | None = None
    next_command: ArrayLike | None = None
    target_m: ArrayLike | None = None
    next_target_m: ArrayLike | None = None
    reward: ArrayLike | None = None
    is_terminal: ArrayLike | None = None
    ego_motion: ArrayLike | None = None
    intrinsics: ArrayLike | None = None
    camera_to_ego: ArrayLike | None = None

    def __getitem__(self, index) -> Batch:
        """`batch[2:4]`, `batch[:, 3:]`: calibration, one for each window, is indexed by the window alone."""
        of_window = index[:1] if isinstance(index, tuple) else index
        chosen = {name: value[of_window if name in UNTIMED_FIELDS else index]
                  for name, value in vars(self).items() if value is not None}
        return dataclasses.replace(self, **chosen)

    @property
    def batch_size(self) -> int:
        return self.action.shape[0]

    @property
    def frames(self) -> int:
        return self.action.shape[1]

    def time_slice(self, start: int, stop: int) -> Batch:
        """The same windows, restricted to frames start..stop-1."""
        return self.map_frames(lambda value: value[:, start:stop])

    def map_frames(self, function: Callable[[ArrayLike], ArrayLike]) -> Batch:
        """Applies `function` to every field with a time axis; calibration has none and stays."""
        timed = {name: function(value) for name, value in vars(self).items()
                 if value is not None and name not in UNTIMED_FIELDS}
        return dataclasses.replace(self, **timed)

    def validate(self) -> Batch:
        """Checks dtypes, ranks, common prefixes and the last axes that are the same everywhere (static under jit).

        Raises:
          ValueError: naming the field, what came and what was expected.
        """
        for name, (dtype, rank) in BATCH_FIELDS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.dtype != dtype or value.ndim != rank:
                raise ValueError(f"Batch.{name}: got {value.dtype}{list(value.shape)}, expected {np.dtype(dtype).name} "
                                 f"with {rank} axes (see muvo_jax.types.Batch).")
            last = LAST_AXES.get(name, ())
            if value.shape[rank - len(last):] != last:
                raise ValueError(f"Batch.{name}: got {list(value.shape)}, expected [..., "
                                 f"{', '.join(map(str, last))}] (see muvo_jax.types.Batch).")
            prefix = 1 if name in UNTIMED_FIELDS else 2
            if value.shape[:prefix] != self.action.shape[:prefix]:
                raise ValueError(f"Batch.{name}: leading axes {value.shape[:prefix]} differ from those of action, "
                                 f"{self.action.shape[:prefix]}.")
        return self


UNTIMED_FIELDS = ("intrinsics", "camera_to_ego")  # one for each window
BATCH_FIELDS = {  # dtype, rank
    "action": (np.float32, 3), "is_first": (np.bool_, 2), "image": (np.uint8, 5), "range_view": (np.float32, 5),
    "points": (np.float32, 4), "point_count": (np.int32, 2), "command": (np.int32, 2), "next_command": (np.int32, 2),
    "target_m": (np.float32, 3), "next_target_m": (np.float32, 3), "occupancy": (np.uint8, 5),
    "route_map": (np.uint8, 4), "speed_mps": (np.float32, 2), "reward": (np.float32, 2),
    "depth_m": (np.float32, 4), "image_classes": (np.uint8, 4), "range_view_classes": (np.uint8, 4),
    "image_instance_mask": (np.bool_, 4), "image_moving_mask": (np.bool_, 4), "occupancy_moving_mask": (np.bool_, 5),
    "birds_eye_classes": (np.uint8, 4), "birds_eye_instances": (np.int32, 4),
    "is_terminal": (np.bool_, 2), "ego_motion": (np.float32, 3), "intrinsics": (np.float32, 3),
    "camera_to_ego": (np.float32, 3),
}
LAST_AXES = {  # where no configuration changes them
    "action": (2,), "image": (3,), "range_view": (4,), "points": (3,), "route_map": (64, 64), "target_m": (2,),
    "next_target_m": (2,), "ego_motion": (4,), "intrinsics": (3, 3), "camera_to_ego": (4, 4),
}
