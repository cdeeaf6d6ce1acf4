"""Observing, imagining and decoding: shapes, randomness, gradients, compilation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import checks, rollout, world_model
from muvo_jax.types import Batch, LatentState

CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
BATCH, FRAMES, HORIZON = 2, 3, 4


def make_batch(batch_size=BATCH, frames=FRAMES, seed=0):
    random = np.random.default_rng(seed)
    range_size = (CONFIG.range_view.rows, CONFIG.range_view.columns)
    return Batch(
        action=random.uniform(-1, 1, (batch_size, frames, 2)).astype(np.float32),
        is_first=np.broadcast_to(np.arange(frames)[None] == 0, (batch_size, frames)),
        image=random.integers(0, 256, (batch_size, frames, *CONFIG.image_size, 3), np.uint8),
        range_view=random.uniform(-20, 20, (batch_size, frames, *range_size, 4)).astype(np.float32),
        route_map=random.integers(0, 256, (batch_size, frames, 64, 64), np.uint8),
        speed_mps=random.uniform(0, 10, (batch_size, frames)).astype(np.float32))


@pytest.fixture(scope="module")
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


@pytest.fixture(scope="module")
def state():
    draw = lambda seed, channels: jax.random.normal(jax.random.key(seed), (BATCH, channels))
    sizes = CONFIG.latent
    return LatentState(jnp.tanh(draw(1, sizes.deterministic_channels)), draw(2, sizes.stochastic_channels))


@pytest.fixture(scope="module")
def actions():
    return jax.random.uniform(jax.random.key(3), (BATCH, HORIZON, 2), minval=-1.0)


def assert_close(first, second, tolerance=1e-5):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=tolerance, rtol=1e-4), first, second)


def test_observe_shapes_and_determinism(variables):
    batch, key = make_batch(), jax.random.key(5)
    observed = rollout.observe(MODEL, variables, key, batch)
    assert observed.states.deterministic.shape == (BATCH, FRAMES, CONFIG.latent.deterministic_channels)
    moments = (BATCH, FRAMES, CONFIG.latent.stochastic_channels)
    assert observed.prior.mean.shape == observed.posterior.std.shape == moments
    assert_close(observed, rollout.observe(MODEL, variables, key, batch), 0)
    other = rollout.observe(MODEL, variables, jax.random.key(6), batch)
    assert not np.allclose(observed.states.stochastic, other.states.stochastic)


def test_mean_mode_ignores_the_key_and_returns_the_mean(variables, state, actions):
    batch = make_batch()
    first = rollout.observe(MODEL, variables, jax.random.key(5), batch, sampled=False)
    assert_close(first, rollout.observe(MODEL, variables, jax.random.key(6), batch, sampled=False), 0)
    np.testing.assert_array_equal(first.states.stochastic, first.posterior.mean)
    dream = rollout.imagine(MODEL, variables, jax.random.key(7), state, actions, sampled=False)
    np.testing.assert_array_equal(dream.states.stochastic, dream.prior.mean)


def test_a_samples_noise_depends_on_its_key_alone(variables):
    keys = jax.random.split(jax.random.key(8), BATCH)
    whole = rollout.observe(MODEL, variables, keys, make_batch())
    swapped = jax.tree.map(lambda leaf: leaf[::-1], make_batch())
    assert_close(rollout.observe(MODEL, variables, keys[::-1], swapped)[0], whole[1])
    noise = rollout.draw_noise(keys, 5, (3,), 0.5)
    assert_close(rollout.draw_noise(keys[1:], 2, (3,), 0.5), noise[1:, :2], 0)


def test_noise_is_standard_normal_and_its_coin_fair():
    noise = rollout.draw_noise(jax.random.split(jax.random.key(9), 20), 50, (40,), 0.15)
    for drawn in (noise.prior, noise.posterior):
        np.testing.assert_allclose([drawn.mean(), drawn.std()], [0, 1], atol=0.02)
    assert abs(np.corrcoef(noise.prior.ravel(), noise.posterior.ravel())[0, 1]) < 0.02
    np.testing.assert_allclose(noise.use_prior.mean(), 0.15, atol=0.04)
    assert noise.use_prior.any(0).any() and not noise.use_prior.all(0).any()  # a coin per sample, not per batch


def test_imagine_equals_a_loop_by_hand(variables, state, actions):
    dream = rollout.imagine(MODEL, variables, jax.random.key(0), state, actions, sampled=False)
    assert dream.states.stochastic.shape == (BATCH, HORIZON, CONFIG.latent.stochastic_channels)
    np.testing.assert_array_equal(dream.actions, actions)
    current = state
    for step in range(HORIZON):
        current, prior = MODEL.imagine_step(variables, jnp.zeros_like(state.stochastic), current, actions[:, step])
        assert_close((dream.states[:, step], dream.prior[:, step]), (current, prior))


def test_imagine_is_imagine_step_again_and_again(variables, state, actions):
    keys = jax.random.split(jax.random.key(4), BATCH)
    fold = jax.vmap(jax.random.fold_in, (0, None))
    for options in ({}, {"temperature": 0.5}, {"sampled": False}):
        dream = rollout.imagine(MODEL, variables, keys, state, actions, **options)
        current = state
        for step in range(HORIZON):
            current = rollout.imagine_step(MODEL, variables, fold(fold(keys, step), 0), current, actions[:, step],
                                           **options)
        assert_close(dream.states[:, -1], current)


def test_imagine_step_takes_any_leading_axes_and_compiles_once(variables, state, actions):
    step = lambda key, state, action: rollout.imagine_step(MODEL, variables, key, state, action)
    one = step(jax.random.key(1), state[0], actions[0, 0])
    assert one.stochastic.shape == (CONFIG.latent.stochastic_channels,)
    before = rollout._imagine_one._cache_size()
    for seed in (2, 3):
        other = step(jax.random.key(seed), state[0], actions[0, 1])
    assert rollout._imagine_one._cache_size() == before and not np.allclose(one.stochastic, other.stochastic)
    keys = jax.random.split(jax.random.key(4), BATCH)
    many = jax.vmap(step)(keys, state, actions[:, 0])
    assert_close(many, step(jax.vmap(jax.random.fold_in, (0, None))(keys, 0), state, actions[:, 0]))
    with pytest.raises(ValueError, match=r"imagine_step: got action \[2\], expected \[2, 2\]"):
        step(jax.random.key(1), state, actions[0, 0])
    with pytest.raises(ValueError, match="reach from 3 to 3"):
        step(jax.random.key(1), state, np.full((BATCH, 2), 3.0))


def test_actions_on_a_device_are_clipped_there_and_never_looked_at(variables, state, monkeypatch):
    step = lambda action: rollout.imagine_step(MODEL, variables, jax.random.key(1), state, action)
    largest = step(np.ones((BATCH, 2), np.float32))
    monkeypatch.setattr(checks, "action_values", lambda *_: pytest.fail("the host waited for the device"))
    assert_close(step(jnp.full((BATCH, 2), 3.0)), largest)


def test_branches_are_independent_futures(variables, state, actions):
    fan = jnp.stack([actions, -actions, actions], axis=1)
    dream = rollout.imagine(MODEL, variables, jax.random.key(1), state, fan, sampled=False)
    assert dream.features.shape == (BATCH, 3, HORIZON, *MODEL.feature_shape)
    assert_close(dream[:, 0], dream[:, 2])
    assert_close(dream[:, 1], rollout.imagine(MODEL, variables, jax.random.key(1), state, -actions, sampled=False))
    sampled = rollout.imagine(MODEL, variables, jax.random.key(1), state, actions, branches=3)
    assert sampled.states.stochastic.shape == (BATCH, 3, HORIZON, CONFIG.latent.stochastic_channels)
    assert not np.allclose(sampled.states.stochastic[:, 0], sampled.states.stochastic[:, 1])


def test_a_policy_drives_from_the_features(variables, state):
    steer = lambda key, features: jnp.tanh(features[:2]) + 0.0 * jax.random.uniform(key, (2,))
    dream = rollout.imagine(MODEL, variables, jax.random.key(2), state, steer, horizon=2, branches=2)
    np.testing.assert_allclose(dream.actions[:, 1, 0], jnp.tanh(state.features[:, :2]), atol=1e-6)
    np.testing.assert_allclose(dream.actions[:, :, 1], jnp.tanh(dream.features[:, :, 0, :2]), atol=1e-6)


def test_the_learned_policy_is_the_action_head(variables, state):
    dream = rollout.imagine(MODEL, variables, jax.random.key(2), state, rollout.learned_policy(MODEL, variables),
                            horizon=2)
    np.testing.assert_allclose(dream.actions[:, 0], rollout.decode(MODEL, variables, state, ("action",)).action,
                               atol=1e-6)


def test_the_learned_policy_compiles_once_whatever_its_weights(variables, state):
    drive = lambda weights: rollout.imagine(MODEL, variables, jax.random.key(2), state,
                                            rollout.learned_policy(MODEL, weights), horizon=2)
    first = drive(variables)
    before = rollout._imagine._cache_size()
    drive(variables)
    other = drive(jax.tree.map(lambda leaf: 2 * leaf, variables))
    assert rollout._imagine._cache_size() == before
    assert not np.allclose(first.actions, other.actions)


def test_gradients_reach_actions_and_the_start_state(variables, state, actions):
    def target(actions, state):
        dream = rollout.imagine(MODEL, variables, jax.random.key(3), state, actions)
        return rollout.decode(MODEL, variables, dream.states[:, -1], ("action",)).action.sum()

    by_action, by_state = jax.grad(target, argnums=(0, 1))(actions, state)
    # The action does not enter the recurrence, but its sample does: every step counts.
    assert (np.abs(by_action).max(axis=(0, 2)) > 0).all()
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(by_state))


def test_one_compilation_for_equal_shapes(variables, state, actions):
    before = rollout._imagine._cache_size()
    policy = lambda weight, key, features: jnp.tanh(weight * features[:2])
    for value in range(3):
        rollout.imagine(MODEL, variables, jax.random.key(value), state, 0.1 * value * actions[:, :3])
    assert rollout._imagine._cache_size() == before + 1
    for value in range(3):
        driver = jax.tree_util.Partial(policy, jnp.float32(value))
        rollout.imagine(world_model.WorldModel(CONFIG), variables, jax.random.key(value), state, driver, horizon=3)
    assert rollout._imagine._cache_size() == before + 2


def test_heads_that_nobody_decodes_cost_imagining_nothing():
    """The compiled program, and so its time and memory, is that of a model without them; nothing in it is voxels."""
    def program(heads):
        model = world_model.WorldModel(dataclasses.replace(CONFIG, heads=heads))
        shapes = jax.eval_shape(lambda: (jax.random.key(0), model.initial_state(BATCH), jnp.zeros((BATCH, HORIZON, 2))))
        run = jax.jit(lambda *arguments: rollout.imagine(model, *arguments, branches=3))
        return run.lower(model.variable_shapes(), *shapes)

    whole = program(("image", "range_view", "occupancy", "action"))
    assert whole.as_text() == program(("action",)).as_text()
    states = 3 * BATCH * HORIZON * 4 * MODEL.feature_shape[0]
    assert whole.compile().memory_analysis().temp_size_in_bytes < 16 * states


def test_training_windows_use_dropout_and_update_statistics(variables):
    batch, keys = make_batch(), jax.random.split(jax.random.key(4), BATCH)
    # A fresh fusion transformer hands its tokens through: its dropouts show once it was trained.
    random = np.random.default_rng(0)
    move = lambda leaf: leaf + 0.1 * random.normal(size=leaf.shape).astype(np.float32)
    variables = {**variables, "params": jax.tree.map(move, variables["params"])}
    window = jax.jit(rollout.observe_window, static_argnums=0, static_argnames=("train", "sampled"))
    first, stats = window(MODEL, variables, batch, keys, train=True, sampled=False)
    again, _ = window(MODEL, variables, batch, keys, train=True, sampled=False)
    assert_close(first, again, 0)
    moved = jax.tree.map(lambda new, old: bool(np.abs(new - old).max() > 0), stats, variables["batch_stats"])
    assert all(jax.tree.leaves(moved))
    other, _ = window(MODEL, variables, batch, jax.random.split(jax.random.key(5), BATCH), train=True, sampled=False)
    assert not np.allclose(first.posterior.mean, other.posterior.mean)  # in mean mode, dropout alone can differ


@pytest.mark.parametrize("arguments, message", [
    ({"actions_or_policy": np.zeros((BATCH, 2), np.float32)}, r"expected \[2, H, 2\]"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "horizon": 4}, "horizon=4, but there are 3"),
    ({"actions_or_policy": np.zeros((BATCH, 5, 3, 2), np.float32), "branches": 4}, "branches=4, but the actions"),
    ({"actions_or_policy": lambda key, features: features[:2]}, "needs a horizon"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "key": jax.random.split(jax.random.key(0), 5)},
     "one typed key"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "key": jax.random.PRNGKey(0)}, "one typed key"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "key": 7}, "got the key 7, expected one typed key"),
    ({"actions_or_policy": np.zeros((0, 3, 2), np.float32),
      "state": LatentState(np.zeros((0, 16), np.float32), np.zeros((0, 8), np.float32))},
     r"state: got states with the leading axes \[0\], expected at least one"),
])
def test_misfits_are_refused(variables, state, arguments, message):
    with pytest.raises(ValueError, match=message):
        rollout.imagine(MODEL, variables, **{"key": jax.random.key(0), "state": state} | arguments)


@pytest.mark.parametrize("arguments, message", [
    ({"actions_or_policy": np.full((BATCH, 3, 2), 1.5, np.float32)}, r"\[2, 3, 2\] reach from 1.5 to 1.5"),
    ({"actions_or_policy": np.full((BATCH, 3, 2), np.nan, np.float32)}, "12 values of the actions"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 3), np.float32)}, r"got actions \[2, 3, 3\]"),
    ({"actions_or_policy": np.zeros((BATCH, 0, 2), np.float32)}, "horizon is 0"),
    ({"actions_or_policy": lambda key, features: features[:2], "horizon": 0}, "horizon is 0"),
    ({"actions_or_policy": lambda key, features: features[:2], "horizon": 2, "branches": 0}, "branches is 0"),
    ({"actions_or_policy": lambda key, features: features[:3], "horizon": 2}, r"policy returned float32\[3\]"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "state": LatentState(np.zeros((2, 16)),
                                                                                     np.zeros((2, 9)))},
     r"state.stochastic: got \[2, 9\], expected \[..., 8\]"),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32),
      "state": LatentState(jnp.zeros((2, 16), jnp.bfloat16), np.zeros((2, 8), np.int32))},
     r"state.deterministic: got bfloat16\[2, 16\], expected float32; cast it, state.replace\(deterministic="),
    ({"actions_or_policy": np.zeros((BATCH, 3, 2), np.float32), "temperature": jnp.ones(8)},
     r"imagine: got temperature \[8\], expected one number for all; .* jax.vmap"),
])
def test_bad_input_is_refused(variables, state, arguments, message):
    with pytest.raises(ValueError, match=message):
        rollout.imagine(MODEL, variables, **{"key": jax.random.key(0), "state": state} | arguments)


def test_a_batch_of_nothing_is_refused():
    for batch, came in ((make_batch()[:0], "0 windows of 3"), (make_batch().time_slice(0, 0), "2 windows of 0")):
        with pytest.raises(ValueError, match=f"observe: got a batch of {came} frames, expected at least one"):
            rollout.observe(MODEL, {}, jax.random.key(0), batch)


@pytest.mark.parametrize("field, change, message", [
    ("action", lambda action: action * 0 + 30, r"observe: actions \[2, 3, 2\] reach from 30 to 30, expected \[-1, 1\]"),
    ("action", lambda action: action * 0 + 1.0011, "reach from 1.0011"),
    ("speed_mps", lambda speed: speed + 1e30, r"observe: speed_mps \[2, 3\] reaches from 1e\+30 .* at most 10000 m/s"),
    ("range_view", lambda view: view - 2e4, r"observe: range_view .* at most 10000 m either way"),
])
def test_observations_that_cannot_be_are_refused(field, change, message):
    batch = make_batch()
    with pytest.raises(ValueError, match=message):
        rollout.observe(MODEL, {}, jax.random.key(0), batch.replace(**{field: change(getattr(batch, field))}))


def test_cameras_that_cannot_be_are_refused_and_what_readers_let_through_is_not():
    batch = make_batch()
    intrinsics, camera = np.stack([np.float32(np.diag([30.0, 30.0, 1.0]))] * BATCH), np.stack([np.eye(4)] * BATCH)
    read = {"points": np.full((1, 1, 2, 3), np.float32([[1.0], [1e9]])), "point_count": np.int32([[1]])}
    checks.plausible("observe", {"intrinsics": intrinsics, "camera_to_ego": camera} | read)
    checks.action_values(np.float32(1.001) * np.sign(batch.action), "observe", checks._RECORDED)
    with pytest.raises(ValueError, match=r"points \[1, 1, 2, 3\] reaches"):
        checks.plausible("observe", read | {"point_count": np.int32([[2]])})
    with pytest.raises(ValueError, match=r"intrinsics of window 1 have the focal lengths \[30.0, 0.0\] px"):
        checks.plausible("observe", {"intrinsics": intrinsics * np.float32([[[1]] * 3, [[1], [0], [1]]])})
    sheared = camera.copy()
    sheared[0, 0, 1] = 5.0
    for wrong in (camera * 0, sheared, camera * np.float32([-1, 1, 1, 1])):
        with pytest.raises(ValueError, match=r"camera_to_ego of window 0 has \[\[.* expected a rotation"):
            checks.plausible("observe", {"camera_to_ego": wrong})


def test_one_name_is_no_sequence_of_heads(state):
    with pytest.raises(ValueError, match=r"heads is 'image'; expected a sequence of names, \('image',\)"):
        rollout.decode(MODEL, {}, state, "image")
    with pytest.raises(ValueError, match=r"decode: got features \[0, 24\], expected at least one state"):
        rollout.decode(MODEL, {}, state[:0])


def test_a_temperature_for_each_state_is_mapped(variables, state, actions):
    dream = lambda state, actions, temperature: rollout.imagine(
        MODEL, variables, jax.random.key(1), state, actions, temperature=temperature).states.stochastic
    cold, warm = jax.vmap(dream)(state, actions, jnp.float32([0.0, 1.0]))
    assert_close(cold, dream(state[0], actions[0], 0.0))
    assert_close(warm, dream(state[1], actions[1], 1.0))
    with pytest.raises(ValueError, match=r"imagine_step: got temperature \[2\]"):
        rollout.imagine_step(MODEL, variables, jax.random.key(1), state, actions[:, 0], temperature=jnp.ones(2))


@pytest.mark.parametrize("latent", ["1d", "2d"])
def test_windows_and_dreams_are_shared_by_devices(latent):
    """Under jax.shard_map as it is by default, which checks over which axes of the mesh a value varies."""
    config = config_lib.override_all(presets.get("tiny"), {
        "model.latent": latent, "model.camera": "none", "model.route": False, "model.heads": ("action",)})
    model, batch = world_model.WorldModel(config.model), make_batch().replace(image=None, route_map=None)
    mesh = jax.make_mesh((2,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    each = jax.sharding.PartitionSpec("data")

    def both(variables, keys, batch):
        observed = rollout.observe(model, variables, keys, batch)
        start = model.initial_state(batch.batch_size)  # the same on every device, unlike what follows
        return observed.states, rollout.imagine(model, variables, keys, start, batch.action).states

    shared = jax.shard_map(both, mesh=mesh, in_specs=(jax.sharding.PartitionSpec(), each, each), out_specs=each)
    keys = jax.random.split(jax.random.key(1), BATCH)
    shapes = jax.eval_shape(shared, model.variable_shapes(), keys, batch)
    assert shapes == jax.eval_shape(both, model.variable_shapes(), keys, batch)
    if latent == "1d":
        variables = model.init(jax.random.key(0))
        assert_close(jax.jit(shared)(variables, keys, batch), jax.jit(both)(variables, keys, batch))


def test_a_dream_from_every_frame_is_the_dream_from_each(variables, actions):
    observed = rollout.observe(MODEL, variables, jax.random.key(5), make_batch(frames=HORIZON))
    plans = jnp.stack([actions] * HORIZON, axis=1)  # [B, T, H, 2]
    keys = jax.random.split(jax.random.key(6), (BATCH, HORIZON))
    dream = rollout.imagine(MODEL, variables, keys, observed.states, plans)
    assert dream.features.shape == (BATCH, HORIZON, HORIZON, *MODEL.feature_shape)
    assert_close(dream[:, 1], rollout.imagine(MODEL, variables, keys[:, 1], observed.states[:, 1], actions))
    one = rollout.imagine(MODEL, variables, keys[0, 1], observed.states[0, 1], actions[0])
    assert one.actions.shape == (HORIZON, 2)


def test_temperature_and_shared_noise(variables, state, actions):
    fan = jnp.stack([actions, actions, -actions], axis=1)
    cold = rollout.imagine(MODEL, variables, jax.random.key(1), state, fan, temperature=0.0)
    assert_close(cold, rollout.imagine(MODEL, variables, jax.random.key(1), state, fan, sampled=False))
    shared = rollout.imagine(MODEL, variables, jax.random.key(1), state, fan, same_noise=True)
    assert_close(shared[:, 0], shared[:, 1], 0)
    assert not np.allclose(shared.states.stochastic[:, 0], shared.states.stochastic[:, 2])


def test_transforms_from_outside_agree(variables, state, actions):
    dream = lambda key, state, actions: rollout.imagine(MODEL, variables, key, state, actions, sampled=False).features
    key = jax.random.key(0)
    want = dream(key, state, actions)
    assert_close(jax.jit(dream)(key, state, actions), want)
    assert_close(jax.vmap(dream, (None, 0, 0))(key, state, actions), want)
    policy = lambda weight, key, features: jnp.tanh(weight @ features)
    roll = lambda weight: rollout.imagine(MODEL, variables, key, state, jax.tree_util.Partial(policy, weight),
                                          horizon=2).features.sum()
    weight = jnp.full((2, *MODEL.feature_shape), 0.01)
    assert np.abs(jax.grad(roll)(weight)).max() > 0


def test_forward_mode_reaches_decoded_images_with_plain_convolutions(variables, state, actions):
    plain = world_model.WorldModel(dataclasses.replace(CONFIG, convolution="xla"))

    def image(scale):
        dream = rollout.imagine(plain, variables, jax.random.key(0), state, scale * actions, sampled=False)
        return rollout.decode(plain, variables, dream.states[:, -1], ("image",)).at_scale(4).image.sum()

    _, tangent = jax.jit(lambda scale: jax.jvp(image, (scale,), (jnp.ones(()),)))(jnp.float32(0.5))
    np.testing.assert_allclose(tangent, jax.jit(jax.grad(image))(jnp.float32(0.5)), rtol=1e-3)
