"""The core environment: starts, steps, ends, observations."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import CONFIG, HORIZON, MODEL, NO_COLLISION, STARTS, bank, make, variables, with_memory

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax import run as run_lib
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import episodes, rewards
from muvo_jax.model import checks, rollout, world_model
from muvo_jax.types import Batch, Observed

ACTION = jnp.array([0.5, -0.2])


def test_an_episode_is_truncated_at_its_horizon_and_not_terminated():
    environment, params = make()
    observation, state = jax.jit(environment.reset)(jax.random.key(0), params)
    assert observation.shape == environment.observation_shapes.shape == (MODEL.policy_feature_channels,)
    plan = jnp.stack([ACTION] * HORIZON)
    _, transitions = environment_lib.play(environment, params, jax.random.key(1), state, plan, HORIZON)
    assert transitions.truncated.tolist() == [False, False, True]
    assert not transitions.terminated.any()
    again = environment_lib.play(environment, params, jax.random.key(1), state, plan, HORIZON)
    np.testing.assert_array_equal(again[1].reward, transitions.reward)


def test_without_noise_a_step_is_the_models_and_the_car_moves_by_its_kinematics():
    environment, params = make()
    params = dataclasses.replace(params, temperature=jnp.float32(0.0))
    _, state = environment.reset(jax.random.key(3), params)
    after, transition = jax.jit(environment.step)(jax.random.key(0), state, ACTION, params)
    dream = rollout.imagine(MODEL, variables(), jax.random.key(0), state.latent, ACTION[None], sampled=False)
    np.testing.assert_allclose(transition.observation, dream.features[0], atol=1e-5)
    start_mps = bank().speed_mps[state.start]
    np.testing.assert_allclose(after.motion.speed_mps, start_mps + 0.2 * 1.5, rtol=1e-5)
    np.testing.assert_allclose(transition.terms["progress_m"], 0.2 * (start_mps + 0.15), rtol=0.1)


def test_the_2d_latent_is_driven_by_a_policy_that_reads_one_vector():
    model = world_model.WorldModel(config_lib.override_all(presets.get("tiny"), {
        "model.latent": "2d", "model.heads": ("action",)}).model)
    draw = lambda leaf: jax.random.normal(jax.random.key(leaf.size), leaf.shape)
    starts = environment_lib.StartBank(jax.tree.map(draw, model.initial_state(STARTS)), bank().speed_mps,
                                       bank().route_map)
    environment = environment_lib.Environment(model, periods=2, reward_config=NO_COLLISION)
    params = environment.params(model.init(jax.random.key(0)), starts, horizon=2)
    observation, state = environment.reset(jax.random.key(1), params)
    assert observation.shape == (model.policy_feature_channels,) and len(model.feature_shape) == 2
    policy = jax.tree_util.Partial(lambda key, seen: jnp.tanh(seen[:2]))
    states, transitions = environment_lib.play(environment, params, jax.random.key(2), state, policy, 2)
    assert transitions.observation.shape == (2, model.policy_feature_channels)
    assert np.isfinite(transitions.reward).all() and states.time.tolist() == [1, 2]


def test_many_cars_restart_one_by_one_at_horizons_of_their_own():
    environment, params = make()
    keys = jax.random.split(jax.random.key(0), 6)
    _, states = jax.vmap(environment.reset, (0, None))(keys, params)
    assert len(np.unique(states.start)) > 1 and states.start.max() < STARTS
    states = dataclasses.replace(states, time=jnp.array([0, 1, 2, 2, 1, 0]))
    params = dataclasses.replace(params, max_steps_in_episode=jnp.array([3, 3, 3, 3, 9, 1]))
    mapped = environment_lib.EnvParams(None, None, 0, None)

    @jax.jit
    def advance(keys, states):
        after, transition = jax.vmap(environment.step, (0, 0, None, mapped))(keys, states, ACTION, params)
        return transition, jax.vmap(environment.restart, (0, 0, 0, 0, mapped))(
            keys, after, transition.observation, transition.final, params)

    transition, (after, seen) = advance(keys, states)
    assert transition.truncated.tolist() == [False, False, True, True, False, True]
    assert after.time.tolist() == [1, 2, 0, 0, 2, 0]
    assert not np.allclose(seen[2], transition.observation[2])
    np.testing.assert_array_equal(seen[0], transition.observation[0])


def test_gradients_reach_actions_and_a_predicted_collision_ends_the_drive():
    config = rewards.RewardConfig(terminal_collision=0.0, occupancy_scale=2)
    environment, params = make(reward_config=config)
    assert environment.decoded_heads == ("occupancy",)
    _, state = environment.reset(jax.random.key(0), params)

    def total(actions):
        _, transitions = environment_lib.play(environment, params, jax.random.key(1), state, actions, 2)
        return transitions.reward.sum(), transitions

    (_, transitions), gradient = jax.value_and_grad(total, has_aux=True)(jnp.zeros((2, 2)))
    assert transitions.terminated.all() and not transitions.truncated.any()
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0


def test_by_default_a_model_at_even_odds_ends_no_drive():
    environment, params = make(reward_config=rewards.RewardConfig())
    params = dataclasses.replace(params, variables=jax.tree.map(jnp.zeros_like, params.variables))
    _, states = jax.jit(jax.vmap(environment.reset, (0, None)))(jax.random.split(jax.random.key(0), 4), params)
    _, transitions = jax.jit(jax.vmap(environment.step, (0, 0, None, None)))(
        jax.random.split(jax.random.key(1), 4), states, ACTION, params)
    np.testing.assert_allclose(transitions.terms["collision"], 0.5, atol=1e-3)
    assert not transitions.terminated.any()
    first = jax.tree.map(lambda leaf: leaf[0], states)
    states, transitions = environment_lib.play(environment, params, jax.random.key(1), first, jnp.zeros((9, 2)), 9)
    assert not transitions.terminated.any()
    np.testing.assert_allclose(states.unharmed, (1.0 - 0.2 / 0.7) ** np.arange(1, 10), rtol=1e-2)
    assert transitions.reward.sum() > -20.0, "all contacts together cost no more than a crash"
    with pytest.raises(ValueError, match="holds the road"):
        make(reward_config=rewards.RewardConfig(occupancy_scale=4))


def test_the_bank_holds_every_frame_after_the_first_ones():
    states = jax.tree.map(lambda leaf: jnp.stack([leaf[:3], leaf[2:]]), bank().latent)
    batch = Batch(np.zeros((2, 3, 2), np.float32), np.zeros((2, 3), bool), speed_mps=np.arange(6.0).reshape(2, 3))
    made = environment_lib.Environment.starts(Observed(states, None, None), batch, skip=1)
    assert made.size == 4 and made.speed_mps.tolist() == [1, 2, 4, 5] and made.route_map is None
    with pytest.raises(ValueError, match="skip is 3"):
        environment_lib.Environment.starts(Observed(states, None, None), batch, skip=3)
    with pytest.raises(ValueError, match=r"observed states are \[B, T\] = \[2, 3\], the batch is \[1, 3\]"):
        environment_lib.Environment.starts(Observed(states, None, None), batch[:1])


def test_what_does_not_fit_is_refused():
    blind = world_model.WorldModel(dataclasses.replace(CONFIG, heads=("image", "action")))
    with pytest.raises(ValueError, match="read the head occupancy, but this run trained image, action"):
        environment_lib.Environment(blind)
    with pytest.raises(ValueError, match=r"observation is 'image', expected \"features\", \"road\" or a tuple"):
        dataclasses.replace(make()[0], observation="image")
    with pytest.raises(ValueError, match=r"observation is \(\), expected \"features\""):
        dataclasses.replace(make()[0], observation=())
    for periods, problem in ((0, "is 0; it must be at least 1"), (2.5, "is 2.5; expected whole numbers")):
        with pytest.raises(ValueError, match=f"Environment.periods {problem}"):
            dataclasses.replace(make()[0], periods=periods)
    environment, params = make()
    with pytest.raises(ValueError, match="horizon is 0"):
        make(horizon=0)
    wrong = dataclasses.replace(bank(), speed_mps=jnp.zeros((2,)))
    with pytest.raises(ValueError, match=r"states \[5\] and speeds \[2\]"):
        environment.params({}, wrong, 3)
    _, state = environment.reset(jax.random.key(0), params)
    with pytest.raises(ValueError, match=r"action \[3\], expected \[2\]"):
        environment.step(jax.random.key(0), state, jnp.zeros(3), params)
    none = dataclasses.replace(environment.contract, kinematics="none")
    with pytest.raises(ValueError, match="or pass a reward_function"):
        dataclasses.replace(environment, contract=none)


def test_a_bank_of_another_recording_is_refused():
    model, good, places = with_memory()
    episodes.check(model, good)
    scans = good.memory.range_view
    other = dataclasses.replace(good.memory, range_view=jnp.repeat(scans, 2, axis=3))  # a lidar with more columns
    with pytest.raises(ValueError, match=r"StartBank: memory.range_view .* belongs to another model or recording"):
        episodes.check(model, dataclasses.replace(good, memory=other))
    with pytest.raises(ValueError, match=rf"row \[5\] reaches from 0 to 2, .* 2 windows of {places} observations"):
        episodes.check(model, dataclasses.replace(good, row=jnp.arange(STARTS) % 3))
    late = dataclasses.replace(good.latent.vantage, last=jnp.full(STARTS, places))
    with pytest.raises(ValueError, match=r"latent\.vantage\.last .* one call of observe"):
        episodes.check(model, dataclasses.replace(good, latent=dataclasses.replace(good.latent, vantage=late)))
    with pytest.raises(ValueError, match=r"got route maps \[3, 64, 64\], expected \[5, 64, 64\]"):
        episodes.check(model, dataclasses.replace(good, route_map=good.route_map[:3]))


def test_episodes_longer_than_training_imagined_are_warned_of():
    run = run_lib.Run(MODEL, variables(), presets.get("tiny"))
    environment = environment_lib.Environment.of_run(run, reward_config=NO_COLLISION)
    steps = run.config.imagined_steps
    assert environment.trained_steps == steps == 2
    with pytest.warns(UserWarning, match=r"an episode of 3 steps is longer than the 2 that training imagined\..*"
                                         r"evaluate RUN --uncertainty"):
        environment.params(variables(), bank(), steps + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment.params(variables(), bank(), steps)


def test_a_policy_that_loses_its_numbers_is_named_with_its_step():
    environment, params = make()
    _, state = environment.reset(jax.random.key(0), params)
    speeds = lambda key, seen: jnp.where(jax.random.key_data(key)[0] % 2 == 0, jnp.nan, jnp.zeros(2))
    with pytest.raises(ValueError, match=r"play: at step \d the policy chose \[nan, nan\]; expected finite"):
        environment_lib.play(environment, params, jax.random.key(1), state, jax.tree_util.Partial(speeds), 8)
    lost = jnp.zeros((2, 3, 4, 2)).at[1, 2, 3, 0].set(jnp.nan).at[1, 0, 1, 1].set(jnp.inf)
    with pytest.raises(ValueError, match=r"imagine: at step 1 of the drive \[1, 0\] the policy chose \[0.0, inf\]"):
        checks.chosen_actions(lost, "imagine")


def test_what_lies_on_the_host_is_clipped_like_all_else_and_nan_is_refused():
    environment, params = make()
    _, state = environment.reset(jax.random.key(0), params)
    far, edge = (environment.step(jax.random.key(1), state, action, params)[1].observation
                 for action in (np.array([1.5, -7.0]), jnp.array([1.0, -1.0])))
    np.testing.assert_array_equal(far, edge)
    with pytest.raises(ValueError, match=r"Environment\.step: 1 values of the actions \[2\] are not finite"):
        environment.step(jax.random.key(1), state, np.array([np.nan, 0.0]), params)
    lost = dataclasses.replace(state, latent=jax.tree.map(lambda leaf: np.full(leaf.shape, np.nan, np.float32),
                                                          state.latent))
    with pytest.raises(ValueError, match=r"Environment\.step: state .* not finite"):
        environment.step(jax.random.key(1), lost, ACTION, params)


def test_a_plain_function_is_a_policy_and_horizons_are_counts():
    environment, params = make()
    _, state = environment.reset(jax.random.key(0), params)
    policy = lambda key, seen: jnp.tanh(seen[:2])
    plain, partial = (environment_lib.play(environment, params, jax.random.key(1), state, driver, 2)[1].reward
                      for driver in (policy, jax.tree_util.Partial(policy)))
    np.testing.assert_array_equal(plain, partial)
    with pytest.raises(ValueError, match="play: horizon is -1; it must be at least 1"):
        environment_lib.play(environment, params, jax.random.key(1), state, policy, -1)
    with pytest.raises(ValueError, match="params: horizon is 0; it must be at least 1"):
        environment.params(variables(), bank(), 0)


def test_what_a_reward_or_an_observation_would_miss_is_told_at_once():
    listed = environment_lib.Environment(MODEL, reward_config=NO_COLLISION, observation=["image"])
    assert listed.observation == ("image",) and hash(listed)
    with pytest.raises(ValueError, match=r"collisions in occupancy, which is not among reward_heads=\('image',\)"):
        environment_lib.Environment(MODEL, reward_heads=("image",))


def test_observations_are_float32_where_jax_counts_in_float64():
    model = world_model.WorldModel(dataclasses.replace(
        CONFIG, heads=("image", "action"), first_guess=config_lib.TrainingMean(), range_scale_m=49.0))
    with jax.enable_x64(True):
        shapes = environment_lib.Environment(model, reward_config=NO_COLLISION, observation=("image",)
                                             ).observation_shapes
    assert shapes["image"].dtype == jnp.float32


def test_a_reward_of_plain_numbers_is_one():
    environment = environment_lib.Environment(MODEL, periods=2, reward_heads=(),
                                              reward_function=lambda moment: (1, False, {}))
    params = environment.params(variables(), bank(), 2)
    _, state = environment.reset(jax.random.key(0), params)
    _, transitions = environment_lib.play(environment, params, jax.random.key(1), state, jnp.zeros((2, 2)), 2)
    assert transitions.reward.tolist() == [1.0, 1.0] and transitions.reward.dtype == jnp.float32
    assert not transitions.terminated.any()
