"""Flat motions: frames and their inverses, steps one after the other, the bicycle against the town's."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies
from hypothesis.extra import numpy as arrays

from muvo_jax import config as config_lib
from muvo_jax.ops import motion
from muvo_jax.town import simulator
from muvo_jax.types import Motion

pytestmark = pytest.mark.usefixtures("strict_dtypes")
CONTRACT = config_lib.ActionContract()
few = hypothesis.settings(max_examples=30, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))
within = lambda shape, metres: arrays.arrays(np.float32, shape, elements=strategies.floats(-metres, metres, width=32))
places = within((2, 5, 3), 50.0)
poses = strategies.builds(lambda xy, yaw: np.concatenate([xy, yaw], axis=-1), within((2, 2), 50.0),
                          within((2, 1), 3.125))
actions = within((6, 2), 1.0)


@few
@hypothesis.given(places, poses)
def test_into_a_frame_and_out_of_it_is_where_one_was(points_m, pose):
    there = motion.into_frame(points_m, pose)
    np.testing.assert_allclose(motion.out_of_frame(there, pose), points_m, atol=1e-4)
    np.testing.assert_array_equal(there[..., 2], points_m[..., 2])
    np.testing.assert_allclose(motion.into_frame(pose[:, None], pose)[..., :2], 0.0, atol=1e-4)  # stands at its origin


@few
@hypothesis.given(poses, poses)
def test_a_step_that_is_relative_to_a_place_leads_from_there(pose, origin):
    step = motion.relative(jnp.asarray(pose), jnp.asarray(origin))
    following = motion.moved(Motion(jnp.asarray(origin), jnp.zeros(2)), jnp.concatenate([step, jnp.ones((2, 1))], -1))
    np.testing.assert_allclose(following.pose, pose, atol=1e-4)
    np.testing.assert_array_equal(following.speed_mps, 1.0)
    # What a frame's origin looks like from the other is the way there.
    np.testing.assert_allclose(motion.into_frame(pose[:, None], origin)[:, 0, :2], step[:, :2], atol=1e-4)


def test_a_place_ahead_after_a_left_turn_lies_to_the_right():
    turned = jnp.array([2.0, 0.0, jnp.pi / 2])
    np.testing.assert_allclose(motion.into_frame(jnp.array([[5.0, 0.0, 1.0]]), turned), [[0.0, -3.0, 1.0]], atol=1e-6)


@few
@hypothesis.given(actions, strategies.floats(0.0, 15.0, width=32))
def test_the_bicycle_is_the_towns(actions, speed_mps):
    pose, town_mps = np.zeros(3), float(speed_mps)
    for action in actions:
        pose, town_mps = simulator.bicycle(pose, town_mps, action, CONTRACT)
    start = motion.at_rest_of_frame(jnp.float32(speed_mps))
    driven = motion.path(start, jnp.asarray(actions), CONTRACT)
    np.testing.assert_allclose(driven.pose[-1], pose, atol=1e-3)
    np.testing.assert_allclose(driven.speed_mps[-1], town_mps, atol=1e-4)


def test_periods_are_steps_under_one_action():
    start, action = motion.at_rest_of_frame(jnp.array([3.0, 8.0])), jnp.array([[0.5, -0.4], [-1.0, 0.7]])
    slowly = motion.path(start, jnp.stack([action] * 3, axis=1), CONTRACT)[:, -1]
    at_once = motion.drive(start, action, CONTRACT, periods=3)
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-6), at_once, slowly)


def test_steps_in_their_own_frames_add_up_to_the_path():
    actions = jnp.array([[0.5, -0.4], [0.2, 0.9], [-1.0, 0.3]])
    whole = motion.path(motion.at_rest_of_frame(jnp.float32(6.0)), actions, CONTRACT)
    walked = Motion(jnp.zeros(3), jnp.float32(6.0))
    for step, action in enumerate(actions):
        own = motion.drive(motion.at_rest_of_frame(walked.speed_mps), action, CONTRACT)
        walked = motion.moved(walked, jnp.concatenate([own.pose, own.speed_mps[None]]))
        np.testing.assert_allclose(walked.pose, whole.pose[step], atol=1e-5)


def test_braking_stops_and_never_drives_backwards():
    stopped = motion.drive(motion.at_rest_of_frame(jnp.float32(1.0)), jnp.array([-1.0, 0.0]), CONTRACT, periods=10)
    assert float(stopped.speed_mps) == 0.0 and 0.0 < float(stopped.pose[0]) < 0.1


def test_without_kinematics_actions_say_nothing_of_the_path():
    silent = config_lib.ActionContract(kinematics="none")
    with pytest.raises(ValueError, match="kinematics is 'none'"):
        motion.drive(motion.at_rest_of_frame(jnp.float32(1.0)), jnp.zeros(2), silent)
