"""From a recording's raw frames to what the model eats, and from a preset to what the recording offers.

Images are scaled by width and cropped at the bottom; the range view has the preset's size and the recorded lidar's
field of view and mounting; occupancy is the recorded one or, where none is recorded, what the frame's own scan hit
(occupied) and looked through (empty), everything else unknown.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import schema
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops
from muvo_jax.ops import voxels as voxel_ops

SHORT_RECORDING_FRAMES = 100
# What a short recording is cut into: 0.4 s observed and 0.4 s imagined at 10 Hz.
_SHORT = {"stride": 1, "context": 4, "horizon": 4, "frames": 8}
_SIDE_MULTIPLE = 32
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


class Adapted(NamedTuple):
    """A config that fits a recording.

    Attributes:
      config: the config.
      notes: sentences about what was changed and why, for whoever starts the run.
    """

    config: config_lib.Config
    notes: tuple[str, ...]


def adapt(config: config_lib.Config, recording: schema.Recording, *, keep: Collection[str] = ()) -> Adapted:
    """Fits a config to a recording: sensor geometry, action contract, heads, inputs and window lengths.

    Adapting twice changes nothing more.

    Args:
      keep: dotted names, such as "data.stride", that the user chose; they are left alone.

    Raises:
      DataError: where the recording lacks what every model needs (actions, and camera or lidar), its voxel grid
        does not suit the voxel decoder, or its sequences are shorter than a window.
    """
    description = recording.description
    notes: list[str] = []
    contract = dataclasses.replace(description.contract, step_action=config.contract.step_action)
    model = _fit_first_guess(_fit_model(config.model, description, notes), description, keep, notes)
    needs = needed(dataclasses.replace(config, model=model, contract=contract), description.modalities)
    data = _fit_windows(config.data, recording, keep, needs, notes)
    if description.route_map is not None:
        data = dataclasses.replace(data, route_map=description.route_map)
    train = config.train
    if train.observe_frames > data.context and "train.observe_frames" not in keep:  # as many as evaluation observes
        train = dataclasses.replace(train, observe_frames=data.context)
    return Adapted(dataclasses.replace(config, model=model, data=data, train=train, contract=contract), tuple(notes))


def prepare_frame(raw: schema.RawFrame, config: config_lib.Config) -> PreparedFrame:
    """Returns the arrays of one frame by their names in types.Batch, plus timestamp_s and frame_id for the host.

    Args:
      raw: one frame of the recording that `config` was adapted to.

    Raises:
      DataError: where the frame does not fit the config, naming frame and field.
    """
    model = config.model
    lacking = sorted(needed(config, raw.keys()) - raw.keys())
    if lacking:
        raise schema.DataError(f"frame {int(raw['frame_id'])} has no {', '.join(lacking)}, which the model needs. "
                               f"Choose windows of sequences that have it (schema.Sequence.has).")
    ready: PreparedFrame = {name: raw[name] for name in ("action", "timestamp_s", "frame_id")}
    try:
        if model.camera is not None or "image" in config.targets:
            ready["image"], ready["intrinsics"] = camera_ops.resize_crop(raw["image"], raw["intrinsics"],
                                                                         model.image_size)
            ready["camera_to_ego"] = raw["camera_to_ego"]
        if model.lidar is not None or "range_view" in config.targets:
            ready["range_view"] = range_view_ops.project(raw["points_m"], model.range_view)
        if "occupancy" in model.heads:
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
    for name in ("reward", "is_terminal", *(config.targets.keys() - _ALWAYS_THERE - _MADE_OF.keys())):
        if name in raw:
            ready[name] = raw[name]  # type: ignore[literal-required]
    if "pose" in raw and "speed_mps" in raw:  # still in the frame of the run: motion begins with a second frame
        ready["ego_motion"] = np.array([*raw["pose"], raw["speed_mps"]])
    return ready | _moving(raw, ready, config) | _labels(raw, config)


def judged_only(config: config_lib.Config) -> frozenset[str]:
    """The fields of a prepared frame that scores read and training does not, as far as a recording has them."""
    return _JUDGED - config.targets.keys()


def _moving(raw: schema.RawFrame, ready: PreparedFrame, config: config_lib.Config) -> PreparedFrame:
    """Where road users on the move are, for the modalities that the frame has."""
    masks: PreparedFrame = {}
    if "image_moving_mask" in raw and "image" in ready:
        masks["image_moving_mask"] = camera_ops.resize_crop_nearest(raw["image_moving_mask"], config.model.image_size)
    if "occupancy_moving_mask" in raw and "occupancy" in ready:
        masks["occupancy_moving_mask"] = raw["occupancy_moving_mask"]
    return masks


def _labels(raw: schema.RawFrame, config: config_lib.Config) -> PreparedFrame:
    """Targets that must be brought to the model's sizes, as far as the frame has them."""
    ready: PreparedFrame = {}
    model, targets = config.model, config.targets
    if "depth_m" in raw and "depth_m" in targets:
        depth_m = camera_ops.resize_crop_nearest(raw["depth_m"], model.image_size)
        ready["depth_m"] = np.where(depth_m < DEPTH_LIMIT_M, depth_m, range_view_ops.NO_RETURN_M).astype(np.float32)
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
    model, targets = config.model, config.targets
    names = {"action", "timestamp_s", "frame_id"} | (_recorded(targets) - _OPTIONAL)
    if model.camera is not None or "image" in targets:
        names |= {"image", "intrinsics", "camera_to_ego"}
    if model.lidar is not None or "range_view" in targets:
        names.add("points_m")
    if "occupancy" in model.heads:
        names.add("occupancy" if "occupancy" in modalities else "points_m")
    names |= set(NAVIGATION) if model.navigation else set()
    speed = model.speed or (model.tracks_motion and model.kinematics is not None)
    names |= {name for name, wanted in (("route_map", model.route), ("speed_mps", speed)) if wanted}
    return frozenset(names)


