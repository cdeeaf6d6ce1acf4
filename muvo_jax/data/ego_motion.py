"""The car's motion from frame to frame, what the head ego_motion learns, from poses, recorded or dead-reckoned; and the
actions of recordings that have the motion alone.
"""

from __future__ import annotations

import math

import numpy as np

from muvo_jax import config as config_lib


def derive_action(speed_mps: float, acceleration_mps2: float, yaw_rate_radps: float,
                  contract: config_lib.ActionContract) -> np.ndarray:
    """The action (float32 [2]) that a bicycle model would need to move like this; yaw rate > 0 turns left."""
    full_mps2 = contract.accel_full_mps2 if acceleration_mps2 >= 0 else contract.brake_full_mps2
    steering_rad = -math.atan(contract.wheelbase_m * yaw_rate_radps / max(speed_mps, 1.0))
    return np.clip(np.array([acceleration_mps2 / full_mps2, steering_rad / contract.steer_full_rad]),
                   -1.0, 1.0).astype(np.float32)


def of_poses(pose: np.ndarray, timestamps_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How the car moved, from where it was.

    Args:
      pose: float64 [F, 3], x, y (m) and yaw (rad) in any frame that stands still.
      timestamps_s: float64 [F], increasing.

    Returns:
      Three float64 [F]: forward speed at each frame (m/s, over both neighbours); its change (m/s2) and the turn to the
      left (rad/s) from there to the next frame. The last frame has those of the one before; a single frame has zeros.
    """
    if len(pose) < 2:
        return np.zeros(len(pose)), np.zeros(len(pose)), np.zeros(len(pose))
    steps_s, yaw_rad = np.diff(timestamps_s), np.unwrap(pose[:, 2])
    x_mps, y_mps = (np.gradient(pose[:, axis], timestamps_s, edge_order=2 if len(pose) > 2 else 1) for axis in (0, 1))
    speed_mps = x_mps * np.cos(yaw_rad) + y_mps * np.sin(yaw_rad)
    to_next = lambda values: np.append(change := np.diff(values) / steps_s, change[-1])
    return speed_mps, to_next(speed_mps), to_next(yaw_rad)


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
