"""The authors' checkpoints: what is in the file, which model it is, and how its keys fit.

A Lightning checkpoint keeps the network under "model." in its "state_dict"; preprocessing constants and, on the 2D code
line, the network of the perceptual loss lie beside it.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import pathlib
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import safetensors_file
from muvo_jax.interop import torch_file

_PREFIX = "model."
_LARGEST_SIZE = 2**13  # of an axis that tells a size; the released models have 2048
_BESIDE = {
    r"^preprocess\.": "constants of the preprocessing",
    r"^perceptual_loss\.": "network of the perceptual loss",
    r"^(train|val|test|metric)\w*\.": "state of a metric",
}
# (latent, heads with occupancy, backbone) -> the released file and its configuration.
_PUBLISHED = {
    ("1d", True, "resnet18"): "RV_WOB_TR_1d_Voxel (test_base_1d.yml)",
    ("1d", False, "resnet18"): "RV_WOB_TR_1d_no_Voxel (test_base_1d_without_voxel.yml)",
    ("2d", True, "resnet18"): "basic_voxel (test_base_2d.yml)",
    ("2d", True, "mobilevitv2_100"): "mobilevit (test_mobilevit_2d.yml)",
}
_HEAD_PREFIXES = {"image": "rgb_decoder.", "range_view": "lidar_re.", "occupancy": "voxel_decoder.",
                  "action": "policy.", "birds_eye": "bev_decoder."}
Fields = dict[str, Any]  # of a ModelConfig
CONFIG = "muvo_jax.config"  # in the metadata of an exported run
ShapeOf = Callable[[str, int], tuple[int, ...]]  # of a key that has so many axes


class CheckpointMismatch(ValueError):
    """The file is readable but holds no model of this family, or one that does not fit; the message says which keys."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """A checkpoint's network.

    Attributes:
      path: of the file.
      state_dict: reference key (without "model.") -> array, torch layout.
      beside: keys of other things in the state_dict -> what they are.
      facts: what the file says of its training, such as global_step.
      config: of the run that it was exported from; None of a file of the authors' code.
    """

    path: pathlib.Path
    state_dict: Mapping[str, np.ndarray]
    beside: Mapping[str, str]
    facts: Mapping[str, Any]
    config: config_lib.Config | None = None


def read(path: str | os.PathLike) -> Stored:
    """Reads a Lightning checkpoint, or a bare state_dict (.pth, .pt, .safetensors), without torch.

    Raises:
      TorchFileError, SafetensorsError: for a file that cannot be read.
      CheckpointMismatch: where it holds no tensors by name, or a config of ours that cannot be read.
    """
    path, metadata = pathlib.Path(path).expanduser(), dict[str, str]()
    if path.suffix == ".safetensors":
        loaded, metadata = safetensors_file.load_with_metadata(path)
    else:
        loaded = torch_file.load(path)
    outer = loaded if isinstance(loaded, dict) else {}
    tensors = outer.get("state_dict", outer)
    if not isinstance(tensors, dict) or not any(isinstance(value, np.ndarray) for value in tensors.values()):
        held = f"a dict of {', '.join(map(str, list(outer)[:5]))}" if outer else f"a {type(loaded).__name__}"
        raise CheckpointMismatch(f"{path}: expected a checkpoint with tensors by name (a state_dict), found {held}.")
    tensors = {str(key): value for key, value in tensors.items() if isinstance(value, np.ndarray)}
    wanted_bytes, file_bytes = sum(value.nbytes for value in tensors.values()), path.stat().st_size
    if wanted_bytes > torch_file.MOST_INFLATION * file_bytes:  # views that repeat few numbers, or a bomb
        raise CheckpointMismatch(f"{path}: expected tensors of about the size of the file, found that those in its "
                                 f"{file_bytes} bytes would take {wanted_bytes}.")
    beside = {key: reason for key in tensors
              if (reason := next((why for pattern, why in _BESIDE.items() if re.search(pattern, key)), None))}
    inner = {key.removeprefix(_PREFIX): value for key, value in tensors.items() if key not in beside}
    facts: dict[str, Any] = {name: outer[name] for name in ("epoch", "global_step", "pytorch-lightning_version")
                             if isinstance(outer.get(name), (int, str))}
    if metadata.get("step", "").isdecimal():
        facts["global_step"] = int(metadata["step"])
    return Stored(path, inner, beside, facts, _exported(metadata, path))


def _exported(metadata: Mapping[str, str], path: pathlib.Path) -> config_lib.Config | None:
    """The config of the run that export_torch wrote a file from."""
    if CONFIG not in metadata:
        return None
    try:
        return config_lib.Config.from_dict(json.loads(metadata[CONFIG]))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise CheckpointMismatch(f"{path}: its metadata {CONFIG!r} is no configuration of this version ({error}). "
                                 f"Export the run again.") from error


def recognise(stored: Stored) -> config_lib.ModelConfig:
    """The architecture that the keys and shapes of a checkpoint describe, with numerics="reference"; of a run that was
    exported its own, since shapes do not tell all of it.

    Raises:
      CheckpointMismatch: where they describe no model of this family.
    """
    if stored.config is not None:
        return stored.config.model
    state_dict = stored.state_dict
    landmarks = ("rssm.pre_gru_net.0.weight", "encoder.", "policy.fc.0.weight")
    absent = [name for name in landmarks if not any(key.startswith(name) for key in state_dict)]
    if absent:
        raise CheckpointMismatch(
            f"{stored.path}: expected a MUVO or MILE-style world model, whose keys include {', '.join(absent)}; found "
            f"{len(state_dict)} keys such as {', '.join(list(state_dict)[:4])}.")
    try:
        return _describe(state_dict)
    except KeyError as error:
        raise CheckpointMismatch(f"{stored.path}: expected a MUVO or MILE-style world model, but the key "
                                 f"{error.args[0]!r} that tells its size is missing.") from error
    except _Misshapen as error:
        raise CheckpointMismatch(f"{stored.path}: expected a MUVO or MILE-style world model, but {error}.") from error
    except ValueError as error:
        raise CheckpointMismatch(f"{stored.path}: its shapes describe a model that cannot be built: {error}") from error


def published_name(model: config_lib.ModelConfig) -> str | None:
    """The released file that a model of exactly this architecture is, None for others."""
    released = dataclasses.replace(config_lib.ModelConfig(), numerics="reference", latent=type(model.latent)(),
                                   heads=model.heads, backbone=model.backbone)
    if model != released:
        return None
    return _PUBLISHED.get((model.latent.kind, "occupancy" in model.heads, model.backbone))


class _Misshapen(ValueError):
    """A key that tells a size has another number of axes, or none."""


def _describe(state_dict: Mapping[str, np.ndarray]) -> config_lib.ModelConfig:
    def shape(key: str, axes: int) -> tuple[int, ...]:
        found = state_dict[key].shape
        if len(found) != axes or not all(0 < size <= _LARGEST_SIZE for size in found):
            raise _Misshapen(f"the key {key!r} that tells its size is {list(found)}, expected {axes} axes of 1 to "
                             f"{_LARGEST_SIZE}")
        return found

    has = lambda prefix: any(key.startswith(prefix) for key in state_dict)
    tokens = has("rssm.prior.query_embed_image")
    heads = tuple(head for head, prefix in _HEAD_PREFIXES.items() if has(prefix))
    fields: Fields = {"numerics": "reference", "heads": heads, "route": has("backbone_route."),
                      "navigation": has("command_encoder."), "speed": has("speed_enc.")}
    fields |= _sensor_encoders(state_dict, shape)
    pillars = isinstance(fields["lidar"], config_lib.PillarLidar)
    if has("transformer_encoder."):
        fields["fusion"] = _transformer_fusion(state_dict, shape, pillars)
        pooled: Fields = {} if tokens else {"embedding_channels": shape("features_combine.weight", 2)[0],
                                            "fused_channels": shape("image_feature_conv.0.conv1.weight", 4)[0]}
    else:
        fields["fusion"], pooled = _pooled_fusion(has, shape)
    fields |= _token_latent(heads, state_dict, shape) if tokens else _vector_latent(heads, pooled, state_dict, shape)
    return config_lib.ModelConfig(**fields)


def _sensor_encoders(state_dict: Mapping[str, np.ndarray], shape: ShapeOf) -> Fields:
    fields: Fields = {"camera": config_lib.PlaneCamera(), "lidar": config_lib.RangeViewLidar()}
    if "encoder.stem.conv.weight" in state_dict:
        fields["backbone"] = "mobilevitv2_100"
        fields["backbone_width"] = shape("encoder.stages_0.0.conv3_1x1.conv.weight", 4)[0]
    else:
        fields["backbone_width"] = shape("encoder.conv1.weight", 4)[0]
    for key in ("speed_enc.0.weight", "gps_encoder.0.weight"):
        if key in state_dict:
            fields["measurement_channels"] = shape(key, 2)[0]
    if any(key.startswith("point_pillars.") for key in state_dict):
        fields["lidar"] = config_lib.PillarLidar(
            config_lib.PillarGrid(channels=shape("point_pillars.point_net.net.0.weight", 2)[0]))
    if any(key.startswith("depth_decoder.") for key in state_dict):
        grid = dataclasses.replace(_birds_eye_grid(state_dict.get("frustum_pooling.bev_intrinsics", np.zeros((3, 3)))),
                                   depth_bins=shape("depth.weight", 4)[0])
        if "bev_down_sample_4.0.weight" in state_dict:
            grid = dataclasses.replace(grid, hidden_channels=shape("bev_down_sample_4.0.weight", 4)[0])
        fields["camera"] = config_lib.BirdsEyeCamera(grid)
    return fields


def _birds_eye_grid(intrinsics: np.ndarray) -> config_lib.BirdsEyeGrid:
    """The grid whose metres the matrix maps to cells; the usual one where the matrix is not filled in."""
    if intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all():
        raise _Misshapen(f"frustum_pooling.bev_intrinsics is {list(intrinsics.shape)}, expected 3x3 finite numbers")
    per_m, behind, middle = (float(intrinsics[place]) for place in ((0, 0), (0, 2), (1, 2)))
    if not per_m > 0.0:
        return config_lib.BirdsEyeGrid()
    return config_lib.BirdsEyeGrid(cells=round(2 * middle), cell_m=round(1 / per_m, 6), cells_behind=round(behind))


def _transformer_fusion(state_dict: Mapping[str, np.ndarray], shape: ShapeOf,
                        pillars: bool) -> config_lib.TransformerFusion:
    lidar_decoder = "point_pillar_decoder" if pillars else "range_view_decoder"
    return config_lib.TransformerFusion(
        token_channels=shape("type_embedding", 4)[2], layers=_count(state_dict, "transformer_encoder.layers"),
        hidden_channels=shape("transformer_encoder.layers.0.linear1.weight", 2)[0],
        many_tokens=f"{lidar_decoder}.upsample_skip_convs.0.0.weight" in state_dict)


def _pooled_fusion(has: Callable[[str], bool], shape: ShapeOf) -> tuple[Any, Fields]:
    """The fusion, and what the vector latent says of its vectors."""
    pooled = shape("final_state_conv.0.conv1.weight", 4)[0]
    map_channels = shape("feat_decoder.conv1.0.weight", 4)[0]
    if not has("embedding_combine."):  # of an exported run; the reference has no such model
        return config_lib.AverageFusion(map_channels), {"embedding_channels": pooled}
    return config_lib.ConcatenationFusion(map_channels), {
        "embedding_channels": shape("embedding_combine.weight", 2)[0], "fused_channels": pooled}


def _vector_latent(heads: tuple[str, ...], pooled: Fields, state_dict: Mapping[str, np.ndarray],
                   shape: ShapeOf) -> Fields:
    """The latent and what its decoders say of the sensors."""
    latent: Fields = pooled | {"deterministic_channels": shape("rssm.pre_gru_net.0.weight", 2)[0],
                               "stochastic_channels": shape("rssm.pre_gru_net.0.weight", 2)[1],
                               "action_channels": shape("rssm.prior_action_module.0.weight", 2)[0]}
    fields: Fields = {}
    for head, name in (("image", "rgb_decoder"), ("range_view", "lidar_re")):
        if head in heads:
            fields["decoder_channels"] = shape(f"{name}.linear.0.weight", 2)[0]
            rows, columns = (64 * side for side in shape(f"{name}.pre_transpose_conv.0.weight", 4)[2:])
            fields |= ({"image_size": (rows, columns)} if head == "image" else
                       {"range_view": config_lib.RangeViewGeometry(rows=rows, columns=columns)})
    if "birds_eye" in heads:
        constant = shape("bev_decoder.constant_tensor", 3)
        blocks = _count(state_dict, "bev_decoder.middle_conv")
        fields["decoder_channels"], latent["occupancy_blocks"] = constant[0], blocks
        rows, columns = (side * 2 ** (blocks + 3) for side in constant[1:])
        fields["voxels"] = config_lib.VoxelGrid((rows, columns, config_lib.VoxelGrid().shape[2]))
    if "occupancy" in heads:
        constant = shape("voxel_decoder.constant_tensor", 4)
        blocks = _count(state_dict, "voxel_decoder.middle_conv")
        fields["occupancy_channels"], latent["occupancy_blocks"] = constant[0] // 2, blocks
        fields["voxels"] = config_lib.VoxelGrid(tuple(side * 2 ** (blocks + 3) for side in constant[1:]))
    return fields | {"latent": config_lib.VectorLatent(**latent)}


def _token_latent(heads: tuple[str, ...], state_dict: Mapping[str, np.ndarray], shape: ShapeOf) -> Fields:
    """The latent and what its tokens say of the sensors."""
    rows, columns = shape("rssm.prior.query_embed_lidar", 4)[2:]
    fields: Fields = {
        "image_size": tuple(32 * side for side in shape("rssm.prior.query_embed_image", 4)[2:]),
        "range_view": config_lib.RangeViewGeometry(rows=16 * rows, columns=16 * columns)}
    for head, name in (("image", "rgb_decoder"), ("range_view", "lidar_re"), ("birds_eye", "bev_decoder")):
        if head in heads:
            fields["decoder_channels"] = shape(f"{name}.pre_transpose_conv.0.weight", 4)[0]
    stages = 1
    if "occupancy" in heads:
        stages = _count(state_dict, "voxel_decoder.pre_transpose_conv", 2, 2)
        fields["occupancy_channels"] = shape("voxel_decoder.pre_transpose_conv.0.weight", 5)[0] // 2
    elif "birds_eye" in heads:
        stages = _count(state_dict, "bev_decoder.pre_transpose_conv", 2)
    fields["latent"] = config_lib.TokenLatent(transition_layers=_count(state_dict, "rssm.prior.module.layers"),
                                              occupancy_token_stages=stages)
    fields["voxels"] = config_lib.VoxelGrid(
        tuple(side * 2 ** (stages + 3) for side in shape("rssm.prior.query_embed_voxel", 5)[2:]))
    return fields


def _count(state_dict: Mapping[str, np.ndarray], prefix: str, first: int = 0, step: int = 1) -> int:
    """How many of the modules "prefix.first", "prefix.first+step", ... there are up to the first gap."""
    return next(n for n in itertools.count()
                if not any(key.startswith(f"{prefix}.{first + n * step}.") for key in state_dict))
