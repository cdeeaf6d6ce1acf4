"""Fits a config to a recording: sensor geometry, action contract, heads, inputs and window lengths."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax.config import settings
from muvo_jax.data import prepare, schema, sequences, windows

SHORT_RECORDING_FRAMES = 100
# What a short recording is cut into: 0.4 s observed and 0.4 s imagined at 10 Hz.
_SHORT = {"stride": 1, "context": 4, "horizon": 4, "frames": 8}
_SIDE_MULTIPLE = 32
# What a trained network was built with: give it to `adapt` to keep, beside what the user chose.
OF_TRAINED = ("model.range_view.rows", "model.range_view.columns")
# What a recording says of itself: what a user says of it cannot be otherwise.
_RECORDED = ("contract", "data.route_map", "model.range_view", "model.semantic_classes", "model.voxels")


class Adapted(NamedTuple):
    """A config that fits a recording.

    Attributes:
      config: the config.
      notes: sentences about what was changed and why, for whoever starts the run.
    """

    config: config_lib.Config
    notes: tuple[str, ...]


def adapt(config: config_lib.Config, recording: schema.Recording, *, keep: Collection[str] = (),
          splits: Collection[str] | None = None) -> Adapted:
    """Fits a config to a recording: sensor geometry, action contract, heads, inputs and window lengths.

    Adapting twice changes nothing more.

    Args:
      keep: dotted names, such as "data.stride", that the user chose; they are left alone.
      splits: those that will be read, whose sequences must hold a window; None for all.

    Raises:
      DataError: where the recording lacks what every model needs (actions, and camera or lidar), its voxel grid
        does not suit the voxel decoder, its sequences are shorter than a window, or the user chose what it says
        otherwise.
    """
    description = recording.description
    notes: list[str] = []
    contract = dataclasses.replace(description.contract, step_action=config.contract.step_action)
    model = _fit_first_guess(_fit_model(config.model, description, keep, notes), description, keep, notes)
    needs = prepare.needed(dataclasses.replace(config, model=model, contract=contract), description.modalities)
    data = _fit_windows(config.data, recording, keep, needs, splits, notes)
    if description.route_map is not None:
        data = dataclasses.replace(data, route_map=description.route_map)
    train = config.train
    if train.observe_frames > data.context and "train.observe_frames" not in keep:  # as many as evaluation observes
        train = dataclasses.replace(train, observe_frames=data.context)
    fitted = dataclasses.replace(config, model=model, data=data, train=train, contract=contract)
    _check_chosen(config, fitted, description, keep)
    return Adapted(fitted, tuple(notes))


def check_targets(config: config_lib.Config, description: schema.RecordingDescription) -> None:
    """Raises DataError where a head or term cannot be trained: names it, what the recording lacks, and the way out."""
    for head in config.model.heads:
        described = head_lib.get(head)
        fields = described.learns_from(config.model, config.loss)
        for field in sorted(prepare.recorded(fields) - description.modalities):
            if field in described.term_targets:
                weight = described.term_targets[field].weight
                raise schema.DataError(f"loss.{weight} is on and learns from {field}, which recording "
                                       f"{description.name!r} does not hold. Leave the term out (--set "
                                       f"loss.{weight}=0), or record what it takes (docs/variants.md).")
            others = ",".join(name for name in config.model.heads if name != head)
            raise schema.DataError(f"head {head!r} learns from {field}, which recording {description.name!r} does not "
                                   f"hold. Leave the head out (--heads={others}), or record {field}.")


def _check_chosen(config: config_lib.Config, fitted: config_lib.Config, description: schema.RecordingDescription,
                  keep: Collection[str]) -> None:
    """Raises DataError for a setting of the user's that the recording says otherwise: it would not count."""
    found = settings.names(dataclasses.asdict(fitted))
    for name, asked in settings.names(dataclasses.asdict(config)).items():
        if _within(name, keep) and _within(name, _RECORDED) and found[name] != asked:
            raise schema.DataError(f"{name} is set to {asked!r}, but recording {description.name!r} says "
                                   f"{found[name]!r}, and that counts. Leave the setting out.")


def _within(name: str, sections: Collection[str]) -> bool:
    return any(f"{name}.".startswith(f"{section}.") for section in sections)


