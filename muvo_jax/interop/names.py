"""The reference's parameter names and layouts, and ours: a released checkpoint becomes variables of WorldModel.

Ours are translated to theirs by the rules below, so that what a checkpoint lacks and what nothing asks for are both
named. Layouts: torch keeps (O, I, *K) for convolutions, (I, O, *K) for transposed ones and (O, I) for dense layers;
here it is [*K, I, O] and [I, O] throughout.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from muvo_jax.config import ModelConfig
from muvo_jax.model import tokens, world_model

_QUERIES = {"image": "image", "range_view": "lidar", "occupancy": "voxel", "action": "policy"}
_GATES = {"update": "z", "reset": "r", "new": "q"}

# Applied in turn to "module/module/leaf"; what remains of "/" becomes ".".
_RULES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^camera/backbone", "encoder"),
    (r"^camera/neck", "feat_decoder"),
    (r"^camera/depth_neck", "depth_decoder"),
    (r"^camera/depth/", "depth/"),
    (r"^camera/shrink(\d)", lambda match: f"bev_down_sample_4/{2 * int(match[1])}"),
    (r"^lidar/pillars/linear(\d)", lambda match: f"point_pillars/point_net/net/{3 * int(match[1])}"),
    (r"^lidar/pillars/norm(\d)", lambda match: f"point_pillars/point_net/net/{3 * int(match[1]) + 1}"),
    (r"^lidar/pillar_backbone", "point_pillar_encoder"),
    (r"^lidar/pillar_neck", "point_pillar_decoder"),
    (r"^lidar/backbone", "range_view_encoder"),
    (r"^lidar/neck", "range_view_decoder"),
    (r"^route/backbone", "backbone_route/backbone"),
    (r"^route/linear", "backbone_route/fc"),
    (r"^speed/mlp/linear(\d)", lambda match: f"speed_enc/{2 * int(match[1])}"),
    (r"^(next_)?command/embedding", lambda match: f"command_{match[1] or ''}encoder/0/weight"),
    (r"^(next_)?command/mlp/linear(\d)", lambda match: f"command_{match[1] or ''}encoder/{2 * int(match[2]) + 1}"),
    (r"^target/mlp/linear(\d)", lambda match: f"gps_encoder/{2 * int(match[1])}"),
    (r"decoder/(level0|coarsest)/", "decoder/conv1/"),
    (r"decoder/finer(\d)/", r"decoder/upsample_skip_convs/\1/"),
    (r"decoder/level(\d)/", lambda match: f"decoder/downsample_skip_convs/{int(match[1]) - 1}/"),
    (r"(conv1|convs/\d)/conv/", r"\1/0/"),
    (r"(conv1|convs/\d)/norm/", r"\1/1/"),
    (r"layer(\d)_(\d)", r"layer\1/\2"),
    (r"downsample_conv", "downsample/0"),
    (r"downsample_norm", "downsample/1"),
    (r"^fusion/transformer/layer(\d+)", r"transformer_encoder/layers/\1"),
    (r"^fusion/(image|lidar)_compression/block(\d)", r"\1_feature_conv/\2"),
    (r"^fusion/combine", "features_combine"),
    (r"^fusion/map_backbone", "backbone_bev"),
    (r"^fusion/image_state/block(\d)", r"final_state_conv/\1"),
    (r"^fusion/lidar_state/block(\d)", r"lidar_state_conv/\1"),
    (r"^fusion/join", "embedding_combine"),
    (r"^fusion/", ""),
    (r"^transition/pre_gru", "rssm/pre_gru_net/0"),
    (r"^transition/gru/input_kernel", "rssm/recurrent_model/weight_ih"),
    (r"^transition/gru/hidden_kernel", "rssm/recurrent_model/weight_hh"),
    (r"^transition/gru/input_bias", "rssm/recurrent_model/bias_ih"),
    (r"^transition/gru/hidden_bias", "rssm/recurrent_model/bias_hh"),
    (r"^transition/(prior|posterior)/action", r"rssm/\1_action_module/0"),
    (r"^transition/(prior|posterior)/hidden", r"rssm/\1/module/0"),
    (r"^transition/(prior|posterior)/out", r"rssm/\1/module/2"),
    (r"^transition/(prior|posterior)_action", r"rssm/\1_action_module/0"),
    (r"^transition/(prior|posterior)/transformer/layer(\d+)/cross_attn", r"rssm/\1/module/layers/\2/multihead_attn"),
    (r"^transition/(prior|posterior)/transformer/layer(\d+)", r"rssm/\1/module/layers/\2"),
    (r"^transition/(prior|posterior)/moments", r"rssm/\1/fc"),
    (r"^transition/((?:prior|posterior)/)?type_embedding", r"rssm/\1type_embeddings"),
    (r"^transition/(prior|posterior)/query_(\w+)", lambda match: f"rssm/{match[1]}/query_embed_{_QUERIES[match[2]]}"),
    (r"^transition/gru/gate", "rssm/recurrent_model/w"),
    (r"^transition/gru/(update|reset|new)", lambda match: f"rssm/recurrent_model/conv_{_GATES[match[1]]}"),
    (r"^(rssm/recurrent_model/conv_\w)_shared", r"\1_glo"),
    (r"^decoders_action/mlp/linear(\d)", lambda match: f"policy/fc/{2 * int(match[1])}"),
    (r"^decoders_image/(head_\d)", r"rgb_decoder/\1/rgb_head/0"),
    (r"^decoders_range_view/(head_\d)", r"lidar_re/\1/lidar_re_head/0"),
    (r"^decoders_image/", "rgb_decoder/"),
    (r"^decoders_range_view/", "lidar_re/"),
    (r"^(rgb_decoder|lidar_re)/linear", r"\1/linear/0"),
    (r"^(rgb_decoder|lidar_re)/seed", r"\1/pre_transpose_conv/0"),
    (r"^(rgb_decoder|lidar_re)/up([012])/conv", lambda match: f"{match[1]}/pre_transpose_conv/{2 * int(match[2]) + 2}"),
    (r"^(rgb_decoder|lidar_re)/up([345])/conv", lambda match: f"{match[1]}/trans_conv{int(match[2]) - 2}/0"),
    (r"^decoders_birds_eye/(head_\d)/(offset|center)", r"bev_decoder/\1/instance_\2_head/0"),
    (r"^decoders_birds_eye/(head_\d)/segmentation", r"bev_decoder/\1/segmentation_head/0"),
    (r"^decoders_birds_eye/", "bev_decoder/"),
    (r"^decoders_occupancy/(head_\d)", r"voxel_decoder/\1/segmentation_head/0"),
    (r"^(?:decoders_occupancy|(bev_decoder))/constant",
     lambda match: f"{match[1] or 'voxel_decoder'}/constant_tensor"),
    (r"^decoders_occupancy/", "voxel_decoder/"),
    (r"^(voxel|bev)_decoder/block(\d)", r"\1_decoder/middle_conv/\2"),
    (r"^(voxel|bev)_decoder/up_(\d)", lambda match: f"{match[1]}_decoder/conv{ {4: 1, 2: 2, 1: 3}[int(match[2])] }"),
    (r"^((?:voxel|bev)_decoder/.*(?:first_conv|conv\d))/(?:conv|0)/", r"\1/conv_act/0/"),
    (r"^((?:voxel|bev)_decoder/.*(?:first_conv|conv\d))/(?:norm|1)/style", r"\1/adaptive_norm/latent_affine"),
    (r"^(voxel|bev)_decoder/first_norm/style", r"\1_decoder/first_norm/latent_affine"),
    (r"^(rgb_decoder|lidar_re|(?:voxel|bev)_decoder)/first/", r"\1/pre_transpose_conv/0/"),
    (r"^(rgb_decoder|lidar_re|bev_decoder)/pre(\d)/conv",
     lambda match: f"{match[1]}/pre_transpose_conv/{int(match[2]) + 2}/0"),
    (r"^voxel_decoder/pre(\d)/conv", lambda match: f"voxel_decoder/pre_transpose_conv/{2 * int(match[1]) + 2}"),
    (r"^(rgb_decoder|lidar_re|(?:voxel|bev)_decoder)/grow_(\d)/conv",
     lambda match: f"{match[1]}/trans_conv{ {4: 1, 2: 2, 1: 3}[int(match[2])] }/0"),
    (r"encoder/stage(\d)_(\d)", r"encoder/stages_\1/\2"),
    (r"(encoder/stages_\d/\d)/widen/", r"\1/conv1_1x1/"),
    (r"(encoder/stages_\d/\d)/depthwise/", r"\1/conv2_kxk/"),
    (r"(encoder/stages_\d/\d)/narrow/", r"\1/conv3_1x1/"),
    (r"(encoder/stages_\d/\d)/local/", r"\1/conv_kxk/"),
    (r"(encoder/stages_\d/\d)/enter/", r"\1/conv_1x1/"),
    (r"(encoder/stages_\d/\d)/leave/", r"\1/conv_proj/"),
    (r"(encoder/stages_\d/\d)/transformer(\d)/", r"\1/transformer/\2/"),
    (r"(encoder/stages_\d/\d/transformer/\d)/fc", r"\1/mlp/fc"),
    (r"in_proj/kernel$", "in_proj_weight"),
    (r"in_proj/bias$", "in_proj_bias"),
    (r"/(kernel|seed_kernel|transposed_kernel|scale)$", "/weight"),
    (r"/mean$", "/running_mean"),
    (r"/var$", "/running_var"),
)

# In every checkpoint and used by nothing.
_UNUSED = {
    r"\.num_batches_tracked$": "counter of torch's BatchNorm",
    r"^encoder_layer\.|^rssm\.(prior|posterior)\.transformer_decoder_layer\.": "template that layers were copied from",
    r"^frustum_pooling\.bev_intrinsics$": "computed from the configuration",
}


# Weights that are 1x1 convolutions there and dense layers here -> how many axes of size 1 they end in.
_POINTWISE = {
    r"^voxel_decoder\..*_head\.0\.weight$": 3,
    r"_head\.0\.weight$": 2,
    r"^rssm\.recurrent_model\.(w|conv_\w(_glo)?)\.weight$": 1,
    r"^depth\.weight$": 2,
    r"encoder\.stages_.*(conv[13]_1x1\.conv|conv_1x1|conv_proj\.conv|(qkv|out)_proj|mlp\.fc\d)\.weight$": 2,
}


def reference_key(path: str) -> str:
    """The reference's state_dict key of one of our variables, "fusion/combine/kernel" -> "features_combine.weight"."""
    for pattern, replacement in _RULES:
        path = re.sub(pattern, replacement, path)
    return path.replace("/", ".")