def labels(config: config_lib.Config) -> frozenset[str]:
    """Which of schema.LABELS the heads of a model learn from."""
    return schema.LABELS & _recorded(config.targets)


def _recorded(targets: Collection[str]) -> frozenset[str]:
    """The keys of RawFrame that these targets are made of, without those that every recording has."""
    return frozenset().union(*(_MADE_OF.get(field, {field}) for field in targets)) - _ALWAYS_THERE


def check_targets(config: config_lib.Config, description: schema.RecordingDescription) -> None:
    """Raises DataError where a head or term cannot be trained: names it, what the recording lacks, and the way out."""
    for head in config.model.heads:
        fields = config_lib.head_targets(head, config.model, config.loss)
        for field in sorted(_recorded(fields) - description.modalities):
            if field in config_lib.TERM_TARGETS:
                weight = config_lib.TERM_TARGETS[field].weight
                raise schema.DataError(f"loss.{weight} is on and learns from {field}, which recording "
                                       f"{description.name!r} does not hold. Leave the term out (--set "
                                       f"loss.{weight}=0), or record what it takes (docs/variants.md).")
            others = ",".join(name for name in config.model.heads if name != head)
            raise schema.DataError(f"head {head!r} learns from {field}, which recording {description.name!r} does not "
                                   f"hold. Leave the head out (--heads={others}), or record {field}.")


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


