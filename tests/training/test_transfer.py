"""A trained model starts a run on a recording that lacks some of its inputs."""

import dataclasses

import jax
import numpy as np
import pytest
import recording_writers as writers

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fitting, pipeline
from muvo_jax.data.kitti import reader
from muvo_jax.model import world_model
from muvo_jax.run import Run
from muvo_jax.training import transfer, validation


@pytest.fixture(scope="module")
def town():
    """A model of the town, small, of fresh weights; its images have the shape that those of the recording get."""
    config = config_lib.override_all(presets.get("tiny"), {
        "model.image_size": (32, 96), "model.latent": "2d", "model.first_guess": "training_mean",
        "model.action_path": "recurrence"})
    shapes = world_model.WorldModel(config.model).variable_shapes()
    generator = np.random.default_rng(0)
    return Run(None, jax.tree.map(lambda leaf: generator.normal(size=leaf.shape).astype(np.float32), shapes), config, 5)


@pytest.fixture(scope="module")
def kitti(town, tmp_path_factory):
    """KITTI knows no route; its frames, and the town's config fitted to it."""
    recording = reader.KittiRecording(writers.write_kitti(tmp_path_factory.mktemp("kitti"), frames=24))
    config = fitting.adapt(town.config, recording, keep=fitting.OF_TRAINED).config
    assert town.config.model.route and not config.model.route and config.model.speed
    return pipeline.Frames(recording, config), config


def test_what_the_recording_lacks_is_left_out_and_the_rest_stays(town, kitti):
    frames, config = kitti
    wanted = world_model.WorldModel(config.model).variable_shapes()
    found = transfer.to_recording(town, config, wanted, frames)
    assert transfer.shapes(found) == transfer.shapes(wanted)
    params, before = found["params"], town.variables["params"]
    assert set(before) - set(params) == {"route"}
    kinds = before["fusion"]["type_embedding"]  # camera, lidar, route, speed
    np.testing.assert_array_equal(params["fusion"]["type_embedding"], kinds[[0, 1, 3]])
    jax.tree.map(np.testing.assert_array_equal, params["transition"], before["transition"])
    image = validation.training_sums(frames).prediction()["image"]
    np.testing.assert_allclose(found["batch_stats"]["first_guess_image"]["scale_1"], image, atol=1e-6)
    assert np.abs(found["batch_stats"]["transition"]["action_spread"]).max() < 1.0  # measured, not the normal draws
    for name, stats in town.variables["batch_stats"].items():
        if name not in ("transition", "route") and not name.startswith("first_guess"):
            jax.tree.map(np.testing.assert_array_equal, found["batch_stats"][name], stats)


def test_any_other_difference_is_refused_naming_both(town, kitti):
    frames, config = kitti
    wider = dataclasses.replace(config, model=dataclasses.replace(config.model, decoder_channels=16))
    wanted = world_model.WorldModel(wider.model).variable_shapes()
    with pytest.raises(ValueError, match=r"decoder_channels 8 \(stored\) against 16 \(asked for\)"):
        transfer.to_recording(town, wider, wanted, frames)


def test_a_head_that_the_old_run_lacks_starts_fresh(town, kitti):
    frames, config = kitti
    heads = (*config.model.heads, "ego_motion")
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, heads=heads))
    shapes = world_model.WorldModel(config.model).variable_shapes()
    fresh = jax.tree.map(lambda leaf: np.full(leaf.shape, 0.5, leaf.dtype), shapes)
    found = transfer.to_recording(town, config, fresh, frames)
    assert transfer.shapes(found) == transfer.shapes(shapes)
    jax.tree.map(np.testing.assert_array_equal, found["params"]["decoders_ego_motion"],
                 fresh["params"]["decoders_ego_motion"])
    jax.tree.map(np.testing.assert_array_equal, found["params"]["decoders_image"],
                 town.variables["params"]["decoders_image"])
