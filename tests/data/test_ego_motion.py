"""Motion between frames, from recorded and from dead-reckoned poses."""

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import ego_motion


def circle(frames=9, rate_hz=10.0):
    """A left turn of radius 20 m at 8 m/s, seen from a frame that is turned and far away."""
    yaw_rad = 3.0 + 0.4 * np.arange(frames) / rate_hz
    course = np.stack([100 + 20 * np.sin(yaw_rad), -50 - 20 * np.cos(yaw_rad), yaw_rad, np.full(frames, 8.0)], axis=1)
    course[:, 2] = (course[:, 2] + np.pi) % (2 * np.pi) - np.pi  # recorded yaws jump by a turn
    return course


def test_motion_on_a_circle_by_hand():
    motion = ego_motion.between(circle()[None])[0]
    assert motion.dtype == np.float32 and (motion[0] == [0, 0, 0, 8]).all()
    step = [20 * np.sin(0.04), 20 * (1 - np.cos(0.04)), 0.04, 8.0]
    np.testing.assert_allclose(motion[1:], [step] * 8, atol=1e-5)


def test_dead_reckoning_finds_the_same_motion():
    poses = ego_motion.dead_reckoned(np.full(9, 8.0, np.float32), np.full(9, 0.4, np.float32), 10.0)
    reckoned = ego_motion.between(np.concatenate([poses, np.full((9, 1), 8.0)], axis=1))
    np.testing.assert_allclose(reckoned, ego_motion.between(circle()), atol=1e-3)
    assert (poses[0] == 0).all()


def test_how_the_car_moved_follows_from_poses_at_uneven_times():
    """A left turn of radius 20 m that gets faster; the same car driven backwards has the opposite speed."""
    times_s = np.cumsum([0.0, 0.1, 0.05, 0.1, 0.1, 0.05, 0.1, 0.1])
    driven_m = 8.0 * times_s + 0.75 * times_s**2
    yaw_rad = 3.0 + driven_m / 20
    wrapped_rad = (yaw_rad + np.pi) % (2 * np.pi) - np.pi
    pose = np.stack([100 + 20 * np.sin(yaw_rad), -50 - 20 * np.cos(yaw_rad), wrapped_rad], axis=1)
    speed_mps, acceleration_mps2, yaw_rate_radps = ego_motion.of_poses(pose, times_s)
    np.testing.assert_allclose(speed_mps, 8.0 + 1.5 * times_s, atol=0.02)
    np.testing.assert_allclose(acceleration_mps2[1:-2], 1.5, atol=0.1)
    np.testing.assert_allclose(yaw_rate_radps[:-1], np.diff(driven_m) / np.diff(times_s) / 20, atol=1e-9)
    assert yaw_rate_radps[-1] == yaw_rate_radps[-2] and acceleration_mps2[-1] == acceleration_mps2[-2]
    backwards, _, _ = ego_motion.of_poses(pose + np.array([[0, 0, np.pi]]), times_s)
    np.testing.assert_allclose(backwards, -speed_mps)
    assert [values.tolist() for values in ego_motion.of_poses(pose[:1], times_s[:1])] == [[0.0]] * 3


def test_an_action_that_was_derived_drives_the_same_way():
    contract = config_lib.ActionContract(wheelbase_m=2.6)
    action = ego_motion.derive_action(8.0, -3.0, 0.4, contract)
    np.testing.assert_allclose(action, [-3.0 / contract.brake_full_mps2, -np.arctan(2.6 * 0.4 / 8) / 0.6], rtol=1e-6)
    np.testing.assert_array_equal(ego_motion.derive_action(0.1, 99.0, 9.0, contract), [1.0, -1.0])
