"""The actor-critic: lambda returns by hand, and learning what is easy to learn."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import worlds
from worlds import make

from muvo_jax.agents import actor_critic, rewards
from muvo_jax.agents import environment as environment_lib


def test_lambda_returns_by_hand():
    reward, discount, value = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, 0.5, 0.5]), jnp.array([10.0, 20.0, 30.0])
    last = 3 + 0.5 * 30
    middle = 2 + 0.5 * (0.2 * 20 + 0.8 * last)
    first = 1 + 0.5 * (0.2 * 10 + 0.8 * middle)
    np.testing.assert_allclose(actor_critic.lambda_returns(reward, discount, value, 0.8), [first, middle, last])
    ended = actor_critic.lambda_returns(reward, discount.at[1].set(0.0), value, 0.8)
    np.testing.assert_allclose(ended[1], 2.0)  # nothing counts after the end


def test_log_probability_is_that_of_the_squashed_gaussian():
    mean, std = jnp.array([0.3, -0.2]), jnp.array([0.5, 0.8])
    drawn = jnp.array([0.7, 0.1])
    normal = jnp.exp(-0.5 * ((drawn - mean) / std) ** 2) / std
    want = jnp.log(normal / (1 - jnp.tanh(drawn) ** 2)).sum()
    np.testing.assert_allclose(actor_critic._log_probability(mean, std, drawn), want, rtol=1e-5)


def test_it_learns_to_brake_where_braking_pays():
    def braking(moment):
        reward = -moment.action[..., 0]
        return reward, jnp.zeros(reward.shape, bool), {}

    environment, params = make(reward_function=braking)
    config = actor_critic.ActorCriticConfig(starts=16, horizon=4, width=16, layers=1, learning_rate=1e-2)
    learner = actor_critic.init(jax.random.key(0), environment, config)
    rewards = []
    for key in jax.random.split(jax.random.key(1), 80):
        learner, metrics = actor_critic.update(environment, config, params, key, learner)
        rewards.append(metrics["reward"])
    assert abs(np.mean(rewards[:3])) < 0.3 and np.mean(rewards[-5:]) > 0.5
    action = actor_critic.policy(config, learner.actor, sampled=False)(None, params.bank.latent.features[0])
    assert action[0] < -0.4


def test_policies_of_one_config_compile_once_whatever_their_weights():
    environment, params = make()
    config = actor_critic.ActorCriticConfig(width=8, layers=1)
    _, state = environment.reset(jax.random.key(0), params)
    actor = actor_critic.init(jax.random.key(0), environment, config).actor
    rewards, compiled = [], []
    for shift in (0.0, 0.5):  # fresh actors all drive straight on
        moved = actor_critic.policy(config, jax.tree.map(lambda leaf, shift=shift: leaf + shift, actor))
        _, transitions = environment_lib.play(environment, params, jax.random.key(1), state, moved, 2)
        rewards.append(transitions.reward)
        compiled.append(environment_lib._play._cache_size())
    assert compiled[0] == compiled[1] and not np.allclose(*rewards)


def test_a_drive_that_is_cut_off_is_bootstrapped_there():
    reward, value = jnp.array([1.0, 2.0, 4.0]), jnp.array([10.0, 20.0, 30.0])
    truncated = jnp.array([False, True, False])
    returns = actor_critic.lambda_returns(reward, jnp.full(3, 0.5), value, 0.9, truncated)
    cut = 2.0 + 0.5 * 20.0
    np.testing.assert_allclose(returns, [1.0 + 0.5 * (0.1 * 10.0 + 0.9 * cut), cut, 4.0 + 0.5 * 30.0])


def test_values_are_those_of_an_unharmed_car():
    config, touched = rewards.RewardConfig(), jnp.array([[0.2, 0.6], [0.9, 0.6], [0.4, 0.6]])
    chance, unharmed = rewards.likely(touched, config), jnp.cumprod(1.0 - rewards.likely(touched, config), axis=0)
    earned = rewards.unharmed_before(touched.T, config).T * (0.5 - config.collision * chance)
    reward, ends = actor_critic._to_an_unharmed_car(earned, jnp.zeros((3, 2), jnp.bool_), unharmed)
    np.testing.assert_allclose(reward, 0.5 - config.collision * chance, rtol=1e-4)
    np.testing.assert_allclose(ends, chance, rtol=1e-4, atol=1e-6)
    _, ends = actor_critic._to_an_unharmed_car(earned, jnp.ones((3, 2), jnp.bool_), unharmed)
    np.testing.assert_array_equal(ends, 1.0)


def test_steps_after_the_end_of_an_episode_teach_nothing():
    config = actor_critic.ActorCriticConfig(width=8, layers=1, horizon=4, starts=2)
    world, _ = worlds.make(reward_function=lambda moment: (moment.after.speed_mps, False, {}), reward_heads=())
    learner = actor_critic.init(jax.random.key(0), world, config)
    params = world.params(worlds.variables(), worlds.bank(), 2)
    seen, drawn, transitions = jax.jit(functools.partial(actor_critic.imagine, world, config))(
        params, jax.random.key(1), learner.actor)
    assert transitions.truncated.tolist() == [[False, False], [True, True], [True, True], [True, True]]

    def learned(reward):
        drives = lambda actor: (seen, drawn, reward, transitions.terminated, transitions.truncated)
        return actor_critic._learn(config, learner, drives, score=1.0)[0].critic

    late = transitions.reward.at[2:].add(5.0)
    chex.assert_trees_all_close(learned(transitions.reward), learned(late), rtol=1e-6)
    early = transitions.reward.at[0].add(5.0)
    assert any(np.abs(one - other).max() > 0 for one, other in zip(
        jax.tree.leaves(learned(transitions.reward)), jax.tree.leaves(learned(early)), strict=True))
