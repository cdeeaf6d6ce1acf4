"""One conformance suite for all doors; where a library is not installed its door is skipped (see .ci/run-agents)."""

import copy
import dataclasses
import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import HORIZON, MODEL, NO_COLLISION, make, variables, with_memory

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents.doors import dreamer, optional

ACTION = jnp.array([0.5, -0.2])


class GymnaxDoor:
    def __init__(self, made=None):
        pytest.importorskip("gymnax", reason="gymnax is not installed")
        from muvo_jax.agents.doors import gymnax_env
        core, self.params = made or make()
        self.env = gymnax_env.GymnaxImagination(core, self.params)

    def start(self, key):
        observation, state = self.env.reset(key, self.params)
        return observation, (key, state)

    def step(self, carry, action):
        """(observation that follows, final observation, reward, terminated, truncated), carry."""
        key, state = carry
        key, key_step = jax.random.split(key)
        observation, state, reward, terminated, truncated, info = self.env.step(key_step, state, action, self.params)
        return (observation, info["final_observation"], reward, terminated, truncated), (key, state)

    def spaces(self):
        return {name: space.shape for name, space in self.env.observation_space().spaces.items()}


class BraxDoor:
    def __init__(self, made=None):
        pytest.importorskip("brax", reason="brax is not installed")
        from muvo_jax.agents.doors import brax_env
        core, params = made or make()
        self.env = brax_env.BraxImagination(core, params)

    def start(self, key):
        state = self.env.reset(key)
        return state.obs, state

    def step(self, carry, action):
        state = self.env.step(carry, action)
        return (state.obs, state.obs, state.reward, state.done > 0, state.info["truncation"] > 0), state

    def spaces(self):
        return self.env.observation_size


class StoaDoor:
    def __init__(self, made=None):
        pytest.importorskip("stoa", reason="stoa-env is not installed")
        from muvo_jax.agents.doors import stoa_env
        core, params = made or make()
        self.env = stoa_env.StoaImagination(core, params)

    def start(self, key):
        state, timestep = self.env.reset(key)
        return timestep.observation, state

    def step(self, carry, action):
        state, timestep = self.env.step(carry, action)
        return (timestep.observation, timestep.observation, timestep.reward, timestep.terminated(),
                timestep.truncated()), state

    def spaces(self):
        return {name: space.shape for name, space in self.env.observation_space().spaces.items()}


DOORS = {"gymnax": GymnaxDoor, "brax": BraxDoor, "stoa": StoaDoor}


@pytest.fixture(scope="module", params=DOORS)
def door(request):
    return DOORS[request.param]()


def raw_or_typed(door, seed):
    return jax.random.PRNGKey(seed) if isinstance(door, BraxDoor) else jax.random.key(seed)


def rollout(door, key):
    observation, carry = door.start(key)
    step = jax.jit(door.step)
    results = []
    for _ in range(HORIZON):
        result, carry = step(carry, ACTION)
        results.append(result)
    return observation, results, carry


def test_an_episode_is_deterministic_and_truncated_at_the_horizon(door):
    observation, results, _ = rollout(door, raw_or_typed(door, 0))
    assert observation.shape == (MODEL.policy_feature_channels,) and observation.dtype == jnp.float32
    assert [bool(result[4]) for result in results] == [False, False, True]
    assert not any(bool(result[3]) for result in results)
    assert all(np.isfinite(result[2]) for result in results)
    again = rollout(door, raw_or_typed(door, 0))[1]
    np.testing.assert_array_equal(results[-1][1], again[-1][1])
    other = rollout(door, raw_or_typed(door, 1))[1]
    assert not np.allclose(results[-1][1], other[-1][1])


def test_a_door_vmaps(door):
    keys = jax.vmap(jax.random.key)(jnp.arange(4))
    if isinstance(door, BraxDoor):
        keys = jax.random.key_data(keys)
    observation, carry = jax.vmap(door.start)(keys)
    (following, _, reward, _, _), _ = jax.jit(jax.vmap(door.step, (0, None)))(carry, ACTION)
    assert observation.shape == following.shape == (4, MODEL.policy_feature_channels)
    assert reward.shape == (4,)
    _, carry_one = door.start(keys[2])
    np.testing.assert_allclose(door.step(carry_one, ACTION)[0][0], following[2], atol=1e-5)


def test_gymnax_restarts_by_itself_and_lets_gradients_through_on_demand():
    door = GymnaxDoor()
    _, results, (_, state) = rollout(door, jax.random.key(0))
    assert state.time == 0 and not np.allclose(results[-1][0], results[-1][1])
    env = door.env.with_transition_gradients()
    _, state = env.reset(jax.random.key(0), door.params)
    following = lambda env, action: env.step(jax.random.key(1), state, action, door.params)[0].sum()
    assert np.abs(jax.grad(lambda action: following(env, action))(ACTION)).max() > 0
    assert np.abs(jax.grad(lambda action: following(door.env, action))(ACTION)).max() == 0
    assert env.action_space().contains(ACTION) and env.observation_space().shape == (MODEL.policy_feature_channels,)


