"""Filtering a stream step by step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import checks, live, rollout, world_model
from muvo_jax.types import BATCH_FIELDS, Batch

CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
INPUTS = ("image", "range_view", "route_map", "speed_mps")


def make_batch(frames):
    random = np.random.default_rng(0)
    return Batch(
        action=random.uniform(-1, 1, (1, frames, 2)).astype(np.float32), is_first=np.arange(frames)[None] == 0,
        image=random.integers(0, 256, (1, frames, *CONFIG.image_size, 3), np.uint8),
        range_view=random.uniform(-20, 20, (1, frames, 32, 64, 4)).astype(np.float32),
        route_map=random.integers(0, 256, (1, frames, 64, 64), np.uint8),
        speed_mps=random.uniform(0, 10, (1, frames)).astype(np.float32))


def test_a_stream_ends_where_the_window_ends():
    variables = jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))
    batch, key = make_batch(3), jax.random.key(7)
    observed = rollout.observe(MODEL, variables, key, batch)
    stream = live.start_live(MODEL, key)
    before = live._observe_step._cache_size()
    for t in range(3):
        seen = {name: getattr(batch, name)[:, t] for name in INPUTS}
        stream = live.observe_step(MODEL, variables, stream, seen, batch.action[:, max(t - 1, 0)])
        np.testing.assert_allclose(stream.latent.features, observed.states[:, t].features, atol=1e-5)
    assert live._observe_step._cache_size() == before + 1
    assert stream.frame.tolist() == [3]


def test_a_stream_with_memory_may_start_from_zeros():
    """A sealed model's consumer knows shapes alone."""
    model = world_model.WorldModel(dataclasses.replace(CONFIG, first_guess=config_lib.LastSeen(), heads=("range_view",),
                                                       kinematics=config_lib.Kinematics()))
    variables, batch = jax.tree.map(jnp.asarray, model.init(jax.random.key(0))), make_batch(2)
    begun = live.start_live(model, jax.random.key(7))
    zeros = dataclasses.replace(begun, **{name: jax.tree.map(jnp.zeros_like, getattr(begun, name))
                                          for name in ("latent", "frame", "memory")})
    ends = []
    for stream in (begun, zeros):
        for t in range(2):
            seen = {name: getattr(batch, name)[:, t] for name in INPUTS}
            stream = live.observe_step(model, variables, stream, seen, batch.action[:, 0])
        ends.append(stream)
    assert (int(ends[0].latent.vantage.first[0]), int(ends[0].latent.vantage.last[0])) == (5, 6)
    jax.tree.map(np.testing.assert_array_equal, ends[0].latent, ends[1].latent)
    views = [rollout.decode(model, variables, end.latent, memory=end.memory).range_view for end in ends]
    np.testing.assert_array_equal(*views)


@pytest.mark.parametrize(("lidar", "camera"), [("pp", "wob"), ("rv", "bev")])
def test_every_sensor_encoder_can_be_streamed(lidar, camera):
    config = config_lib.override_all(presets.tiny(), {"model.lidar": lidar, "model.camera": camera}).model
    model = world_model.WorldModel(config)
    seen = {name: jax.ShapeDtypeStruct((1, *shape), BATCH_FIELDS[name][0])
            for name, shape in world_model.inputs(config).items()}
    step = lambda variables, seen: live.observe_step(model, variables, live.start_live(model, jax.random.key(0)), seen,
                                                     np.zeros((1, 2), np.float32)).latent.features
    assert jax.eval_shape(step, model.variable_shapes(), seen).shape == (1, *model.feature_shape)


@pytest.mark.parametrize("action, message", [
    (np.zeros((2, 2)), r"got previous_action \[2, 2\], expected \[1, 2\]"), ([[0, np.inf]], "not finite"),
    ([[0, -2]], "reach from -2 to 0")])
def test_bad_actions_are_refused(action, message):
    with pytest.raises(ValueError, match=message):
        live.observe_step(MODEL, {}, live.start_live(MODEL, jax.random.key(0)), {}, action)


def test_a_recorded_action_may_lie_a_rounding_beyond():
    """Readers let it pass, `observe` too: a recording can be replayed as a stream."""
    one = lambda **kind: checks.one_action(np.float32([[1.0005, -1.0005]]), (1,), "here", **kind)
    np.testing.assert_array_equal(one(recorded=True), [[1.0, -1.0]])
    with pytest.raises(ValueError, match=r"reach from -1\.0005 to 1\.0005"):
        one()


def test_missing_sensors_are_named():
    with pytest.raises(ValueError, match=r"Batch\.image is None"):
        live.observe_step(MODEL, {}, live.start_live(MODEL, jax.random.key(0)), {}, np.zeros((1, 2)))


@pytest.mark.parametrize("observation, message", [
    ({"imgae": 1}, r"has a field 'imgae'; .* Did you mean 'image'\?"),
    ({"action": 1}, "has a field 'action'; expected")])
def test_unknown_fields_are_named(observation, message):
    with pytest.raises(ValueError, match=message):
        live.observe_step(MODEL, {}, live.start_live(MODEL, jax.random.key(0)), observation, np.zeros((1, 2)))


@pytest.mark.parametrize("count", [0, -1, 1.5, True])
def test_streams_are_counted(count):
    with pytest.raises(ValueError, match=f"start_live: batch_size is {count}; expected a whole number of 1 or more"):
        live.start_live(MODEL, jax.random.key(0), count)