def _columns(model: config_lib.ModelConfig, lidar: config_lib.RangeViewGeometry) -> int:
    """The model's columns, doubled until a pixel of its memory holds one of at most eight returns."""
    columns = model.range_view.columns
    while isinstance(model.first_guess, config_lib.LastSeen) and lidar.columns > 8 * columns:
        columns *= 2
    return columns


def _rows(model: config_lib.ModelConfig, lidar: config_lib.RangeViewGeometry) -> int:
    """The model's rows; no more than the lidar has, as near as the network's strides allow: others would stay empty."""
    return min(model.range_view.rows, -(-lidar.rows // _SIDE_MULTIPLE) * _SIDE_MULTIPLE)


def _fit_range_view(model: config_lib.ModelConfig, lidar: config_lib.RangeViewGeometry, keep: Collection[str],
                    notes: list[str]) -> config_lib.RangeViewGeometry:
    """The recorded lidar's view, with rows and columns that a model has."""
    fitted: dict[str, Any] = {
        name: getattr(model.range_view, name) if f"model.range_view.{name}" in keep else rule(model, lidar)
        for name, rule in (("rows", _rows), ("columns", _columns))}
    for name, why in (("rows", "more would be empty"), ("columns", "a pixel holds one return")):
        usual = getattr(model.range_view, name)
        if fitted[name] != usual:
            notes.append(f"range views have {fitted[name]} {name} instead of {usual}: the lidar has "
                         f"{getattr(lidar, name)}, and {why}.")
    return dataclasses.replace(lidar, **fitted)


def _fit_model(model: config_lib.ModelConfig, description: schema.RecordingDescription, keep: Collection[str],
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
        changes["range_view"] = _fit_range_view(model, lidar, keep, notes)
    if description.voxels is not None and "occupancy" in heads:
        changes["voxels"] = description.voxels
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
    if model.navigation and not description.modalities.issuperset(prepare.NAVIGATION):
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


def _fit_voxel_decoder(latent: config_lib.Latent, grid: config_lib.VoxelGrid, notes: list[str]) -> config_lib.Latent:
    """With the most full-width decoder stages, up to those it has, that halve down to whole voxels.

    The 2D latent's voxel tokens fill the grid, so that its decoder keeps its stages.
    """
    suits = lambda stages: all(side % 2 ** (stages + 3) == 0 for side in grid.shape)
    fewest = 0
    if isinstance(latent, config_lib.TokenLatent):
        fewest = latent.occupancy_token_stages
        if suits(fewest):
            return latent
    else:
        for stages in range(latent.occupancy_blocks, -1, -1):
            if suits(stages):
                if stages != latent.occupancy_blocks:
                    notes.append(f"the voxel decoder has {stages} full-width stages instead of "
                                 f"{latent.occupancy_blocks}: the recorded grid is only {_by(grid.shape)}.")
                return dataclasses.replace(latent, occupancy_blocks=stages)
    raise schema.DataError(f"the recorded voxel grid of {_by(grid.shape)} does not suit the voxel decoder: each side "
                           f"must be a multiple of {2 ** (fewest + 3)}. Record another grid, or leave the occupancy "
                           f"head out.")


def _by(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))


def _fit_windows(data: config_lib.DataConfig, recording: schema.Recording, keep: Collection[str],
                 needs: Collection[str], splits: Collection[str] | None,
                 notes: list[str]) -> config_lib.DataConfig:
    lengths = {split: sequences.longest(recording.sequences, split, needs) for split in recording.description.splits
               if splits is None or split in splits}
    # How long a recording is, its training split says, also where that is not read.
    trained = sequences.longest(recording.sequences, "train", needs)
    if trained < SHORT_RECORDING_FRAMES and _too_long(data, lengths):
        changes: dict = {name: value for name, value in _SHORT.items() if f"data.{name}" not in keep}
        data = dataclasses.replace(data, **changes)
        notes.append(f"short recording (longest training sequence: {trained} frames): "
                     f"stride {data.stride}, context {data.context}, horizon {data.horizon}, {data.frames} frames to "
                     f"train on.")
    split = _too_long(data, lengths)
    if split:
        frames = data.frames if split == "train" else data.context + data.horizon
        raise windows.too_short(recording, split, frames, data.stride, needs)
    return data


def _too_long(data: config_lib.DataConfig, lengths: dict[str, int]) -> str | None:
    """The first split whose longest sequence is shorter than a window."""
    for split, length in lengths.items():
        frames = data.frames if split == "train" else data.context + data.horizon
        if length < windows.span(frames, data.stride):
            return split
    return None
