"""What the driving reward gives for a real drive, to stand beside what imagination says of it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import closed_loop
from muvo_jax.agents import environment as environment_lib
from muvo_jax.ops import motion as motion_ops


def town_rewards(environment: environment_lib.Environment, drive: closed_loop.Drive) -> np.ndarray:
    """What the driving reward gives for each step of a real drive: float64 [steps].

    Progress is the simulator's, along its route, and so is the collision, which is 1 or 0; speed and turn come from its
    situations. Leaving the route costs no more than the progress that is not made.
    """
    config, contract = environment.reward_config, environment.contract
    speed_mps = np.array([situation.speed_mps for situation in drive.situations[1:]])
    progress_m = np.diff([situation.progress_m for situation in drive.situations])
    action = jnp.stack([jnp.asarray(moment.action) for moment in drive.moments])
    along = np.asarray(motion_ops.acceleration_mps2(action, contract))
    across = speed_mps**2 * np.asarray(motion_ops.curvature_per_m(action, contract))
    gained = progress_m / (config.speed_limit_mps * environment.step_s)
    gained = np.where(gained > 0.0, gained / np.maximum(speed_mps / config.speed_limit_mps, 1.0), gained)
    speeding = np.maximum(speed_mps / config.speed_limit_mps - 1.0, 0.0)
    collided = np.array([situation.collided for situation in drive.situations[1:]], np.float64)
    return (config.progress * gained - config.comfort * (along**2 + across**2) / config.comfortable_mps2**2
            - config.speeding * speeding - config.collision * collided)