def test_brax_wrappers_truncate_and_reset():
    door = BraxDoor()
    training = pytest.importorskip("brax.envs.wrappers.training")
    env = training.wrap(door.env, episode_length=door.env.episode_length)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    step = jax.jit(env.step)
    for _ in range(HORIZON):
        state = step(state, jnp.stack([ACTION] * 2))
    assert state.done.tolist() == [1, 1] and state.info["truncation"].tolist() == [1, 1]
    np.testing.assert_allclose(state.obs, state.info["first_obs"])


@pytest.fixture(scope="module")
def of_sensors():
    """A Gymnasium environment that observes decoded sensors and renders."""
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    from muvo_jax.agents.doors import gymnasium_env
    return gymnasium_env.GymnasiumImagination(*make(observation=("image", "range_view")), render_mode="rgb_array")


def same(seen, other):
    return all(np.array_equal(seen[head], other[head]) for head in seen)


def test_gymnasium_agrees_with_its_own_checker(of_sensors):
    from gymnasium.utils import env_checker
    env_checker.check_env(of_sensors)
    of_sensors.reset(seed=3)
    ends = [of_sensors.step(np.array(ACTION))[2:4] for _ in range(HORIZON)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_gymnasium_drive_depends_on_its_seed_alone(of_sensors):
    def drive(seed):
        first, _ = of_sensors.reset(seed=seed)
        return first, of_sensors.step(np.array(ACTION))[0]

    (first, second), (again, after), others = drive(3), drive(3), [drive(seed)[1] for seed in range(4)]
    assert same(first, again) and same(second, after)
    assert any(not same(second, other) for other in others)


def test_a_gymnasium_space_holds_whatever_is_observed(of_sensors):
    space, actions = of_sensors.observation_space, np.random.default_rng(0).uniform(-1.5, 1.5, (40, 2))
    for index, action in enumerate(actions):
        if index % HORIZON == 0:
            assert space.contains(of_sensors.reset(seed=index)[0])
        assert space.contains(of_sensors.step(action)[0])
    assert {head: leaf.shape for head, leaf in space.items()}["image"] == (*MODEL.config.image_size, 3)


def test_gymnasium_renders_the_decoded_camera(of_sensors):
    observation, _ = of_sensors.reset(seed=1)
    picture = of_sensors.render()
    assert picture.dtype == np.uint8
    np.testing.assert_allclose(picture, 255 * np.clip(observation["image"], 0, 1), atol=0.51)
    from muvo_jax.agents.doors import gymnasium_env
    core, params = make()
    assert gymnasium_env.GymnasiumImagination(core, params).render() is None
    with pytest.raises(ValueError, match=r"render_mode is 'human'; expected 'rgb_array' or None"):
        gymnasium_env.GymnasiumImagination(core, params, render_mode="human")
    blind = dataclasses.replace(core, model=with_memory()[0])
    with pytest.raises(ValueError, match=r"this run trained occupancy, action\. Train the head \(--with-heads=image"):
        gymnasium_env.GymnasiumImagination(blind, params, render_mode="rgb_array")


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_gymnasium_environment_copied_mid_drive_goes_on_alike(of_sensors, copied):
    of_sensors.reset(seed=1)
    of_sensors.step(np.array(ACTION))
    twin = copied(of_sensors)
    (seen, reward, *_), (other, other_reward, *_) = of_sensors.step(np.array(ACTION)), twin.step(np.array(ACTION))
    assert same(seen, other) and reward == other_reward
    np.testing.assert_array_equal(of_sensors.render(), twin.render())


def test_stoa_wrappers_reset_and_keep_the_final_observation():
    door = StoaDoor()
    from stoa.core_wrappers import auto_reset
    env = auto_reset.AutoResetWrapper(door.env, next_obs_in_extras=True)
    state, timestep = env.reset(jax.random.key(0))
    assert timestep.first()
    step = jax.jit(env.step)
    for _ in range(HORIZON):
        state, timestep = step(state, ACTION)
    assert timestep.truncated() and timestep.discount == 1 and state.core.time == 0
    assert not np.allclose(timestep.observation, timestep.extras["next_obs"])
    env.environment_space()


def test_the_functional_environment_runs_in_gymnasiums_wrapper():
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    from gymnasium.envs.functional_jax_env import FunctionalJaxEnv

    from muvo_jax.agents.doors import gymnasium_env
    env = FunctionalJaxEnv(gymnasium_env.FunctionalImagination(*make()), metadata={"render_modes": ["rgb_array"]},
                           render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert env.render().shape == (*MODEL.config.image_size, 3)
    env.close()
    following, reward, terminated, truncated, _ = env.step(ACTION)
    assert observation.shape == following.shape == (MODEL.policy_feature_channels,)
    assert np.isfinite(reward) and not terminated and not truncated


@pytest.mark.parametrize("sampled", [False, True])
def test_mctx_searches_in_imagination(sampled):
    mctx = pytest.importorskip("mctx", reason="mctx is not installed")
    from muvo_jax.agents.doors import mctx_model
    core, params = make()
    params = dataclasses.replace(params, temperature=jnp.float32(0))
    grid = mctx_model.action_grid(3, 3)
    assert grid.shape == (9, 2)

    def candidates(agent, key, observation):
        return jax.random.uniform(key, (6, 2), minval=-1), jnp.zeros(6), agent * observation.sum()

    prior = candidates if sampled else mctx_model.on_grid(grid, lambda agent, observation: (jnp.zeros(9), agent))
    model = mctx_model.MctxModel(core, prior)
    search_params = mctx_model.SearchParams(params, jnp.float32(0))

    @jax.jit
    def search(key):
        _, state = jax.vmap(core.reset, (0, None))(jax.random.split(key, 2), params)
        root = model.root(search_params, key, state)
        output = mctx.gumbel_muzero_policy(search_params, key, root, model.recurrent_fn, num_simulations=8)
        return model.action(root, output.action), output.action_weights

    action, weights = search(jax.random.key(0))
    assert action.shape == (2, 2) and np.abs(action).max() <= 1
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-5)


def test_dreamers_features_are_what_the_actions_were_chosen_on():
    _, params = make()
    policy = lambda key, features: jnp.tanh(features[:2])
    last, features, actions = dreamer.Dreamer(MODEL, variables(), sampled=False).imagine(
        jax.random.key(0), params.bank.latent, policy, 3)
    assert features.shape[:2] == actions.shape[:2] == (params.bank.size, 3)
    np.testing.assert_allclose(features[:, 0], params.bank.latent.features)
    np.testing.assert_allclose(actions, jnp.tanh(features[..., :2]), atol=1e-6)
    assert last.stochastic.shape == params.bank.latent.stochastic.shape


def test_a_missing_library_names_its_extra():
    with pytest.raises(ImportError, match=r"pip install 'muvo_jax\[gymnax\]'"):
        optional.need("a_library_that_does_not_exist", "gymnax")


@pytest.mark.parametrize("name", DOORS)
def test_decoded_sensors_come_by_head_and_no_state_holds_or_gathers_memory(name):
    """Of a model that remembers what was seen; nothing is computed, shapes are all."""
    pytest.importorskip(name)  # not first inside a trace: stoa makes arrays when it is imported
    model, starts, _ = with_memory(heads=("image", "range_view", "action"))
    core = environment_lib.Environment(model, periods=2, reward_config=NO_COLLISION,
                                       observation=("image", "range_view"))

    def drive(variables):
        door = DOORS[name]((core, core.params(variables, starts, HORIZON)))
        observation, first = door.start(raw_or_typed(door, 0))
        (following, *_), second = door.step(first, ACTION)
        assert {head: leaf.shape for head, leaf in observation.items()} == door.spaces()
        return observation, following, first, second

    observation, following, first, second = jax.eval_shape(drive, model.variable_shapes())
    shapes = lambda tree: jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)
    assert observation["image"].shape == (*model.config.image_size, 3)
    assert shapes(first) == shapes(second) and shapes(observation) == shapes(following)
    numbers = lambda tree: sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))
    latent = numbers(model.initial_state(1))
    assert numbers(starts.memory) > 10 * (latent + 40)
    # the latent, the car, key and terms, and in brax's state the observation; no weights, memory or bank
    assert numbers(first) <= latent + 40 + (numbers(observation) if name == "brax" else 0)


