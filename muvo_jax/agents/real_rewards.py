"""What the driving reward gives for a real drive, to stand beside what imagination says of it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import closed_loop, rewards
from muvo_jax.agents import environment as environment_lib
from muvo_jax.ops import motion as motion_ops


def town_rewards(environment: environment_lib.Environment, drive: closed_loop.Drive) -> np.ndarray:
    """What the driving reward gives for each step of a real drive: float32 [steps].

    Progress is the simulator's, along its route, and so is the collision, which is 1 or 0; speed and turn come from its
    situations, a bicycle's comfort from its actions. Leaving the route costs no more than the progress that is not
    made.
    """
    config, contract = environment.reward_config, environment.contract
    before, after = (motion_ops.at_rest_of_frame(jnp.asarray([situation.speed_mps for situation in part], jnp.float32))
                     for part in (drive.situations[:-1], drive.situations[1:]))
    action = jnp.stack([jnp.asarray(moment.action) for moment in drive.moments])
    moment = rewards.Moment(before, after, action, after.speed_mps, {})
    terms = {"progress_m": jnp.asarray(np.diff([situation.progress_m for situation in drive.situations]), jnp.float32),
             "discomfort": rewards.discomfort(moment, contract, environment.step_s, config),
             "speeding": rewards.speeding(moment, config),
             "collision": jnp.asarray([situation.collided for situation in drive.situations[1:]], jnp.float32)}
    unharmed = rewards.unharmed_before(terms["collision"], config)
    return np.asarray(rewards.total(terms, after.speed_mps, unharmed, step_s=environment.step_s, config=config))
