"""A fresh model that starts from the average training frame predicts exactly that frame."""

import dataclasses

import jax
import numpy as np
import pytest
import small_world

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.metrics import baselines
from muvo_jax.model import world_model
from muvo_jax.training import first_guess


@pytest.fixture(scope="module")
def setting():
    config = dataclasses.replace(presets.tiny().model, first_guess=config_lib.TrainingMean(), range_view_points="beams")
    batch = small_world.make_batch(config)
    return config, baselines.TrainingMean().add(batch)


def test_a_fresh_model_predicts_the_training_mean(setting):
    config, mean = setting
    model = world_model.WorldModel(config)
    variables = model.init(jax.random.key(0))
    variables["batch_stats"] = {**variables["batch_stats"], **first_guess.constants(mean, config)}
    features = np.random.default_rng(0).normal(size=(2, *model.feature_shape)).astype(np.float32)
    predicted = jax.jit(model.decode, static_argnames="heads")(
        variables, features, heads=("image", "range_view", "occupancy"))
    expected = mean.prediction()
    np.testing.assert_allclose(predicted.image[0], expected["image"], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(predicted.range_view[0][..., 3], expected["range_view"][..., 3], atol=1e-4)
    for scale in (1, 2, 4):
        logits = np.asarray(predicted.at_scale(scale).occupancy[0])
        share = 1 / (1 + np.exp(-(logits[..., 1] - logits[..., 0])))
        np.testing.assert_allclose(share, (mean.occupied[scale] + 1) / (mean.known[scale] + 4), atol=1e-5)


def test_constants_fit_the_variables_of_the_model(setting):
    config, mean = setting
    shapes = world_model.WorldModel(config).variable_shapes()["batch_stats"]
    constants = first_guess.constants(mean, config)
    assert constants.keys() == {name for name in shapes if name.startswith("first_guess_")}
    for head, scales in constants.items():
        assert {name: value.shape for name, value in scales.items()} == {
            name: leaf.shape for name, leaf in shapes[head].items()}


def test_a_voxel_that_no_frame_knows_starts_nearer_to_empty(setting):
    config, mean = setting
    nobody = jax.tree.map(np.zeros_like, mean.known)
    mean = dataclasses.replace(mean, known=nobody, occupied=nobody)
    for logits in first_guess.constants(mean, config)["first_guess_occupancy"].values():
        np.testing.assert_allclose(logits[..., 1], np.log(1 / 3), rtol=1e-6)
