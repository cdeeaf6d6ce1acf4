"""Encoders and fusions: their maps and embeddings have the sizes that docstrings give, and keep what matters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import checks, encoders, world_model
from muvo_jax.nn import norm
from muvo_jax.types import BATCH_FIELDS, Batch

# Rows, columns of the maps: images of 32x64, range views of 32x64, 32 pillars and 8 cells of bird's-eye view on a side.
MAPS = {
    ("wob", "rv", "tr", "1d"): ((1, 2), (1, 2)), ("wob", "rv", "tr", "2d"): ((1, 2), (2, 4)),
    ("wob", "rv", "many", "2d"): ((4, 8), (8, 16)), ("bev", "pp", "tr", "2d"): ((2, 2), (1, 1)),
    ("bev", "pp", "avg", "1d"): ((8, 8), (4, 4)), ("none", "pp", "fc", "1d"): (None, (4, 4)),
    ("bev", "none", "tr", "1d"): ((2, 2), None),
}


def config_of(camera, lidar, fusion, latent):
    many = {"model.fusion.many_tokens": True} if fusion == "many" else {}
    return config_lib.override_all(presets.get("tiny"), {
        "model.camera": camera, "model.lidar": lidar, "model.fusion": "tr" if many else fusion, "model.latent": latent,
        "model.navigation": True, "model.convolution": "xla", **many}).model


@pytest.mark.parametrize("parts", MAPS)
def test_maps_and_embedding(parts):
    config = config_of(*parts)
    image_cells, lidar_cells = MAPS[parts]
    channels = config.fusion.map_channels if parts[2] in ("fc", "avg") else config.fusion.token_channels
    frames = {name: jax.ShapeDtypeStruct((3, *shape), BATCH_FIELDS[name][0])
              for name, shape in world_model.inputs(config).items()}

    network, variables = world_model.Network(config), world_model.WorldModel(config).variable_shapes()
    embedding, seen = jax.eval_shape(lambda variables, frames: network.apply(
        variables, frames, norm.Mode(), None, method="encode", mutable=["intermediates"],
        capture_intermediates=lambda module, _: module.name in ("camera", "lidar")), variables, frames)
    for name, cells in (("camera", image_cells), ("lidar", lidar_cells)):
        assert (name in seen["intermediates"]) == (cells is not None)
        if cells is not None:
            assert seen["intermediates"][name]["__call__"][0].shape == (3, *cells, channels)
    if parts[3] == "1d":
        assert embedding.shape == (3, config.latent.embedding_channels)
    else:  # a token for each cell, and for route, both commands, the target and the speed
        tokens = sum(int(np.prod(cells)) for cells in MAPS[parts] if cells) + 5
        assert embedding.shape == (3, tokens, channels)
    assert embedding.dtype == jnp.float32


def test_images_are_normalised_by_imagenet_s_statistics():
    image = np.zeros((2, 3, 3), np.uint8)
    image[0], image[1] = np.round(255 * np.array(encoders.IMAGENET_MEAN)), 255
    got = encoders.normalise_image(jnp.asarray(image))
    assert np.abs(got[0]).max() < 0.5 / 255 / min(encoders.IMAGENET_STD)
    np.testing.assert_allclose(got[1, 0], (1 - np.array(encoders.IMAGENET_MEAN)) / encoders.IMAGENET_STD, rtol=1e-6)


def test_the_small_route_encoder_tells_left_from_right():
    config = config_lib.override(presets.get("tiny"), "model.route_encoder", "small").model
    encoder = encoders.ROUTE_ENCODERS["small"](config)
    route = np.zeros((2, 64, 64), np.uint8)
    route[0, 20:24, 8:12] = route[1, 20:24, 52:56] = 255
    shapes = jax.eval_shape(lambda: encoder.init(jax.random.key(0), jnp.asarray(route), norm.Mode()))["params"]
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: random.normal(size=leaf.shape).astype(np.float32), shapes)
    left, right = encoder.apply({"params": params}, jnp.asarray(route), norm.Mode())
    assert left.shape == (config.measurement_channels,) and np.abs(left - right).max() > 0.1


def test_a_command_out_of_range_is_the_nearest_one_under_jit_and_refused_where_it_is_at_hand():
    config = config_of("wob", "rv", "tr", "1d")
    encoder, commands = encoders.CommandEncoder(config), jnp.array([-1, 0, 5, 6])
    shapes = jax.eval_shape(lambda: encoder.init(jax.random.key(0), commands))["params"]
    params = jax.tree.map(lambda leaf: np.random.default_rng(0).normal(size=leaf.shape).astype(np.float32), shapes)
    got = jax.jit(encoder.apply)({"params": params}, commands)
    np.testing.assert_array_equal(got[::3], got[1:3])
    assert np.abs(got[0] - got[3]).max() > 0.1
    model = world_model.WorldModel(config)
    batch = Batch(action=np.zeros((1, 2, 2), np.float32), is_first=np.ones((1, 2), bool),
                  command=np.int32([[0, 5]]), next_command=np.int32([[0, 5]]))
    checks.observation("observe", model, batch)
    with pytest.raises(ValueError, match=r"observe: next_command \[1, 2\] holds 6; expected 0 to 5 \(left"):
        checks.observation("observe", model, batch.replace(next_command=jnp.array([[0, 6]])))
    jax.jit(lambda command: checks.observation("observe", model, batch.replace(command=command)))(np.int32([[6, -1]]))
