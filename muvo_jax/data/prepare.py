"""From a recording's raw frames to what the model eats; fitting.py fits the model to the recording before.

Images are scaled by width and cropped at the bottom; the range view has the preset's size and the recorded lidar's
field of view and mounting; occupancy is the recorded one or, where none is recorded, what the frame's own scan hit
(occupied) and looked through (empty), everything else unknown.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax.data import schema
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops
from muvo_jax.ops import voxels as voxel_ops

# Targets that every recording has, or that are made of what it has; the others it must hold itself.
_ALWAYS_THERE = frozenset({"image", "range_view", "occupancy", "action"})
# Targets that are made of other fields of a frame, or brought to the model's size.
_MADE_OF = {"ego_motion": frozenset({"pose", "speed_mps"}), "range_view_classes": frozenset({"point_classes"}),
            "depth_m": frozenset({"depth_m"}), "image_classes": frozenset({"image_classes"}),
            "image_instance_mask": frozenset({"image_instance_mask"})}
_JUDGED = frozenset({"ego_motion", "image_moving_mask", "occupancy_moving_mask"})
DEPTH_LIMIT_M = 100.0  # what is farther counts as nothing
UNLABELLED = 255
# Targets that a batch may lack: heads that learn from them are refused by check_targets.
_OPTIONAL = frozenset({"reward", "is_terminal"})
NAVIGATION = ("command", "next_command", "target_m", "next_target_m")

PreparedFrame = dict[str, np.ndarray | np.generic]  # names and dtypes of types.Batch without B and T


def prepare_frame(raw: schema.RawFrame, config: config_lib.Config) -> PreparedFrame:
    """Returns the arrays of one frame by their names in types.Batch, plus timestamp_s and frame_id for the host.

    Args:
      raw: one frame of the recording that `config` was adapted to.

    Raises:
      DataError: where the frame does not fit the config, naming frame and field.
    """
    model, targets = config.model, head_lib.targets(config)
    lacking = sorted(needed(config, raw.keys()) - raw.keys())
    if lacking:
        raise schema.DataError(f"frame {int(raw['frame_id'])} has no {', '.join(lacking)}, which the model needs. "
                               f"Choose windows of sequences that have it (schema.Sequence.has).")
    ready: PreparedFrame = {name: raw[name] for name in ("timestamp_s", "frame_id")}
    ready["action"] = applied(raw["action"])
    try:
        if model.camera is not None or "image" in targets:
            ready["image"], ready["intrinsics"] = camera_ops.resize_crop(raw["image"], raw["intrinsics"],
                                                                         model.image_size)
            ready["camera_to_ego"] = raw["camera_to_ego"]
        if model.lidar is not None or "range_view" in targets:
            ready["range_view"] = range_view_ops.project(raw["points_m"], model.range_view)
        if "occupancy" in targets:
            ready["occupancy"] = _occupancy(raw, model)
    except ValueError as error:
        raise schema.DataError(f"frame {int(raw['frame_id'])}: {error}") from error
    if isinstance(model.lidar, config_lib.PillarLidar):
        ready["points"], ready["point_count"] = padded_points(raw["points_m"], model.lidar.grid.points,
                                                               int(raw["frame_id"]))
    if model.navigation:
        ready |= {name: raw[name] for name in NAVIGATION}  # type: ignore[literal-required]
    if model.route:
        ready["route_map"] = raw["route_map"]
    if "speed_mps" in raw:
        ready["speed_mps"] = raw["speed_mps"]
    for name in ("reward", "is_terminal", *(targets.keys() - _ALWAYS_THERE - _MADE_OF.keys())):
        if name in raw:
            ready[name] = raw[name]  # type: ignore[literal-required]
    if "pose" in raw and "speed_mps" in raw:  # still in the frame of the run: motion begins with a second frame
        ready["ego_motion"] = np.array([*raw["pose"], raw["speed_mps"]])
    return ready | _moving(raw, ready, config) | _labels(raw, config)


def judged_only(config: config_lib.Config) -> frozenset[str]:
    """The fields of a prepared frame that scores read and training does not, as far as a recording has them."""
    return _JUDGED - head_lib.targets(config).keys()


def read_of(config: config_lib.Config, modalities: Collection[str], *, judged: bool) -> frozenset[str]:
    """The keys of RawFrame that `prepare_frame` looks at; without those of `judged_only` where nobody judges."""
    targets = head_lib.targets(config)
    names = needed(config, modalities) | recorded(targets) | {"reward", "is_terminal", "speed_mps"}
    if "range_view_classes" in targets:
        names |= {"points_m"}
    if judged:
        names |= {"pose", "image_moving_mask", "occupancy_moving_mask"}
    return frozenset(names & set(modalities) | {"action", "timestamp_s", "frame_id"})


def _moving(raw: schema.RawFrame, ready: PreparedFrame, config: config_lib.Config) -> PreparedFrame:
    """Where road users on the move are, for the modalities that the frame has."""
    masks: PreparedFrame = {}
    if "image_moving_mask" in raw and "image" in ready:
        masks["image_moving_mask"] = camera_ops.resize_crop_nearest(raw["image_moving_mask"], config.model.image_size)
    if "occupancy_moving_mask" in raw and "occupancy" in ready:
        masks["occupancy_moving_mask"] = raw["occupancy_moving_mask"]
    return masks


def applied(action: np.ndarray) -> np.ndarray:
    """A recorded action within [-1, 1], as imagination takes it: readers let pass what lies a rounding beyond."""
    return np.clip(action, -1.0, 1.0)


def _labels(raw: schema.RawFrame, config: config_lib.Config) -> PreparedFrame:
    """Targets that must be brought to the model's sizes, as far as the frame has them."""
    ready: PreparedFrame = {}
    model, targets = config.model, head_lib.targets(config)
    if "depth_m" in raw and "depth_m" in targets:
        depth_m = camera_ops.resize_crop_nearest(raw["depth_m"], model.image_size)
        known = (depth_m > 0) & (depth_m < DEPTH_LIMIT_M)
        ready["depth_m"] = np.where(known, depth_m, range_view_ops.NO_RETURN_M).astype(np.float32)
    for name in ("image_classes", "image_instance_mask"):
        if name in raw and name in targets:
            ready[name] = camera_ops.resize_crop_nearest(raw[name], model.image_size)  # type: ignore[literal-required]
    if "point_classes" in raw and "range_view_classes" in targets:
        winner = range_view_ops.nearest_points(raw["points_m"], model.range_view)
        classes = np.append(raw["point_classes"], np.uint8(UNLABELLED))  # where no point is, its number is -1
        ready["range_view_classes"] = classes[winner]
    return ready


