"""The car's motion from frame to frame, what the head ego_motion learns: from poses, recorded or dead-reckoned."""

from __future__ import annotations

import numpy as np


def dead_reckoned(speed_mps: np.ndarray, yaw_rate_radps: np.ndarray, rate_hz: float) -> np.ndarray:
    """Poses float64 [F, 3] (x, y in m, yaw in rad) of a run from its speeds and yaw rates [F], the first one zero.

    Between two frames the car has the mean of their speeds and yaw rates and moves along the mean of both headings.
    """
    mean = lambda values: 0.5 * (values[1:] + values[:-1]).astype(np.float64)
    turn_rad = mean(yaw_rate_radps) / rate_hz
    yaw_rad = np.concatenate([[0.0], np.cumsum(turn_rad)])
    heading_rad, distance_m = yaw_rad[:-1] + 0.5 * turn_rad, mean(speed_mps) / rate_hz
    steps = np.stack([distance_m * np.cos(heading_rad), distance_m * np.sin(heading_rad)], axis=1)
    return np.concatenate([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), yaw_rad[:, None]], axis=1)


def between(course: np.ndarray) -> np.ndarray:
    """Motion since the frame before, as types.Batch.ego_motion has it.

    Args:
      course: float64 [..., T, 4], x, y (m), yaw (rad) in any frame that stands still, and speed (m/s).

    Returns:
      float32 [..., T, 4]: forward and left (m) in the ego frame of the frame before, turn to the left (rad), and the
      speed of the frame itself; the first frame has no motion.
    """
    offset = np.diff(course[..., :2], axis=-2)
    yaw_rad = course[..., :-1, 2]
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    turn_rad = (np.diff(course[..., 2], axis=-1) + np.pi) % (2 * np.pi) - np.pi
    motion = np.zeros(course.shape, np.float32)
    motion[..., 1:, 0] = cosine * offset[..., 0] + sine * offset[..., 1]
    motion[..., 1:, 1] = cosine * offset[..., 1] - sine * offset[..., 0]
    motion[..., 1:, 2] = turn_rad
    motion[..., 3] = course[..., 3]
    return motion