def _fit_model(model: config_lib.ModelConfig, description: schema.RecordingDescription,
               notes: list[str]) -> config_lib.ModelConfig:
    model = _without_what_lacks(model, description, notes)
    camera, lidar, heads = description.camera, description.lidar, model.heads
    changes: dict = {}
    if camera is not None and "image" in description.modalities:
        changes["image_size"] = _image_size(camera, model.image_size[1])
        if changes["image_size"] != model.image_size:
            notes.append(f"images of {camera.width_px}x{camera.height_px} pixels become {changes['image_size'][1]}x"
                         f"{changes['image_size'][0]}: scaled by width, rows cut off at the top.")
    if lidar is not None:
        changes["range_view"] = dataclasses.replace(lidar, rows=model.range_view.rows, columns=model.range_view.columns)
    if description.voxels is not None and "occupancy" in heads:
        changes["voxels"] = description.voxels
        if isinstance(model.latent, config_lib.VectorLatent):
            changes["latent"] = _fit_voxel_decoder(model.latent, description.voxels, notes)
    elif "occupancy" in heads:
        notes.append("no occupancy is recorded: the target is what each lidar scan hit and looked through, unknown "
                     "elsewhere.")
    if description.classes:
        changes["semantic_classes"] = len(description.classes)
    if model.route and "route_map" not in description.modalities:
        changes["route"] = False
        notes.append("no route map is recorded: the model has no route input.")
    if model.speed and "speed_mps" not in description.modalities:
        changes["speed"] = False
        notes.append("no speed is recorded: the model has no speed input.")
    if model.navigation and not description.modalities.issuperset(NAVIGATION):
        changes["navigation"] = False
        notes.append("no navigation commands are recorded: the model has no such input.")
    return dataclasses.replace(model, **changes)


def _fit_first_guess(model: config_lib.ModelConfig, description: schema.RecordingDescription, keep: Collection[str],
                     notes: list[str]) -> config_lib.ModelConfig:
    """The model without a memory where the recording does not say how the car moves, or nothing has ranges.

    Raises:
      DataError: where the user asked for the memory.
    """
    if not isinstance(model.first_guess, config_lib.LastSeen):
        return model
    reason = ""
    if model.lidar is None:
        reason = "there are no lidar scans, and nothing moves without ranges"
    elif description.contract.kinematics == "bicycle":
        if "speed_mps" not in description.modalities:
            reason = "no speed is recorded, from which actions would move the car"
    elif "ego_motion" not in model.heads:
        reason = ("its actions do not say how the car moves (kinematics \"none\"); add --with-heads=ego_motion, which "
                  "learns it from recorded poses")
    if not reason:
        return model
    if any(name.startswith("model.first_guess") for name in keep):
        raise schema.DataError(f"model.first_guess=last_seen with recording {description.name!r}: {reason}. Choose "
                               f"model.first_guess=training_mean otherwise.")
    notes.append(f"what was last seen is not moved, because {reason}: decoders start from the training mean.")
    return dataclasses.replace(model, first_guess=config_lib.TrainingMean())


def _without_what_lacks(model: config_lib.ModelConfig, description: schema.RecordingDescription,
                        notes: list[str]) -> config_lib.ModelConfig:
    """The model without input and heads of a sensor that the recording lacks.

    Raises:
      DataError: where that leaves nothing to see or to predict.
    """
    missing = set()
    for sensor, field, described in (("camera", "image", description.camera), ("lidar", "points_m", description.lidar)):
        if described is None or field not in description.modalities:
            missing.add(sensor)
    if len(missing) == 2 or "action" not in description.modalities:
        raise schema.DataError(f"recording {description.name!r} holds {', '.join(sorted(description.modalities))}; "
                               f"every model needs actions and, with their sensor's description, images or lidar "
                               f"scans. Record these too.")
    heads = {"image"} & set(model.heads) if "camera" in missing else set()
    if "lidar" in missing:
        without = {"range_view"} if "occupancy" in description.modalities else {"range_view", "occupancy"}
        heads |= without & set(model.heads)
    for sensor in sorted(missing):
        which = f" and no head {', '.join(sorted(heads))}" if heads else ""
        notes.append(f"no {'images are' if sensor == 'camera' else 'lidar scans are'} recorded: the model has no "
                     f"{sensor} input{which}.")
    kept = tuple(head for head in model.heads if head not in heads)
    seen = {sensor for sensor in ("camera", "lidar") if getattr(model, sensor) is not None} - missing
    if not seen or not kept:
        raise schema.DataError(f"recording {description.name!r} lacks {', '.join(sorted(missing))}: nothing is left to "
                               f"{'see' if not seen else 'predict'} for the model {model.variant} with the heads "
                               f"{', '.join(model.heads)}. Choose other ones.")
    changes: dict = dict.fromkeys(missing)
    return dataclasses.replace(model, heads=kept, **changes)