def needed(config: config_lib.Config, modalities: Collection[str]) -> frozenset[str]:
    """The keys of RawFrame that `prepare_frame` must find, of a recording with these modalities."""
    model, targets = config.model, head_lib.targets(config)
    names = {"action", "timestamp_s", "frame_id"} | (recorded(targets) - _OPTIONAL)
    if model.camera is not None or "image" in targets:
        names |= {"image", "intrinsics", "camera_to_ego"}
    if model.lidar is not None or "range_view" in targets:
        names.add("points_m")
    if "occupancy" in targets:
        names.add("occupancy" if "occupancy" in modalities else "points_m")
    names |= set(NAVIGATION) if model.navigation else set()
    speed = model.speed or (model.tracks_motion and model.kinematics is not None)
    names |= {name for name, wanted in (("route_map", model.route), ("speed_mps", speed)) if wanted}
    return frozenset(names)


def labels(config: config_lib.Config) -> frozenset[str]:
    """Which of schema.LABELS the heads of a model learn from."""
    return schema.LABELS & recorded(head_lib.targets(config))


def recorded(targets: Collection[str]) -> frozenset[str]:
    """The keys of RawFrame that these targets are made of, without those that every recording has."""
    return frozenset().union(*(_MADE_OF.get(field, {field}) for field in targets)) - _ALWAYS_THERE


def padded_points(points_m: np.ndarray, rows: int, seed: int) -> tuple[np.ndarray, np.int32]:
    """Exactly `rows` points, zeros behind the last one, and how many are real.

    Of a longer scan a random subset stays, the same one each time: its first points would be one side of the world.
    """
    if len(points_m) > rows:
        warnings.warn(f"scans with more than model.lidar.grid.points={rows} points are thinned to a random subset of "
                      f"that size.", schema.DataWarning, stacklevel=2)
        points_m = points_m[np.random.default_rng(seed).choice(len(points_m), rows, replace=False)]
    padded = np.zeros((rows, 3), np.float32)
    padded[:len(points_m)] = points_m
    return padded, np.int32(len(points_m))


def _occupancy(raw: schema.RawFrame, model: config_lib.ModelConfig) -> np.ndarray:
    if "occupancy" not in raw:
        lidar_m = np.array(model.range_view.position_m, np.float32)
        return voxel_ops.occupancy_target(raw["points_m"], lidar_m, model.voxels)
    if raw["occupancy"].shape != model.voxels.shape:
        raise ValueError(f"occupancy has shape {list(raw['occupancy'].shape)}, model.voxels "
                         f"{list(model.voxels.shape)}; adapt the config to the recording first.")
    return raw["occupancy"]
