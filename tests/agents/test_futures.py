"""Futures imagined once and driven many times, the observation "road", and learning in them, before a made-up wall."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from muvo_jax.agents import actor_critic, real_rewards, rewards, road
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import futures as futures_lib
from muvo_jax.agents import route as route_lib
from muvo_jax.agents.closed_loop import Drive, Moment, Situation
from muvo_jax.agents.episodes import Plans
from muvo_jax.types import Motion

HORIZON = 10


@pytest.fixture(scope="module")
def imagined():
    """(environment, policy, futures): two cars that go on at 6 m/s, 16 m before a wall."""
    world, params = worlds.before_a_wall(16.0, 6.0, HORIZON, speed_limit_mps=8.0)
    world = dataclasses.replace(world, observation="road")
    params = world.params({}, params.bank, HORIZON)
    policy = jax.tree_util.Partial(coast)
    starts = jnp.zeros(2, jnp.int32)
    return world, policy, futures_lib.imagine(world, params, jax.random.key(0), starts, policy, HORIZON)


def coast(key, observation):
    assert observation.shape == (road.CHANNELS,)
    return jnp.zeros(2)


@pytest.fixture(scope="module")
def driven(imagined):
    """(speeds, actions) -> (rewards' sum, (observations, rewards, ends)) and the sum's slope in the actions; compiled
    once."""
    world, _, futures = imagined

    def drive(actions, speed_mps):
        start = Motion(jnp.zeros((2, 3)), speed_mps)
        seen, reward, terminated, _ = futures_lib.drive(world, futures, start, lambda seen, step: (actions[step], ()))
        return reward.sum(), (seen, reward, terminated)

    return jax.jit(jax.value_and_grad(drive, has_aux=True))


def test_the_first_drive_is_that_of_the_environment(imagined, driven):
    futures = imagined[-1]
    (_, (seen, reward, terminated)), _ = driven(jnp.zeros((HORIZON, 2, 2), jnp.float32), futures.speed_mps)
    # the wall rises by 20 a metre inside the sigmoid and costs 20: 1e-7 of its 16 m are some 1e-4 of reward
    np.testing.assert_allclose(reward.T, futures.reward, atol=2e-4)
    np.testing.assert_array_equal(terminated.T, futures.terminated)
    assert futures.terminated.any(), "at 6 m/s the wall is reached within 2 s"
    np.testing.assert_allclose(seen[:, :, 0], 0.6, rtol=1e-6)  # speed / 10 m/s


def test_futures_are_an_environment_of_their_own(imagined):
    world, _, futures = imagined
    shared = futures_lib.SharedFutures(world)
    params = shared.params(futures)
    observation, state = jax.jit(shared.reset)(jax.random.key(0), params)
    assert observation.shape == shared.observation_shapes.shape == (road.CHANNELS,)
    state = dataclasses.replace(state, motion=Motion(jnp.zeros(3), futures.speed_mps[1]), start=jnp.int32(1))
    drive = lambda state: jax.lax.scan(lambda state, _: shared.step(None, state, jnp.zeros(2), params), state, None,
                                       length=HORIZON)
    _, transitions = jax.jit(drive)(state)
    np.testing.assert_allclose(transitions.reward, futures.reward[1], atol=2e-4)
    np.testing.assert_array_equal(transitions.terminated, futures.terminated[1])
    assert transitions.truncated.tolist() == [False] * (HORIZON - 1) + [True]
    with pytest.raises(ValueError, match=r"SharedFutures.step: 1 values of the actions"):
        shared.step(None, state, np.array([0.0, np.nan]), params)


def test_futures_go_through_a_door(imagined):
    pytest.importorskip("gymnax", reason="gymnax is not installed")
    from muvo_jax.agents.doors import gymnax_env
    world, _, futures = imagined
    shared = futures_lib.SharedFutures(world)
    door = gymnax_env.GymnaxImagination(shared, shared.params(futures))

    def drive(key):
        seen, state = door.reset(key, door.default_params)
        return seen, state, *door.step(key, state, jnp.zeros(2), door.default_params)

    seen, first, after, second, *_ = jax.eval_shape(drive, jax.random.key(0))
    assert seen == after and jax.tree.map(jnp.shape, first) == jax.tree.map(jnp.shape, second)
    assert sum(leaf.size for leaf in jax.tree.leaves(first)) < 20  # where the car is; no map


def blocked_along(observation, before=False):
    """Probabilities [..., places] of a touch along the route, now or road.BEFORE_S earlier."""
    first = 1 + 3 * road.ROUTE_AHEAD_M.size + before * (road.CLEARANCE_M.size + road.STRAIGHT_M.size)
    return observation[..., first:first + road.CLEARANCE_M.size] * road.PROBABILITY_UNIT


def remembering(thing_m):
    """(environment, params) of two starts whose scans show one return each: of the first it stands where `thing_m`
    [frames] says, m ahead of where the car is now, of the second likewise, seen by a car that drove there at 10 m/s."""
    model, starts, places = worlds.with_memory(starts=2)
    pose = jnp.zeros((2, places, 3)).at[1, :, 0].set(2.0 * jnp.arange(1.0 - places, 1.0))
    ahead_m = jnp.asarray(thing_m)[None] - pose[..., 0]
    point = jnp.stack([ahead_m, 0.0 * ahead_m, 1.0 + 0.0 * ahead_m, ahead_m], axis=-1)
    scans = starts.memory.range_view.at[:, :, 0, 0].set(point)
    last = dataclasses.replace(starts.latent.vantage, first=jnp.zeros(2, jnp.int32),
                               last=jnp.full(2, places - 1, jnp.int32))
    starts = dataclasses.replace(starts, latent=dataclasses.replace(starts.latent, vantage=last),
                                 memory=dataclasses.replace(starts.memory, range_view=scans, pose=pose))
    world = environment_lib.Environment(model, periods=2, observation="road")
    return world, world.params(jax.tree.map(jnp.asarray, model.init(jax.random.key(0))), starts, 2)


def test_what_stands_and_what_moves_are_told_apart():
    """A thing 8 m ahead, and one that has come there from 4 m within 0.6 s: as a standing and as a driving car saw
    them."""
    world, params = remembering(np.full(7, 8.0))
    empty = jnp.zeros(world.model.config.voxels.shape[:2])
    look = jax.jit(lambda start, params: world.road(world.state_at(start, params), params, empty))
    for start in range(2):
        seen = look(jnp.int32(start), params)
        assert blocked_along(seen).max() > 0.5
        np.testing.assert_allclose(blocked_along(seen), blocked_along(seen, before=True), atol=1e-4)
    world, params = remembering(np.array([4.0, 4.0, 4.0, 4.0, 5.0, 6.0, 8.0]))
    for start in range(2):
        seen = look(jnp.int32(start), params)
        now, before = blocked_along(seen), blocked_along(seen, before=True)
        first = lambda blocked: road.CLEARANCE_M[np.argmax(np.asarray(blocked) > 0.5)]
        assert 3.0 <= first(now) - first(before) <= 5.0, "places are up to 2 m apart"


def test_what_only_the_scan_shows_stands_as_long_as_it_counts():
    """A thing that stands, in a future whose decoder shows nothing: as much there as 0.6 s before, at every step."""
    world, params = remembering(np.full(7, 8.0))
    grid, steps = world.model.config.voxels, 7
    future = futures_lib.Futures(
        jnp.zeros((2, steps, *grid.shape[:2])), jnp.zeros((2, steps, 3)), params.seen, params.routes, jnp.ones(2),
        *jnp.zeros((2, 2, steps - 1)), jnp.zeros((2, steps - 1), bool))
    look = jax.jit(lambda step: jax.vmap(functools.partial(futures_lib.look, world))(
        futures_lib.around(world, future, slice(None), step), Motion(jnp.zeros((2, 3)), jnp.ones(2))))
    for step in range(steps):
        now, before = (blocked_along(look(jnp.int32(step)), before) for before in (False, True))
        assert (now.max() > 0.5) == (step * world.step_s <= world.reward_config.seen_s)
        if step * world.step_s <= world.reward_config.seen_s:
            np.testing.assert_allclose(now, before, atol=1e-4)


def test_a_future_is_driven_by_what_was_seen_before_as_it_was_imagined():
    """A policy that reads all of the observation drives a future just as it did when it imagined it, and as it does in
    the environment: what stood where 0.6 s earlier comes from scans at first, and then from what was decoded."""
    world, params = remembering(np.array([4.0, 4.0, 4.0, 4.0, 5.0, 6.0, 8.0]))
    params = dataclasses.replace(params, temperature=jnp.float32(0.0))
    mixed = jax.random.normal(jax.random.key(1), (road.CHANNELS, 2)) / road.CHANNELS**0.5
    policy = jax.tree_util.Partial(lambda key, observation: 0.9 * jnp.tanh(observation @ mixed))
    future = futures_lib.imagine(world, params, jax.random.key(0), jnp.arange(2), policy, 6)
    act = lambda seen, step: (jax.vmap(policy, (None, 0))(None, seen), ())
    observed, reward, *_ = futures_lib.drive(world, future, Motion(jnp.zeros((2, 3)), future.speed_mps), act)
    np.testing.assert_allclose(reward.T, future.reward, atol=2e-4)
    later = jnp.stack([blocked_along(seen, before=True) for seen in observed[3:]])
    assert float(jnp.ptp(later, axis=0).max()) > 1e-3
    for car in range(2):
        state = world.state_at(jnp.int32(car), params)
        _, played = environment_lib.play(world, params, jax.random.key(0), state, policy, 6)
        # `imagine` works out the evidence once, which blurs it a little: what was seen is the same to rounding
        np.testing.assert_allclose(blocked_along(played.observation[:3], before=True),
                                   blocked_along(observed[1:4, car], before=True), atol=0.02)


def test_what_was_before_has_one_size_at_any_scale_of_occupancy():
    world, params = remembering(np.full(7, 8.0))
    coarse = dataclasses.replace(world, reward_config=dataclasses.replace(world.reward_config, occupancy_scale=2))
    policy = jax.tree_util.Partial(coast)
    future, _ = jax.eval_shape(functools.partial(futures_lib._imagine, coarse, policy=policy, horizon=4), params,
                               jax.random.key(0), jnp.arange(2))
    x, y, _ = world.model.config.voxels.shape
    assert future.obstacles.shape == (2, 5, x // 2, y // 2) and future.seen.plan.shape == (2, 4, x, y)
    there = jax.eval_shape(lambda future: futures_lib.around(coarse, future, slice(None), jnp.int32(4)), future)
    assert there.before.plan.shape == (2, x, y)
    plan = rewards.full_size(jnp.arange(4.0).reshape(2, 2), dataclasses.replace(world.model.config.voxels,
                                                                               shape=(4, 6, 2)))
    np.testing.assert_array_equal(plan, [[0, 0, 0, 1, 1, 1]] * 2 + [[2, 2, 2, 3, 3, 3]] * 2)


def test_a_future_has_a_derivative_in_the_actions(driven):
    """At 2 m/s nothing is near in 2 s: accelerating earns more, sooner most, steering off the route less."""
    _, slope = driven(jnp.full((HORIZON, 2, 2), 0.01, jnp.float32), jnp.full((2,), 2.0, jnp.float32))
    assert (np.diff(slope[:, 0, 0]) < 0).all() and slope[0, 0, 0] > 0.1
    assert slope[0, 0, 1] < 0


def test_a_clearance_says_how_far_the_wall_is(imagined):
    """After five steps it is 10 m from the car's origin, and the car's front 3.7 m before that."""
    world, _, futures = imagined
    at = jax.tree.map(lambda leaf: leaf[0, 5], (futures.obstacles, futures.pose))
    look = jax.jit(lambda motion, obstacles: road.observe(
        motion, None, obstacles, None, None, None, grid=world.model.config.voxels, config=world.reward_config))(
            Motion(at[1], jnp.float32(6.0)), Plans(*at))
    first = 1 + 3 * road.ROUTE_AHEAD_M.size
    blocked = blocked_along(look)
    near = road.CLEARANCE_M <= 10.0  # farther on the grid ends
    front_m = road.CLEARANCE_M + world.reward_config.box.front_m - 0.5  # to a quarter of a voxel, of 2 m
    np.testing.assert_array_equal(blocked[near] > 0.5, front_m[near] > 10.0)
    ahead = look[1:first - road.ROUTE_AHEAD_M.size].reshape(-1, 2)
    np.testing.assert_allclose(ahead, [[0, 0], *[[1, 0]] * 6], atol=1e-5)


def test_it_learns_to_stop_before_the_wall(imagined):
    world, _, futures = imagined
    config = actor_critic.ActorCriticConfig(width=16, layers=1, learning_rate=1e-2, clip_norm=1.0)
    learner = actor_critic.init(jax.random.key(0), world, config)
    many = futures[jnp.zeros(8, jnp.int32)]

    def driven(actor):
        act = lambda seen, step: (jax.vmap(actor_critic.policy(config, actor, sampled=False), (None, 0))(
            jax.random.key(0), seen), ())
        return futures_lib.drive(world, many, Motion(jnp.zeros((8, 3)), many.speed_mps), act)[1:3]

    before, _ = driven(learner.actor)
    returns = []
    for key in jax.random.split(jax.random.key(1), 30):
        learner, metrics = actor_critic.improve(world, config, many, key, learner)
        returns.append(float(metrics["reward"]))
    assert np.mean(returns[-5:]) > np.mean(returns[:3]) + 0.3, "its drives with noise, a step"
    earned, ended = driven(learner.actor)
    assert (earned.sum(axis=0) > before.sum(axis=0) + 15.0).all(), "crashing costs 20, once"
    assert not ended.any()


def test_what_steps_are_worth_to_an_unharmed_car(imagined):
    world, _, futures = imagined
    act = lambda seen, step: (jnp.zeros((2, 2)), ())
    start = Motion(jnp.zeros((2, 3)), futures.speed_mps)
    _, earned, terminated, _ = futures_lib.drive(world, futures, start, act)
    _, reward, ends, _ = futures_lib.drive_unharmed(world, futures, start, act)
    left = jnp.cumprod(1.0 - jnp.where(terminated, 0.0, ends), axis=0)  # a drive goes on past its end here
    crashed = jnp.argmax(terminated, axis=0)
    for car in range(2):
        until = int(crashed[car]) + 1
        before = jnp.concatenate([jnp.ones(1), left[:until - 1, car]])
        np.testing.assert_allclose(earned[:until, car], before * reward[:until, car], rtol=1e-4, atol=1e-5)
    assert terminated.any() and (ends[terminated] == 1.0).all() and (ends >= 0.0).all() and (ends <= 1.0).all()


def test_what_cannot_be_shared_is_refused(imagined):
    world, policy, _ = imagined
    features = dataclasses.replace(world, observation="features")
    with pytest.raises(ValueError, match=r"the observation 'features' .* expected Environment\(observation=\"road\""):
        futures_lib.imagine(features, None, jax.random.key(0), jnp.zeros(1, jnp.int32), policy, 2)
    heads = environment_lib.Environment(worlds.WALL_MODEL, periods=2, observation=("occupancy",))
    with pytest.raises(ValueError, match="observes the heads occupancy; expected one vector"):
        actor_critic.init(jax.random.key(0), heads, actor_critic.ActorCriticConfig())


def test_places_ahead_lie_on_the_route_and_end_with_it():
    along = jnp.arange(-2.0, 9.0)
    bend = jnp.stack([jnp.minimum(along, 4.0), jnp.maximum(along - 4.0, 0.0)], axis=-1)  # left after 4 m
    route = route_lib.Route(bend, along, along < 7.5)
    ahead = jax.jit(route_lib.ahead)
    poses = ahead(route, jnp.array([1.0, -0.5, 0.0]), jnp.array([0.0, 2.5, 5.0, 99.0]))
    np.testing.assert_allclose(poses, [[1, 0, 0], [3.5, 0, 0], [4, 2, np.pi / 2], [4, 3, np.pi / 2]], atol=1e-5)
    nowhere = dataclasses.replace(route, known=jnp.zeros(11, bool))
    assert np.isfinite(ahead(nowhere, jnp.zeros(3), jnp.array([0.0, 5.0, 9.0, 99.0]))).all()


def test_rewards_of_a_real_drive_by_hand():
    """Two steps of 0.2 s, limit 8 m/s: 1.6 m on earn 1; then a collision at 10 m/s, 2 m on, coasting."""
    world, _ = worlds.before_a_wall(16.0, 6.0, 2, speed_limit_mps=8.0)
    places = (Situation(3.0, speed_mps=8.0), Situation(4.6, speed_mps=8.0), Situation(6.6, True, speed_mps=10.0))
    moments = tuple(Moment(None, np.array(action, np.float32), None) for action in ((-0.5, 0.0), (0.0, 0.0)))
    # braking with half of 6 m/s2 costs 0.05; 2 / 1.6 m divided by 10 / 8 earn 1, speeding costs 1/4
    want = [1.0 - 0.05, 1.0 - 0.25 - 20.0]
    np.testing.assert_allclose(real_rewards.town_rewards(world, Drive(3.6, 2, places, moments)), want, rtol=1e-6)


def test_starts_that_are_not_there_and_a_policy_of_nan_are_named(imagined):
    world, policy, _ = imagined
    params = world.params({}, worlds.before_a_wall(16.0, 6.0, HORIZON)[1].bank, HORIZON)
    imagine = lambda starts, policy=policy, horizon=2: futures_lib.imagine(
        world, params, jax.random.key(0), jnp.asarray(starts), policy, horizon)
    for starts in ([params.bank.size], [-1]):
        with pytest.raises(ValueError, match=rf"starts \[1\] holds {starts[0]}; expected 0 to {params.bank.size - 1}"):
            imagine(starts)
    with pytest.raises(ValueError, match=r"starts is float32.*expected whole numbers"):
        imagine([0.5])
    with pytest.raises(ValueError, match=r"imagine: at step 0 of the drive \[0\] the policy chose \[nan, nan\]"):
        imagine([0], lambda key, seen: jnp.full(2, jnp.nan))
    with pytest.raises(ValueError, match=r"futures\.imagine: horizon is 0"):
        imagine([0], horizon=0)


def test_shared_futures_restart_where_a_drive_is_over(imagined):
    world, _, futures = imagined
    shared = futures_lib.SharedFutures(world)
    params = shared.params(futures)
    observation, state = jax.jit(shared.reset)(jax.random.key(0), params)
    moved, transition = jax.jit(shared.step)(jax.random.key(1), state, jnp.zeros(2), params)
    for final, time in ((False, 1), (True, 0)):
        after, seen = shared.restart(jax.random.key(2), moved, transition.observation, jnp.bool_(final), params)
        assert int(after.time) == time and seen.shape == observation.shape