def _image_size(camera: schema.Camera, columns: int) -> tuple[int, int]:
    """The preset's width and the largest multiple of 32 rows that the scaled image has; wider where it has no 32."""
    while round(camera.height_px * columns / camera.width_px) < _SIDE_MULTIPLE:
        columns += _SIDE_MULTIPLE
    rows = round(camera.height_px * columns / camera.width_px)
    return rows // _SIDE_MULTIPLE * _SIDE_MULTIPLE, columns


def _fit_voxel_decoder(latent: config_lib.VectorLatent, grid: config_lib.VoxelGrid,
                       notes: list[str]) -> config_lib.VectorLatent:
    """With the most full-width decoder stages, up to those it has, that halve down to whole voxels."""
    for blocks in range(latent.occupancy_blocks, -1, -1):
        if all(side % 2 ** (blocks + 3) == 0 for side in grid.shape):
            if blocks != latent.occupancy_blocks:
                notes.append(f"the voxel decoder has {blocks} full-width stages instead of {latent.occupancy_blocks}: "
                             f"the recorded grid is only {_by(grid.shape)}.")
            return dataclasses.replace(latent, occupancy_blocks=blocks)
    raise schema.DataError(f"the recorded voxel grid of {_by(grid.shape)} does not suit the voxel decoder: each "
                           f"side must be a multiple of 8. Record another grid, or leave the occupancy head out.")


def _by(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))


def _fit_windows(data: config_lib.DataConfig, recording: schema.Recording, keep: Collection[str],
                 needs: Collection[str], notes: list[str]) -> config_lib.DataConfig:
    lengths = {split: schema.longest(recording.sequences, split, needs) for split in recording.description.splits}
    if lengths.get("train", 0) < SHORT_RECORDING_FRAMES and _too_long(data, lengths):
        changes: dict = {name: value for name, value in _SHORT.items() if f"data.{name}" not in keep}
        data = dataclasses.replace(data, **changes)
        notes.append(f"short recording (longest training sequence: {lengths.get('train', 0)} frames): "
                     f"stride {data.stride}, context {data.context}, horizon {data.horizon}, {data.frames} frames to "
                     f"train on.")
    split = _too_long(data, lengths)
    if split:
        frames = data.frames if split == "train" else data.context + data.horizon
        raise too_short(recording, split, frames, data.stride, needs)
    return data


def _too_long(data: config_lib.DataConfig, lengths: dict[str, int]) -> str | None:
    """The first split whose longest sequence is shorter than a window."""
    for split, length in lengths.items():
        frames = data.frames if split == "train" else data.context + data.horizon
        if length < span(frames, data.stride):
            return split
    return None


def span(frames: int, stride: int) -> int:
    """Recorded frames from the first to the last of a window."""
    return (frames - 1) * stride + 1


def too_short(recording: schema.Recording, split: str, frames: int, stride: int,
              needs: Collection[str] = ()) -> schema.DataError:
    """The error for a split without a single window of frames that have what is needed; names both lengths."""
    found = schema.longest(recording.sequences, split, needs)
    every = schema.longest(recording.sequences, split)
    start = f"recording {recording.description.name!r}: the longest gap-free sequence of split {split!r}"
    if every >= span(frames, stride) > found:
        lacking = sorted({name for sequence in recording.sequences if sequence.split == split
                          for name in sequence.lacks if name in needs})
        return schema.DataError(f"{start} that has {', '.join(lacking)} has {found} frames, but a window needs "
                                f"{span(frames, stride)}. Record these for that split too, or train a model that does "
                                f"not need them.")
    return schema.DataError(f"{start} has {found} frames, but a window of {frames} frames at stride {stride} needs "
                            f"{span(frames, stride)}. Choose fewer frames (data.frames, data.context, data.horizon) or "
                            f"a smaller data.stride, or record longer runs.")
