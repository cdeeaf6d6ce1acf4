"""Motion between frames, from recorded and from dead-reckoned poses."""

import numpy as np

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
