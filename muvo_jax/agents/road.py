"""What a driving policy sees of the road: its speed, the route ahead, what stands on it as far as the model says, and
what stood there a little earlier, which tells how others move.

The observation "road" of an Environment. A pooled latent does not say where the car is in its lane (a linear read-out
explains 4 % of the lateral offset's variance, docs/agents.md), and where something stands it says no better: pooling
averages over places. A car knows its speed and its route map anyway, and what stands where, decoders say.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.agents import rewards
from muvo_jax.agents import route as route_lib
from muvo_jax.agents.episodes import Plans
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import Array, Motion

ROUTE_AHEAD_M = np.array([0.0, 2.0, 4.0, 7.0, 10.0, 14.0, 18.0], np.float32)  # where the route is looked at
CLEARANCE_M = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0], np.float32)  # the car put there
STRAIGHT_M = np.array([0.0, 2.0, 4.0], np.float32)  # the car put straight ahead of itself
CHANNELS = 1 + 3 * ROUTE_AHEAD_M.size + 2 * (CLEARANCE_M.size + STRAIGHT_M.size)
BEFORE_S = 0.6  # so much earlier: a car at 3 m/s has left its place by a voxel or more
SPEED_UNIT_MPS = 10.0
NEAREST_UNIT_M = 2.0  # places on the route come divided by their distance, the nearest ones by this
TURN_UNIT_RAD = 0.5
PROBABILITY_UNIT = 0.5


def observe(motion: Motion, route: route_lib.Route | None, obstacles: Plans, seen: Array | None,
            before: Plans | None, seen_before: Array | None, *, grid: config_lib.VoxelGrid,
            config: rewards.RewardConfig, pooled: bool = True) -> Array:
    """The observation of one car: float32 [CHANNELS], each number about 1 where it is large.

    Speed; forward, left and turn of the route ahead in the car's frame; the probability that the car would touch
    something if it stood at places of the route and straight ahead, and that it would have BEFORE_S earlier at the very
    same places: where both agree, things stand. Differentiable in the motion, but for these probabilities, whose slopes
    are nothing or cliffs.

    Args:
      motion: Motion [], in the frame of the start.
      route: the line on the start's route map; None counts as straight on along the start's heading.
      obstacles: Plans [] of rewards.obstacle_plan.
      seen: [X, Y] of rewards.seen_plan in the frame of the start, or None.
      before: Plans [] of BEFORE_S earlier; None where that is not known, and everything counts as standing.
      seen_before: as `seen`, what counts beside `before`: where that is decoded, too, the same scan; else nothing, 0.
      grid, config, pooled: of the model and the reward; see rewards.box_collision.
    """
    route = route_lib.straight() if route is None else route
    ahead = motion_ops.relative(route_lib.ahead(route, motion.pose, ROUTE_AHEAD_M), motion.pose)
    unit_m = jnp.asarray(np.maximum(ROUTE_AHEAD_M, NEAREST_UNIT_M))[:, None]
    turn = jnp.arctan2(jnp.sin(ahead[:, 2]), jnp.cos(ahead[:, 2])) / TURN_UNIT_RAD
    straight = jnp.stack([jnp.asarray(STRAIGHT_M), *2 * [jnp.zeros(STRAIGHT_M.size, jnp.float32)]], axis=-1)
    places = jnp.concatenate([route_lib.ahead(route, motion.pose, CLEARANCE_M),
                              motion_ops.placed(jnp.broadcast_to(motion.pose, straight.shape), straight)])

    def touched(plans: Plans, scan: Array | None) -> Array:
        decoded = rewards.box_collision(rewards.full_size(plans.plan, grid), motion_ops.relative(
            places, plans.pose[None]), grid, config.box, pooled=pooled)
        return decoded if scan is None else jnp.maximum(decoded, rewards.box_collision(scan, places, grid, config.box))

    blocked = touched(obstacles, seen)
    was_blocked = blocked if before is None else touched(before, seen_before)
    return jnp.concatenate([motion.speed_mps[None] / SPEED_UNIT_MPS, (ahead[:, :2] / unit_m).reshape(-1), turn,
                            jax.lax.stop_gradient(jnp.concatenate([blocked, was_blocked])) / PROBABILITY_UNIT])