def test_a_library_that_is_first_imported_inside_a_trace_leaves_nothing_of_it(tmp_path, monkeypatch):
    (tmp_path / "makes_arrays.py").write_text("import jax.numpy as jnp\nONE = jnp.array(1, jnp.int8)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert jax.jit(lambda: optional.need("makes_arrays", "x").ONE + 1)() == 2
    assert int(optional.need("makes_arrays", "x").ONE) == 1


def test_gymnax_refuses_what_is_no_number_before_it_compiles():
    pytest.importorskip("gymnax", reason="gymnax is not installed")
    from muvo_jax.agents.doors import gymnax_env
    world, params = make()
    door = gymnax_env.GymnaxImagination(world, params)
    _, state = door.reset(jax.random.key(0), params)
    with pytest.raises(ValueError, match=r"GymnaxImagination\.step: action \[2\] holds 1 values that are not finite"):
        door.step(jax.random.key(1), state, np.array([np.nan, 0.0]), params)


def test_a_door_of_one_car_refuses_horizons_of_several():
    world, params = make()
    several = dataclasses.replace(params, max_steps_in_episode=jnp.array([3, 4]))
    with pytest.raises(ValueError, match=r"BraxImagination: max_steps_in_episode is \[2\], expected one number"):
        BraxDoor((world, several))
    optional.one_horizon("GymnasiumImagination", params)
