"""How vehicles are driven: speed by the intelligent driver model, steering by pure pursuit."""

from __future__ import annotations

import numpy as np

MAX_ACCELERATION_MPS2 = 2.0
COMFORTABLE_BRAKING_MPS2 = 2.5
TIME_GAP_S = 1.0
STANDSTILL_GAP_M = 2.0
LOOK_AHEAD_M = np.arange(1.0, 29.0, 1.5)  # places on the path ahead where obstacles are sought
NO_GAP_M = 1e3
BURST_PERIOD_S = 2.0


def follow(speed_mps, desired_mps, gap_m, leader_mps) -> np.ndarray:
    """Acceleration (m/s2) of the intelligent driver model, broadcast over its arguments.

    Args:
      speed_mps: of the vehicle.
      desired_mps: what it would drive on an empty road.
      gap_m: free road in front of its bumper.
      leader_mps: speed of whatever ends that gap.
    """
    interaction = (STANDSTILL_GAP_M + np.maximum(0, speed_mps * TIME_GAP_S + speed_mps * (speed_mps - leader_mps)
                   / (2 * np.sqrt(MAX_ACCELERATION_MPS2 * COMFORTABLE_BRAKING_MPS2))))
    desired_mps = np.maximum(desired_mps, 0.1)
    free = np.where(speed_mps <= desired_mps, 1 - (speed_mps / desired_mps) ** 4,
                    -COMFORTABLE_BRAKING_MPS2 / MAX_ACCELERATION_MPS2 * (1 - desired_mps / np.maximum(speed_mps, 0.1)))
    return MAX_ACCELERATION_MPS2 * (free - (interaction / np.maximum(gap_m, 0.3)) ** 2)


def burst(seed: int, frame: int, rate_hz: float) -> np.ndarray | None:
    """What a restless driver does at a frame instead of driving on: (pedal, steering), None most of the time.

    In every BURST_PERIOD_S one burst: braking or throttle of 0.4 to 1 s, or steering of 0.3 to 0.5 s, so short that
    the expert finds back to its lane. The same for the same seed and frame.
    """
    time_s = frame / rate_hz
    rng = np.random.default_rng([seed, 11, int(time_s / BURST_PERIOD_S)])
    kind, strength, start = rng.integers(4), rng.uniform(0.4, 1.0), rng.uniform(0.0, 0.5)
    duration_s = rng.uniform(0.4, 1.0) if kind < 2 else rng.uniform(0.3, 0.5)
    if not 0.0 <= time_s % BURST_PERIOD_S - start * BURST_PERIOD_S < duration_s:
        return None
    return np.array([(-strength, 0.0), (strength, 0.0), (0.0, -0.3 * strength), (0.0, 0.3 * strength)][kind])


def find_leader(path_m: np.ndarray, path_yaw_rad: np.ndarray, obstacles_m: np.ndarray, velocity_mps: np.ndarray,
                radius_m: np.ndarray, ignore: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the first obstacle on each path.

    Args:
      path_m, path_yaw_rad: [A, D, 2] and [A, D], places LOOK_AHEAD_M ahead of each vehicle.
      obstacles_m, velocity_mps: [O, 2], of everything that moves.
      radius_m: [O], how near to the path an obstacle must be to count.
      ignore: [A], index of the vehicle itself among the obstacles.

    Returns:
      distance_m [A] along the path to the obstacle's middle (NO_GAP_M without one) and its speed along the path.
    """
    offset = path_m[:, :, None] - obstacles_m[None, None]
    blocked = (offset**2).sum(-1) < (radius_m**2)[None, None]
    blocked[np.arange(len(path_m)), :, ignore] = False
    place = blocked.any(-1).argmax(1)
    rows = np.arange(len(path_m))
    obstacle = blocked[rows, place].argmax(-1)
    found = blocked[rows, place, obstacle]
    yaw = path_yaw_rad[rows, place]
    along_mps = velocity_mps[obstacle, 0] * np.cos(yaw) + velocity_mps[obstacle, 1] * np.sin(yaw)
    return np.where(found, LOOK_AHEAD_M[place], NO_GAP_M), np.where(found, np.maximum(along_mps, 0), 0)


def pursue(position_m: np.ndarray, yaw_rad: float, target_m: np.ndarray, wheelbase_m: float) -> float:
    """Angle of the front wheels (rad, left positive) that leads the rear axle through `target_m` on a circle."""
    offset = target_m - position_m
    bearing_rad = np.arctan2(offset[1], offset[0]) - yaw_rad
    return float(np.arctan2(2 * wheelbase_m * np.sin(bearing_rad), np.hypot(*offset)))
