"""The composed model: shapes of every head, missing modalities, independence of samples, refusals."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import decoders, world_model
from muvo_jax.types import Batch

CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
BATCH, FRAMES = 3, 2


@pytest.fixture(scope="module")
def batch():
    random = np.random.default_rng(0)
    range_size = (CONFIG.range_view.rows, CONFIG.range_view.columns)
    return Batch(
        action=random.uniform(-1, 1, (BATCH, FRAMES, 2)).astype(np.float32),
        is_first=np.broadcast_to(np.arange(FRAMES)[None] == 0, (BATCH, FRAMES)),
        image=random.integers(0, 256, (BATCH, FRAMES, *CONFIG.image_size, 3), np.uint8),
        range_view=random.uniform(-20, 20, (BATCH, FRAMES, *range_size, 4)).astype(np.float32),
        route_map=random.integers(0, 256, (BATCH, FRAMES, 64, 64), np.uint8),
        speed_mps=random.uniform(0, 10, (BATCH, FRAMES)).astype(np.float32))


@pytest.fixture(scope="module")
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


def encode(model, variables, batch):
    return jax.jit(lambda variables, batch: model.encode(variables, batch)[0])(variables, batch)


def test_init_is_deterministic_and_needs_no_batch(batch):
    first, second = MODEL.init(jax.random.key(7), batch), MODEL.init(jax.random.key(7))
    jax.tree.map(np.testing.assert_array_equal, first, second)
    other = MODEL.init(jax.random.key(8))
    assert not np.array_equal(first["params"]["fusion"]["combine"]["kernel"],
                              other["params"]["fusion"]["combine"]["kernel"])
    np.testing.assert_array_equal(first["params"]["decoders_image"]["head_1"]["bias"], 0.5)


def test_the_paper_size_has_the_references_number_of_parameters():
    shapes = world_model.WorldModel(config_lib.ModelConfig()).variable_shapes()["params"]
    unused_template = 2_168_192  # the reference counts one more transformer layer, which it never runs
    assert sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes)) == 176_185_437 - unused_template


def test_model_is_frozen_and_hashable():
    same = world_model.WorldModel(presets.get("tiny").model)
    assert hash(MODEL) == hash(same) and same == MODEL
    with pytest.raises(dataclasses.FrozenInstanceError):
        MODEL.config = None


def test_embedding_of_a_sample_does_not_depend_on_the_others_in_evaluation(variables, batch):
    whole = encode(MODEL, variables, batch)
    assert whole.shape == (BATCH, FRAMES, CONFIG.latent.embedding_channels) and whole.dtype == jnp.float32
    np.testing.assert_allclose(encode(MODEL, variables, batch[1:2]), whole[1:2], atol=1e-5)


def test_every_head_at_every_scale(variables):
    features = jax.random.normal(jax.random.key(1), (2, 3, *MODEL.feature_shape))
    predictions = jax.jit(lambda variables, features: MODEL.decode(variables, features))(variables, features)
    full = {"image": CONFIG.image_size, "range_view": (CONFIG.range_view.rows, CONFIG.range_view.columns),
            "occupancy": CONFIG.voxels.shape, "action": ()}
    channels = {"image": 3, "range_view": 4, "occupancy": 2, "action": 2}
    assert set(predictions) == set(CONFIG.heads)
    for name, scales in predictions.arrays.items():
        assert set(scales) == ({1} if name == "action" else {1, 2, 4})
        for scale, value in scales.items():
            size = tuple(side // scale for side in full[name])
            assert value.shape == (2, 3, *size, channels[name]) and value.dtype == jnp.float32
    assert np.abs(predictions.action).max() <= 1


def test_only_the_heads_asked_for_and_any_leading_axes(variables):
    feature = jnp.ones(MODEL.feature_shape)
    predictions = MODEL.decode(variables, feature, ("action",))
    assert predictions.heads == ("action",) and predictions.action.shape == (2,)
    with pytest.raises(ValueError, match=r"no head depth; it has image"):
        MODEL.decode(variables, feature, ("depth",))


def test_range_view_comes_out_in_metres(variables):
    feature = jnp.ones((1, *MODEL.feature_shape))
    doubled = world_model.WorldModel(dataclasses.replace(CONFIG, range_scale_m=2 * CONFIG.range_scale_m))
    range_view = lambda model: model.decode(variables, feature, ("range_view",)).at_scale(4).range_view
    np.testing.assert_allclose(range_view(doubled), 2 * range_view(MODEL), rtol=1e-5)


def test_a_modality_that_is_switched_off_is_neither_read_nor_has_parameters(batch):
    blind_config = dataclasses.replace(CONFIG, route=False, speed=False, heads=("range_view", "action"))
    model = world_model.WorldModel(blind_config)
    weights = model.init(jax.random.key(0))
    assert not {"route", "speed", "decoders_image", "decoders_occupancy"} & set(weights["params"])
    blind = batch.replace(route_map=None, speed_mps=None)
    assert encode(model, weights, blind).shape == (BATCH, FRAMES, CONFIG.latent.embedding_channels)


def test_inputs_that_do_not_fit_are_refused(variables, batch):
    with pytest.raises(ValueError, match=r"Batch.route_map is None"):
        MODEL.encode(variables, batch.replace(route_map=None))
    with pytest.raises(ValueError, match=r"Batch.image: got .* expected \[B, T, 32, 64, 3\]"):
        MODEL.init(jax.random.key(0), batch.replace(image=batch.image[:, :, :16]))
    with pytest.raises(ValueError, match="one typed key per sample"):
        MODEL.encode(variables, batch, train=True)


def test_bfloat16_computes_close_to_float32(variables, batch):
    model = world_model.WorldModel(dataclasses.replace(CONFIG, compute_dtype="bfloat16"))
    got, want = encode(model, variables, batch), encode(MODEL, variables, batch)
    assert got.dtype == jnp.float32
    assert np.abs(got - want).max() < 0.05 * np.abs(want).max()


@pytest.mark.parametrize("size", [(32, 64), (96, 160), (64, 256), (320, 832), (64, 1024)])
def test_planes_of_any_multiple_of_32_are_met_exactly(size):
    decoder = decoders.PlaneDecoder(size, 3, 8)
    shapes = jax.eval_shape(lambda key, features: decoder.init_with_output(key, features)[0], jax.random.key(0),
                            jnp.zeros((1, 4)))
    assert {scale: leaf.shape for scale, leaf in shapes.items()} == {
        scale: (1, size[0] // scale, size[1] // scale, 3) for scale in (1, 2, 4)}
    assert decoders.plane_start((320, 832)) == ((5, 13), (2, 2))
