"""Ego path and rewards: worked arithmetic."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.agents import rewards
from muvo_jax.ops import motion as motion_ops
from muvo_jax.town import renderer, simulator

CONTRACT = config_lib.ActionContract()
GRID = config_lib.VoxelGrid((16, 16, 4), 1.0, (-8.0, -8.0, -1.5))
CONFIG = rewards.RewardConfig()


def moment(speed=10.0, action=(0.0, 0.0), **fields):
    before = motion_ops.at_rest_of_frame(jnp.float32(speed))
    action = jnp.asarray(action, jnp.float32)
    return rewards.Moment(before, motion_ops.drive(before, action, CONTRACT, 2), action, jnp.zeros((3,)),
                          **{"decoded": {}} | fields)


def logits(occupied):
    """Occupancy logits [X, Y, Z, 2] with probability 1 at the given voxels, 0 elsewhere."""
    value = np.zeros((*GRID.shape, 2), np.float32)
    value[..., 0] = 40.0
    for voxel in occupied:
        value[voxel] = (0.0, 40.0)
    return jnp.asarray(value)


def test_the_ego_path_is_the_towns():
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (12, 2)).astype(np.float32)
    pose, speed = np.zeros(3), 3.0
    for action in actions:
        for _ in range(2):
            pose, speed = simulator.bicycle(pose, speed, action, CONTRACT)
    motion = motion_ops.path(motion_ops.at_rest_of_frame(jnp.float32(3.0)), jnp.asarray(actions), CONTRACT, 2)
    assert motion.pose.shape == (12, 3) and motion.speed_mps.shape == (12,)
    np.testing.assert_allclose(motion.pose[-1], pose, atol=1e-4)
    np.testing.assert_allclose(motion.speed_mps[-1], speed, atol=1e-5)


def test_braking_by_hand():
    motion = motion_ops.drive(motion_ops.at_rest_of_frame(jnp.float32(1.0)), jnp.array([-1.0, 0.5]), CONTRACT, 2)
    # 6 m/s2 for 0.1 s: 1.0 -> 0.4 m/s over 0.07 m, then 0.4 -> 0 (not -0.2) over 0.02 m.
    np.testing.assert_allclose(motion.speed_mps, 0.0, atol=1e-7)
    np.testing.assert_allclose(motion.pose[2], -0.09 * np.tan(0.3) / 2.9, rtol=1e-5)
    np.testing.assert_allclose(motion.pose[0], 0.09, atol=1e-5)


def test_paths_of_unknown_kinematics_are_refused():
    with pytest.raises(ValueError, match=r"contract\.kinematics is 'none'"):
        motion_ops.drive(moment().before, jnp.zeros((2,)), dataclasses.replace(CONTRACT, kinematics="none"))


def test_only_what_stands_at_the_height_of_the_car_counts():
    # Layers have their centres at -1, 0, 1 and 2 m; the box reaches from 0.6 to 1.6 m.
    plan = rewards.obstacle_plan(logits([(3, 4, 1), (5, 6, 2), (7, 8, 3)]), GRID, CONFIG.box)
    assert np.argwhere(plan > 0.5).tolist() == [[5, 6]]


@pytest.mark.parametrize("voxel, pose, expected", [
    ((10, 8, 2), (0, 0, 0), 1.0),  # 2.5 m ahead, 0.5 m to the left: inside the box
    ((13, 8, 2), (0, 0, 0), 0.0),  # 5.5 m ahead: out of reach
    ((13, 8, 2), (3, 0, 0), 1.0),  # ... until the car has driven 3 m
    ((8, 10, 2), (0, 0, 0), 0.0),  # 2.5 m to the left: beside the car
    ((8, 10, 2), (0, 0, np.pi / 2), 1.0),  # ... until it has turned to the left
])
def test_the_ego_box_touches_what_lies_under_it(voxel, pose, expected):
    plan = rewards.obstacle_plan(logits([voxel]), GRID, CONFIG.box)
    probability = rewards.box_collision(plan, jnp.asarray(pose, jnp.float32), GRID, CONFIG.box)
    np.testing.assert_allclose(probability, expected, atol=0.45)  # bilinear, half a voxel apart


def test_bilinear_by_hand():
    plane = jnp.array([[0.0, 4.0], [8.0, 0.0]])
    sampled = rewards.bilinear(plane, jnp.array([0.0, 0.5, 0.25, -0.5, 5.0]), jnp.array([1.0, 0.5, 0.0, 1.0, 0.0]))
    np.testing.assert_allclose(sampled, [4.0, 3.0, 2.0, 2.0, 0.0])


def test_route_geometry_is_the_towns():
    route = rewards.RouteMap()
    assert route.metres_per_px == renderer.ROUTE_MAP_M_PER_PX and route.ego_row == renderer.ROUTE_MAP_EGO_ROW
    line = np.stack([np.arange(-10, 30, 0.5), np.full(80, 4.0)], axis=1)  # 4 m to the left
    drawn = jnp.asarray(renderer.draw_route(line, np.zeros(3)))
    for y, expected in ((4.0, 0.0), (0.0, 4.0), (9.0, 5.0)):  # the line is three pixels wide: up to 1.5 m nearer
        distance = rewards.route_distance_m(drawn, jnp.array([10.0, y, 0.3]), route)
        assert max(expected - 1.6, 0) <= distance <= expected + 0.6


def test_progress_fades_with_the_distance_from_the_route():
    np.testing.assert_allclose(rewards.progress_m(moment(), CONFIG), 2.0, rtol=1e-5)  # 10 m/s for 0.2 s
    route_map = jnp.zeros((64, 64), jnp.uint8).at[:, 35].set(255)  # its centre is 3.5 px = 2.625 m to the right
    away = rewards.progress_m(moment(route_map=route_map), CONFIG)
    np.testing.assert_allclose(away, 2.0 * np.exp(-0.5 * (2.625 / 2) ** 2), rtol=0.02)


def test_comfort_and_speeding_by_hand():
    discomfort = rewards.discomfort(moment(10.0, (-0.5, 0.1)), CONTRACT, 0.2, CONFIG)
    speed = 10.0 - 0.2 * 3.0
    np.testing.assert_allclose(discomfort, (3.0**2 + (speed**2 * np.tan(0.06) / 2.9) ** 2) / 9.0, rtol=1e-5)
    np.testing.assert_allclose(rewards.speeding(moment(12.0), CONFIG), 0.2, rtol=1e-5)
    np.testing.assert_allclose(rewards.speeding(moment(8.0), CONFIG), 0.0)


def test_the_reward_adds_up_and_ends_at_a_collision():
    whole = lambda occupied: rewards.driving_reward(
        moment(5.0, decoded={"occupancy": logits(occupied)}), grid=GRID, contract=CONTRACT, step_s=0.2, config=CONFIG)
    reward, terminated, _ = whole([])
    np.testing.assert_allclose(reward, 0.5, rtol=1e-4)  # 1 m of the 2 m that the limit allows
    assert not terminated
    reward, terminated, terms = whole([(10, 8, 2)])
    np.testing.assert_allclose(reward, 0.5 - 5.0 * terms["collision"], rtol=1e-4)
    assert terminated


def test_gradients_push_the_car_away_from_obstacles_and_towards_the_route():
    plan = rewards.obstacle_plan(logits([(12, 8, 2)]), GRID, CONFIG.box)  # centre 4.5 m ahead, the bumper at 3.7 m
    touch = lambda pose: rewards.box_collision(plan, pose, GRID, CONFIG.box)
    assert jax.grad(touch)(jnp.array([0.2, 0.0, 0.0]))[0] > 0  # driving on makes it worse
    route_map = jnp.zeros((64, 64), jnp.uint8).at[:, 20].set(255)
    away = lambda pose: rewards.route_distance_m(route_map, pose, CONFIG.route)
    assert jax.grad(away)(jnp.zeros(3))[1] < 0
