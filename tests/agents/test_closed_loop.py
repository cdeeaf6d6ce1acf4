"""The loop and its drivers, on a road written by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from muvo_jax.agents import closed_loop, planners
from muvo_jax.agents import environment as environment_lib

STEP_S = 0.2
FAST = planners.PlannerConfig(plans=8, iterations=2, elites=2, kept=1)


def road(wall_m=1e9, end_m=1e9):
    """A straight road: the state is (metres, speed); full throttle adds 1 m/s in a step, the expert drives 5 m/s."""
    height, width = worlds.CONFIG.image_size
    grid = worlds.CONFIG.range_view
    route_map = np.zeros((64, 64), np.uint8)
    route_map[:, 30:34] = 255

    def step(state, action):
        speed = max(0.0, state[1] + float(action[0]))
        return state[0] + STEP_S * speed, speed

    def observe(state):
        return {"image": np.full((height, width, 3), 100, np.uint8), "route_map": route_map,
                "range_view": np.zeros((grid.rows, grid.columns, 4), np.float32), "speed_mps": np.float32(state[1])}

    return closed_loop.Simulator(
        reset=lambda seed: (float(seed), 5.0), step=step, observe=observe, step_s=STEP_S,
        situation=lambda state: closed_loop.Situation(state[0], collided=state[0] > wall_m, arrived=state[0] > end_m),
        expert=lambda state: np.array([5.0 - state[1], 0.0]))


def run(simulator, driver, steps=5, context=2, seed=0):
    return closed_loop.drive(simulator, driver, jax.random.key(0), seed, steps, context=context)


def test_a_drive_counts_metres_from_the_takeover():
    drive = run(road(), closed_loop.constant_driver((0.5, 0.0)), steps=3)
    assert drive.progress_m == pytest.approx(STEP_S * (5.5 + 6.0 + 6.5))  # the context's two steps are not in it
    assert drive.steps == 3 and drive.unharmed
    assert [moment.state[1] for moment in drive.moments] == [5.0, 5.5, 6.0]


def test_a_drive_ends_at_a_collision_and_at_the_end_of_the_route():
    braking_late = closed_loop.constant_driver((0.0, 0.0))
    crash = run(road(wall_m=4.5), braking_late)
    assert crash.end.collided and not crash.unharmed and crash.steps == 3
    assert crash.progress_m == pytest.approx(3.0)
    arrival = run(road(end_m=3.5), braking_late)
    assert arrival.end.arrived and arrival.unharmed and arrival.steps == 2


def test_a_drive_that_is_over_before_the_takeover_is_refused():
    with pytest.raises(ValueError, match=r"seed 7 .* over before the takeover"):
        run(road(wall_m=8.5), closed_loop.random_driver(), seed=7)


def test_random_drivers_of_one_key_agree_and_use_each_key_once():
    drives = [run(road(), closed_loop.random_driver()) for _ in range(2)]
    actions = np.array([[moment.action for moment in drive.moments] for drive in drives])
    np.testing.assert_array_equal(actions[0], actions[1])
    assert len(np.unique(actions[0])) == actions[0].size and (np.abs(actions) <= 1).all()


def test_the_planner_filters_every_step_plans_for_progress_and_compiles_once():
    environment, _ = worlds.make()
    world = road()
    driver = closed_loop.planning_driver(world, environment, worlds.variables(), config=FAST, horizon=4)
    compiled = closed_loop.plan_step._cache_size()
    planned = run(world, driver, steps=6, context=3)
    assert closed_loop.plan_step._cache_size() == compiled + 1
    assert planned.moments[-1].memory.live.frame == 3 + 6
    coasting = run(world, closed_loop.constant_driver((0.0, 0.0)), steps=6, context=3)
    assert planned.progress_m > coasting.progress_m  # at 5 m/s, half the limit, imagination pays for accelerating
    again = run(world, driver, steps=6, context=3)
    assert again.progress_m == planned.progress_m
    states, memory = closed_loop.latents(planned.moments)
    plans = closed_loop.plans(planned.moments)
    assert plans.shape == (6, 4, 2) and states.features.shape[0] == 6 and memory is None


def test_the_planner_stops_before_a_wall_unless_collisions_cost_nothing():
    world = before_the_wall(16.0)
    config, drives = planners.PlannerConfig(plans=48, iterations=6, std=0.7), {}
    for collision in (5.0, 0.0):
        environment, _ = worlds.before_a_wall(16.0, 5.0, 8, collision=collision)
        driver = closed_loop.planning_driver(world, environment, {}, config=config, horizon=8)
        drives[collision] = run(world, driver, steps=25)
    assert drives[0.0].end.collided
    assert drives[5.0].unharmed and drives[5.0].steps == 25
    assert drives[5.0].progress_m > 7.0  # it drove on to where the wall was near


WALL_WORLD = environment_lib.Environment(worlds.WALL_MODEL, periods=2, reward_config=worlds.NO_COLLISION)


def before_the_wall(wall_m):
    """A road with a wall that worlds.WALL_MODEL sees: all ranges are the distance to it."""
    grid, bare = worlds.CONFIG.range_view, road(wall_m=wall_m)

    def observe(state):
        return bare.observe(state) | {"range_view": np.full((grid.rows, grid.columns, 4), wall_m - state[0],
                                                            np.float32)}

    return dataclasses.replace(bare, observe=observe)


def test_a_policy_drives_by_what_the_model_makes_of_the_sensors_and_compiles_once():
    """The first two features are metres to the wall and speed; the policy wants a third of the metres as m/s."""
    def wanted(share, key, features):
        assert features.shape == (1, worlds.WALL_MODEL.policy_feature_channels)
        return jnp.stack([share * features[:, 0] - features[:, 1], 0.0 * features[:, 0]], axis=-1)

    world, ends, compiled = before_the_wall(16.0), [], []
    for share in (1 / 3, 1 / 6):
        driver = closed_loop.policy_driver(world, WALL_WORLD, {}, jax.tree_util.Partial(wanted, share))
        done = run(world, driver, steps=25)
        ends.append(done.moments[-1].state)
        compiled.append(closed_loop._act._cache_size())
    assert done.unharmed and done.moments[-1].memory.live.frame == 2 + 25
    assert ends[0][0] > ends[1][0] + 1.0  # nearer to the wall, and both before it
    assert all(position < 16.0 for position, _ in ends)
    assert compiled[0] == compiled[1]
    assert all((np.abs(moment.action) <= 1.0).all() for moment in done.moments)


def test_a_policys_action_that_is_no_number_is_named_with_its_step():
    world = before_the_wall(16.0)
    losing = lambda key, features: jnp.where(features[:, :1] < 12.5, jnp.nan, jnp.zeros((1, 2)))
    driver = closed_loop.policy_driver(world, WALL_WORLD, {}, losing)
    with pytest.raises(ValueError, match=r"seed 0, at step 4 .* the driver chose \[nan, nan\]"):
        run(world, driver)


@pytest.mark.parametrize(("options", "message"), [
    ({"planner": "a-star"}, "planner 'a-star' is unknown; known are cem, mppi, gradient"),
    ({"horizon": 0}, "horizon is 0"),
    ({"simulator": dataclasses.replace(road(), step_s=0.1)}, "simulator steps 0.1 s, the model 0.2 s"),
])
def test_what_cannot_be_planned_is_refused(options, message):
    environment, _ = worlds.make()
    with pytest.raises(ValueError, match=message):
        closed_loop.planning_driver(**{"simulator": road(), "environment": environment, "variables": {}} | options)


def test_a_policy_is_not_driven_at_another_rate_and_no_driver_beyond_the_pedals():
    world, _ = worlds.make()
    slow = dataclasses.replace(road(), step_s=0.1)
    with pytest.raises(ValueError, match=r"policy_driver: the simulator steps 0\.1 s, the model 0\.2 s"):
        closed_loop.policy_driver(slow, world, worlds.variables(), lambda key, seen: jnp.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"the driver chose \[50\.0, 0\.0\]; expected two finite numbers in \[-1, 1\]"):
        run(road(), closed_loop.constant_driver((50.0, 0.0)))