def to_our_layout(leaf: str, shape: tuple[int, ...], value: np.ndarray) -> np.ndarray:
    """A reference array in the layout of our variable called `leaf` with `shape`."""
    if leaf == "type_embedding":
        return value[0, 0].T
    if leaf.startswith("query_"):  # (1, C, *grid), or (1, 1, C) for a single token
        return value[0] if leaf == "query_action" else value[0].reshape(value.shape[1], -1).T
    if leaf == "constant":
        return np.moveaxis(value, 0, -1)
    if leaf in ("seed_kernel", "transposed_kernel"):
        return np.moveaxis(value, (0, 1), (-2, -1))
    if leaf == "kernel" and len(shape) == 2:
        return value.reshape(value.shape[:2]).T  # 1x1 convolutions are dense layers here
    if leaf.endswith("kernel"):
        return np.moveaxis(value, (0, 1), (-1, -2))
    return value


def to_reference_layout(path: str, value: np.ndarray) -> np.ndarray:
    """One of our variables in torch's layout, without the axes of size 1 that only the reference has.

    Args:
      path: of the variable, "camera/backbone/conv1/kernel"; its last part says what it is.
      value: the variable; the tokens of a query stay in one axis.
    """
    leaf = path.rsplit("/")[-1]
    if leaf == "type_embedding":
        return value.T[None, None]
    if leaf.startswith("query_"):
        return value[None] if leaf == "query_action" else value.T[None]
    if leaf == "constant":
        return np.moveaxis(value, -1, 0)
    if leaf in ("seed_kernel", "transposed_kernel"):
        return np.moveaxis(value, (-2, -1), (0, 1))
    if leaf.endswith("kernel"):
        return np.moveaxis(value, (-1, -2), (0, 1))
    return value


