"""Planners find a known optimum, and plan in imagination under jit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import before_a_wall, make

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import planners, rewards
from muvo_jax.ops import motion as motion_ops

GOAL = jnp.stack([jnp.linspace(-0.6, 0.6, 6), jnp.full((6,), 0.3)], axis=-1)
SETTINGS = {"cem": {"iterations": 12}, "mppi": {"iterations": 20, "std": 0.2, "temperature": 0.02, "plans": 256},
            "gradient": {"iterations": 60}}


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_a_planner_comes_near_the_best_plan(name):
    objective = lambda key, plans: -((plans - GOAL[None]) ** 2).mean(axis=(1, 2))
    config = planners.PlannerConfig(**SETTINGS[name])
    plan = jax.jit(lambda key: planners.PLANNERS[name](objective, key, jnp.zeros((6, 2)), config))(jax.random.key(0))
    np.testing.assert_allclose(plan.actions, GOAL, atol=0.25)
    np.testing.assert_allclose(plan.value, objective(None, plan.actions[None])[0], atol=1e-6)
    assert plan.value > -0.01 > objective(None, jnp.zeros((1, 6, 2)))[0]


@pytest.mark.parametrize("name", ["cem", "gradient"])
def test_a_plan_that_gives_nan_is_never_chosen(name):
    objective = lambda key, plans: jnp.where(plans[:, 0, 0] > 0, jnp.nan, plans[:, 0, 0])
    plan = planners.PLANNERS[name](objective, jax.random.key(0), jnp.zeros((3, 2)))
    assert -0.2 < plan.value <= 0


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_where_no_plan_gives_a_number_the_start_stays(name):
    start = jnp.full((3, 2), 0.25)
    plan = planners.PLANNERS[name](lambda key, plans: jnp.full(plans.shape[0], jnp.nan), jax.random.key(0), start,
                                   planners.PlannerConfig(plans=8, iterations=2, elites=4, starts=2))
    np.testing.assert_array_equal(plan.actions, start)
    assert plan.value == -jnp.inf


def test_gradient_ascent_leaves_a_hill_and_a_plateau_by_its_other_starts():
    """A low hill at the start, nothing to climb beside it, and the high one at 0.8."""
    height = lambda at, top, width: top * jnp.maximum(1.0 - jnp.abs(at) / width, 0.0)
    objective = lambda key, plans: (height(plans, 0.2, 0.2) + height(plans - 0.8, 1.0, 0.5)).mean(axis=(1, 2))
    ascend = lambda starts: planners.gradient(objective, jax.random.key(0), jnp.zeros((1, 2)), planners.PlannerConfig(
        starts=starts, iterations=20, std=1.0))
    assert ascend(1).value == pytest.approx(0.2, abs=0.02)
    assert ascend(32).value > 0.8


def test_in_imagination_the_fast_plan_is_found():
    environment, params = make()
    _, state = environment.reset(jax.random.key(0), params)
    config = planners.PlannerConfig(plans=16, iterations=2, elites=4, kept=1)

    @jax.jit
    def best(key):
        objective = planners.imagined_returns(environment, params, state, noises=2)
        return planners.cem(objective, key, jnp.zeros((4, 2)), config), objective(key, jnp.zeros((1, 4, 2)))[0]

    plan, idle = best(jax.random.key(1))
    assert plan.value > idle and plan.actions[0, 0] > 0  # accelerating brings the car farther


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_a_wall_ahead_is_braked_for_when_collisions_cost_and_driven_into_when_they_do_not(name):
    """From 5 m/s, a plan that coasts for eight steps ends 8 m on; the wall is 8 m ahead, and the car reaches 3.7 m."""
    found = {}
    for collision in (5.0, 0.0):
        environment, params = before_a_wall(8.0, 5.0, 8, collision=collision)
        _, state = environment.reset(jax.random.key(0), params)
        objective = planners.imagined_returns(environment, params, state)
        config = planners.PlannerConfig(plans=256, iterations=20, std=0.7, temperature=0.1)
        plan = planners.PLANNERS[name](objective, jax.random.key(1), jnp.zeros((8, 2)), config)
        speeds_mps = 5.0 + np.cumsum(np.asarray(plan.actions[:, 0]))
        found[collision] = 0.2 * np.maximum(speeds_mps, 0.0).sum()
    assert found[5.0] < 8.0 - 3.7 + 1.0 and found[0.0] > 8.0


class Walled(environment_lib.Environment):
    """A world with a wall from 16 m ahead of the start on."""

    def occupancy_ahead(self, params, key, state, plan):
        grid = self.model.config.voxels
        poses = motion_ops.path(state.motion, plan, self.contract, self.periods).pose[:, 0]
        x = grid.origin_m[0] + grid.voxel_size_m * (jnp.arange(grid.shape[0]) + 0.5)
        wall = poses[:, None] + x[None] > 16.0
        logits = jnp.where(wall, 8.0, -8.0)[:, :, None, None]
        logits = jnp.broadcast_to(logits, (len(plan), *grid.shape))
        return jnp.stack([jnp.zeros_like(logits), logits], axis=-1)


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_in_one_future_for_all_plans_the_car_stops_before_a_wall(name):
    environment, params = make(reward_config=rewards.RewardConfig())
    walled = Walled(**{field.name: getattr(environment, field.name) for field in dataclasses.fields(environment)})
    _, state = environment.reset(jax.random.key(0), params)
    state = dataclasses.replace(state, motion=motion_ops.at_rest_of_frame(jnp.float32(8.0)))
    objective = planners.shared_future_returns(walled, params, state)
    config = planners.PlannerConfig(plans=128, iterations=12, temperature=0.1)
    plan = jax.jit(lambda key: planners.PLANNERS[name](objective, key, jnp.zeros((10, 2)), config))(jax.random.key(1))
    path = motion_ops.path(state.motion, plan.actions, environment.contract, environment.periods)
    assert path.pose[-1, 0] < 13.0  # the front is at 3.7 m; coasting leads to 16 m
    assert plan.value > objective(jax.random.key(2), jnp.zeros((1, 10, 2)))[0] + 1.0


def test_the_plan_whose_future_is_shared_is_worth_what_it_is_in_its_own():
    environment, params = make(reward_config=rewards.RewardConfig(occupancy_scale=2, tolerated_collision=0.0))
    _, state = environment.reset(jax.random.key(0), params)
    plans = jax.random.uniform(jax.random.key(1), (3, 3, 2), minval=-1)
    shared, own = (jax.jit(returns(environment, params, state))(jax.random.key(3), plans)
                   for returns in (planners.shared_future_returns, planners.imagined_returns))
    np.testing.assert_allclose(shared[0], own[0], rtol=1e-4)
    assert np.abs(shared[1:] - own[1:]).max() > 1e-4  # the others see its future, not theirs
    learned, _ = make(reward_function=lambda moment: (moment.features.sum(), jnp.bool_(False), {}))
    with pytest.raises(ValueError, match=r"the reward is a function of its own.*use imagined_returns"):
        planners.shared_future_returns(learned, params, state)


def test_coloured_noise_has_unit_variance_and_is_smooth():
    noise = planners.coloured_noise(jax.random.key(0), (4000, 9, 2), 2.0)
    np.testing.assert_allclose(noise.std(), 1.0, atol=0.03)
    step = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
    white = planners.coloured_noise(jax.random.key(0), (4000, 9, 2), 0.0)
    assert step > 0.5 > abs(np.corrcoef(white[:, :-1].ravel(), white[:, 1:].ravel())[0, 1]) * 10


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="kept=9, elites=8"):
        planners.PlannerConfig(kept=9)


@pytest.mark.parametrize("kept", [0, 2])
def test_cem_returns_the_best_plan_it_saw_kept_or_not(kept):
    """A narrow peak beside a wide slope: later iterations leave it."""
    seen = []

    def objective(key, plans):
        values = jnp.where(jnp.abs(plans[:, 0, 0] - 0.5) < 0.05, 10.0, -jnp.abs(plans).mean(axis=(1, 2)))
        jax.debug.callback(lambda values: seen.append(float(np.max(values))), values)
        return values

    for seed in range(6):
        seen.clear()
        config = planners.PlannerConfig(plans=64, kept=kept, noise_exponent=0.0)
        plan = planners.cem(objective, jax.random.key(seed), jnp.zeros((5, 2)), config)
        jax.effects_barrier()
        assert plan.value == pytest.approx(max(seen))
