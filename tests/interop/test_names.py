"""Names and layouts of the reference's checkpoints."""

import jax
import numpy as np
import pytest

from muvo_jax import presets
from muvo_jax.interop import names
from muvo_jax.model import world_model

CONFIG = presets.get("tiny").model


def reference_shape(path, shape):
    """The torch shape of one of our variables."""
    leaf = path.split("/")[-1]
    if leaf == "type_embedding":
        return (1, 1, shape[1], shape[0])
    if leaf == "constant":
        return (shape[-1], *shape[:-1])
    if leaf in ("seed_kernel", "transposed_kernel"):
        return (*shape[-2:], *shape[:-2])
    if leaf.endswith("kernel"):
        ones = {"decoders_occupancy/head": 3, "decoders_image/head": 2, "decoders_range_view/head": 2}
        extra = next((count for prefix, count in ones.items() if path.startswith(prefix)), 0)
        return (shape[-1], shape[-2], *shape[:-2], *(1,) * extra)
    return shape


@pytest.fixture(scope="module")
def state_dict():
    """A checkpoint of the tiny architecture as torch would hold it, filled with distinct numbers."""
    shapes = world_model.WorldModel(CONFIG).variable_shapes()
    random, out = np.random.default_rng(0), {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(shapes)[0]:
        path = "/".join(part.key for part in path[1:])
        out[names.reference_key(path)] = random.normal(size=reference_shape(path, leaf.shape)).astype(np.float32)
    out["encoder.bn1.num_batches_tracked"] = np.int64(3)
    out["encoder_layer.linear1.weight"] = np.zeros((4, 4), np.float32)
    return out


@pytest.mark.parametrize("ours, theirs", [
    ("camera/backbone/layer2_0/downsample_norm/mean", "encoder.layer2.0.downsample.1.running_mean"),
    ("camera/neck/level0/norm/scale", "feat_decoder.conv1.1.weight"),
    ("lidar/neck/level2/conv/kernel", "range_view_decoder.downsample_skip_convs.1.0.weight"),
    ("route/backbone/conv1/kernel", "backbone_route.backbone.conv1.weight"),
    ("speed/mlp/linear1/bias", "speed_enc.2.bias"),
    ("fusion/type_embedding", "type_embedding"),
    ("fusion/transformer/layer5/self_attn/in_proj/kernel", "transformer_encoder.layers.5.self_attn.in_proj_weight"),
    ("fusion/transformer/layer5/self_attn/out_proj/bias", "transformer_encoder.layers.5.self_attn.out_proj.bias"),
    ("fusion/lidar_compression/block1/bn2/var", "lidar_feature_conv.1.bn2.running_var"),
    ("transition/gru/hidden_bias", "rssm.recurrent_model.bias_hh"),
    ("transition/posterior/out/kernel", "rssm.posterior.module.2.weight"),
    ("decoders_image/up2/conv/transposed_kernel", "rgb_decoder.pre_transpose_conv.6.weight"),
    ("decoders_range_view/up5/conv/bias", "lidar_re.trans_conv3.0.bias"),
    ("decoders_occupancy/up_4/conv2/norm/style/kernel", "voxel_decoder.conv1.conv2.adaptive_norm.latent_affine.weight"),
    ("decoders_occupancy/first_conv/conv/kernel", "voxel_decoder.first_conv.conv_act.0.weight"),
    ("decoders_action/mlp/linear3/kernel", "policy.fc.6.weight"),
    ("transition/type_embedding", "rssm.type_embeddings"),
    ("transition/prior/type_embedding", "rssm.prior.type_embeddings"),
    ("transition/prior/query_action", "rssm.prior.query_embed_policy"),
    ("transition/posterior/query_range_view", "rssm.posterior.query_embed_lidar"),
    ("transition/prior/transformer/layer3/cross_attn/in_proj/kernel",
     "rssm.prior.module.layers.3.multihead_attn.in_proj_weight"),
    ("transition/posterior/transformer/layer0/norm3/scale", "rssm.posterior.module.layers.0.norm3.weight"),
    ("transition/posterior/moments/bias", "rssm.posterior.fc.bias"),
    ("transition/posterior_action/kernel", "rssm.posterior_action_module.0.weight"),
    ("transition/gru/new_shared/kernel", "rssm.recurrent_model.conv_q_glo.weight"),
    ("transition/gru/gate/bias", "rssm.recurrent_model.w.bias"),
    ("decoders_image/pre1/conv/bias", "rgb_decoder.pre_transpose_conv.3.0.bias"),
    ("decoders_occupancy/first/kernel", "voxel_decoder.pre_transpose_conv.0.weight"),
    ("decoders_occupancy/pre0/conv/transposed_kernel", "voxel_decoder.pre_transpose_conv.2.weight"),
    ("decoders_occupancy/grow_2/conv/transposed_kernel", "voxel_decoder.trans_conv2.0.weight"),
    ("decoders_range_view/head_1/kernel", "lidar_re.head_1.lidar_re_head.0.weight"),
])
def test_names_by_hand(ours, theirs):
    assert names.reference_key(ours) == theirs


def test_names_are_distinct(state_dict):
    shapes = world_model.WorldModel(CONFIG).variable_shapes()
    assert len(state_dict) == len(jax.tree.leaves(shapes)) + 2


def test_queries_become_tokens():
    grid = np.arange(24.0).reshape(1, 4, 2, 3)  # torch: one row of 4 channels over a grid of 2 x 3
    np.testing.assert_array_equal(names.to_our_layout("query_image", (6, 4), grid)[5], [5, 11, 17, 23])
    np.testing.assert_array_equal(names.to_our_layout("query_action", (1, 4), np.ones((1, 1, 4))), np.ones((1, 4)))


def test_layouts(state_dict):
    variables = names.convert_state_dict(state_dict, CONFIG)
    params = variables["params"]
    conv = state_dict["encoder.conv1.weight"]
    np.testing.assert_array_equal(params["camera"]["backbone"]["conv1"]["kernel"][2, 5, 1, 3], conv[3, 1, 2, 5])
    transposed = state_dict["rgb_decoder.trans_conv1.0.weight"]
    np.testing.assert_array_equal(params["decoders_image"]["up3"]["conv"]["transposed_kernel"][4, 1, 2, 3],
                                  transposed[2, 3, 4, 1])
    np.testing.assert_array_equal(params["fusion"]["combine"]["kernel"], state_dict["features_combine.weight"].T)
    np.testing.assert_array_equal(params["decoders_occupancy"]["constant"][0, 0, 0],
                                  state_dict["voxel_decoder.constant_tensor"][:, 0, 0, 0])
    np.testing.assert_array_equal(params["fusion"]["type_embedding"][1], state_dict["type_embedding"][0, 0, :, 1])
    shapes = world_model.WorldModel(CONFIG).variable_shapes()
    assert jax.tree.map(np.shape, variables) == jax.tree.map(lambda leaf: leaf.shape, shapes)
    assert all(leaf.dtype == np.float32 and leaf.flags.c_contiguous for leaf in jax.tree.leaves(variables))


def test_a_misfit_names_the_keys(state_dict):
    missing = {key: value for key, value in state_dict.items() if key != "rssm.prior.module.2.bias"}
    with pytest.raises(ValueError, match=r"1 missing: rssm\.prior\.module\.2\.bias"):
        names.convert_state_dict(missing, CONFIG)
    with pytest.raises(ValueError, match=r"1 unexpected: bev_decoder\.weight"):
        names.convert_state_dict(state_dict | {"bev_decoder.weight": np.zeros(2)}, CONFIG)
    with pytest.raises(ValueError, match=r"1 of another shape: features_combine\.bias \[3\]"):
        names.convert_state_dict(state_dict | {"features_combine.bias": np.zeros(3)}, CONFIG)