def reference_shape(path: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape that `to_reference_layout` gives to a variable of this shape."""
    return to_reference_layout(path, np.broadcast_to(np.float32(0), shape)).shape


def reference_shapes(model_config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Reference key -> shape in a checkpoint, for everything that a model of this configuration has."""
    shapes = {}
    for path, shape in _variables(model_config):
        key = reference_key(path)
        if key in shapes:
            raise ValueError(f"two variables of the model have the name {key}")
        shapes[key] = _full_shape(key, path, reference_shape(path, shape), model_config)
    return shapes


@dataclasses.dataclass(frozen=True)
class Match:
    """How the keys of a checkpoint fit a model.

    Attributes:
      mapped: reference key -> path of our variable.
      ignored: reference key -> why nothing reads it.
      missing: keys that the model needs and the checkpoint lacks.
      unexpected: keys that nothing asks for.
      misshapen: what was found and wanted, a line for each key.
    """

    mapped: dict[str, str]
    ignored: dict[str, str]
    missing: list[str]
    unexpected: list[str]
    misshapen: list[str]

    def problems(self) -> str:
        """What does not fit, in one line; empty where all does."""
        return "; ".join(f"{len(keys)} {what}: {_listed(keys)}" for what, keys in
                         (("missing", self.missing), ("unexpected", self.unexpected),
                          ("of another shape", self.misshapen)) if keys)


def match_state_dict(state_dict: Mapping[str, np.ndarray], model_config: ModelConfig) -> Match:
    """Compares names and shapes; arguments as `convert_state_dict`."""
    wanted = reference_shapes(model_config)
    mapped = {key: path for path, _ in _variables(model_config) if (key := reference_key(path)) in state_dict}
    others = [key for key in state_dict if key not in wanted]
    ignored = {key: reason for key in others if (reason := unused_reason(key)) is not None}
    misshapen = [f"{key} {list(state_dict[key].shape)}, expected {list(wanted[key])}" for key in mapped
                 if state_dict[key].shape != wanted[key]]
    return Match(mapped, ignored, [key for key in wanted if key not in state_dict],
                 [key for key in others if key not in ignored], misshapen)


def unused_reason(key: str) -> str | None:
    """Why no model reads this key of a checkpoint, None where one may."""
    return next((reason for pattern, reason in _UNUSED.items() if re.search(pattern, key)), None)


def convert_state_dict(state_dict: Mapping[str, np.ndarray], model_config: ModelConfig) -> dict[str, Any]:
    """Variables of WorldModel(model_config) with the reference's numbers.

    Args:
      state_dict: reference key (without "model.") -> array, in torch's layout.
      model_config: must describe the same architecture; models trained by the reference want numerics="reference".

    Returns:
      {"params": ..., "batch_stats": ...} of contiguous float32 NumPy arrays.

    Raises:
      ValueError: naming the keys that are missing, unexpected, or of another shape than the configuration says.
    """
    match = match_state_dict(state_dict, model_config)
    if problems := match.problems():
        raise ValueError(f"The checkpoint does not fit the {model_config.variant} model ({model_config.latent.kind}); "
                         f"keys {problems}. Check the heads and sizes of the model's configuration.")

    def value(path, leaf):
        path = _joined(path)
        stored = np.asarray(state_dict[reference_key(path)])
        return np.ascontiguousarray(to_our_layout(path.rsplit("/")[-1], leaf.shape, stored), np.float32)

    return jax.tree_util.tree_map_with_path(value, world_model.WorldModel(model_config).variable_shapes())


def reference_state_dict(variables: Mapping[str, Any], model_config: ModelConfig) -> dict[str, np.ndarray]:
    """The inverse of `convert_state_dict`: reference key -> float32 array of the reference's shape.

    Keys that a checkpoint holds and no model reads are not made.
    """
    out = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(dict(variables))[0]:
        ours = _joined(path)
        key, value = reference_key(ours), to_reference_layout(ours, np.asarray(leaf, np.float32))
        out[key] = np.ascontiguousarray(value.reshape(_full_shape(key, ours, value.shape, model_config)))
    return out


def _variables(model_config: ModelConfig) -> list[tuple[str, tuple[int, ...]]]:
    """Path and shape of every variable."""
    shapes = world_model.WorldModel(model_config).variable_shapes()
    return [(_joined(path), leaf.shape) for path, leaf in jax.tree_util.tree_flatten_with_path(shapes)[0]]


def _joined(path: tuple) -> str:
    """"camera/backbone/conv1/kernel" without the collection in front."""
    return "/".join(part.key for part in path[1:])


def _full_shape(key: str, path: str, shape: tuple[int, ...], model_config: ModelConfig) -> tuple[int, ...]:
    """With the axes of size 1 that the reference's 1x1 convolutions have, and the grids of its queries."""
    group = path.rsplit("query_")[-1] if "/query_" in path else None
    if group is not None:
        grid = tokens.groups(model_config)[group]
        return (*shape[:2], *grid) if grid else shape
    axes = next((axes for pattern, axes in _POINTWISE.items() if re.search(pattern, key)), 0)
    return shape + (1,) * axes


def _listed(names: list[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
