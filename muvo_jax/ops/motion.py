"""Where actions take the car: the kinematic bicycle of the action contract, or what a recording or a model says.

The same equations as the town's simulator: a period of dt seconds changes the speed to v' = max(0, v + pedal dt),
drives the distance d = (v + v') dt / 2, turns by -d tan(steering * steer_full) / wheelbase (steering > 0 is right), and
moves along the mean of old and new heading. Where a pedal is no acceleration (CARLA) the head ego_motion says how the
car moved.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax.types import Array, Motion


def at_rest_of_frame(speed_mps: Array) -> Motion:
    """The start: pose 0, speed as measured."""
    speed_mps = jnp.asarray(speed_mps, jnp.float32)
    return Motion(jnp.zeros((*speed_mps.shape, 3), jnp.float32), speed_mps)


def acceleration_mps2(action: Array, contract: config_lib.ActionContract) -> Array:
    """Longitudinal acceleration [...] that an action [..., 2] asks for."""
    pedal = jnp.clip(action[..., 0], -1.0, 1.0)
    return jnp.where(pedal > 0, pedal * contract.accel_full_mps2, pedal * contract.brake_full_mps2)


def curvature_per_m(action: Array, contract: config_lib.ActionContract) -> Array:
    """Turn to the left per metre driven [...], 1/m: -tan(steering * steer_full) / wheelbase."""
    return -jnp.tan(jnp.clip(action[..., 1], -1.0, 1.0) * contract.steer_full_rad) / contract.wheelbase_m


def drive(motion: Motion, action: Array, contract: config_lib.ActionContract, periods: int = 1) -> Motion:
    """Applies an action [..., 2] for `periods` periods of 1 / contract.rate_hz; a model step is data.stride of them.

    Raises:
      ValueError: if the contract's kinematics are not the bicycle's.
    """
    if contract.kinematics != "bicycle":
        raise ValueError(f"contract.kinematics is {contract.kinematics!r}: the ego path follows from actions only with "
                         f"'bicycle'; otherwise use `moved` with a model that has the head ego_motion.")
    seconds = 1.0 / contract.rate_hz
    pedal_mps2, curvature = acceleration_mps2(action, contract), curvature_per_m(action, contract)
    pose, speed = motion.pose, motion.speed_mps
    for _ in range(periods):
        new_speed = jnp.maximum(speed + pedal_mps2 * seconds, 0.0)
        distance = 0.5 * (speed + new_speed) * seconds
        turn = distance * curvature
        heading = pose[..., 2] + 0.5 * turn
        pose = pose + jnp.stack([distance * jnp.cos(heading), distance * jnp.sin(heading), turn], axis=-1)
        speed = new_speed
    return Motion(pose, speed)


def moved(motion: Motion, ego_motion: Array) -> Motion:
    """Applies a step [..., 4] as types.Batch.ego_motion and the head of that name have it; it brings its own speed."""
    return Motion(placed(motion.pose, ego_motion[..., :3]), ego_motion[..., 3])


def placed(origin: Array, pose: Array) -> Array:
    """`pose` [..., 3], as seen from `origin` [..., 3], in the frame of the origin: `relative` backwards."""
    forward_m, left_m, turn_rad = jnp.moveaxis(pose, -1, 0)
    cosine, sine = jnp.cos(origin[..., 2]), jnp.sin(origin[..., 2])
    return origin + jnp.stack([cosine * forward_m - sine * left_m, sine * forward_m + cosine * left_m, turn_rad],
                              axis=-1)


def relative(pose: Array, origin: Array) -> Array:
    """`pose` [..., 3] as seen from `origin` [..., 3], both given in one frame."""
    cosine, sine = jnp.cos(origin[..., 2]), jnp.sin(origin[..., 2])
    x, y = pose[..., 0] - origin[..., 0], pose[..., 1] - origin[..., 1]
    return jnp.stack([cosine * x + sine * y, cosine * y - sine * x, pose[..., 2] - origin[..., 2]], axis=-1)


def into_frame(points_m: Array, pose: Array) -> Array:
    """Points [..., P, 3] of one ego frame as seen from the ego frame that stands at `pose` [..., 3] in it (flat)."""
    cosine, sine = (jnp.expand_dims(part(pose[..., 2]), -1) for part in (jnp.cos, jnp.sin))
    x = points_m[..., 0] - jnp.expand_dims(pose[..., 0], -1)
    y = points_m[..., 1] - jnp.expand_dims(pose[..., 1], -1)
    return jnp.stack([cosine * x + sine * y, cosine * y - sine * x, points_m[..., 2]], axis=-1)


def out_of_frame(points_m: Array, pose: Array) -> Array:
    """The inverse of `into_frame`."""
    cosine, sine = (jnp.expand_dims(part(pose[..., 2]), -1) for part in (jnp.cos, jnp.sin))
    x, y = points_m[..., 0], points_m[..., 1]
    return jnp.stack([cosine * x - sine * y + jnp.expand_dims(pose[..., 0], -1),
                      sine * x + cosine * y + jnp.expand_dims(pose[..., 1], -1), points_m[..., 2]], axis=-1)


def path(start: Motion, actions: Array, contract: config_lib.ActionContract, periods: int = 1) -> Motion:
    """The motion after each action: start [...], actions [..., H, 2] -> Motion [..., H, ...]."""
    def step(motion, action):
        motion = drive(motion, action, contract, periods)
        return motion, motion

    _, motions = jax.lax.scan(step, start, jnp.moveaxis(actions, -2, 0))
    return Motion(jnp.moveaxis(motions.pose, 0, -2), jnp.moveaxis(motions.speed_mps, 0, -1))
