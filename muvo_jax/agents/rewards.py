"""Rewards and ends that a world model can give: pure functions of decoded occupancy, route map, ego path and actions.

All are differentiable almost everywhere and take any leading axes unless they say otherwise; metres, seconds, radians.
`driving_reward` is the sum that environment and planners use by default; any function of the same form may replace it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import limits
from muvo_jax.config import RouteMap
from muvo_jax.limits import COUNT, NOT_NEGATIVE, above
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import Array, Motion


@dataclasses.dataclass(frozen=True)
class EgoBox:
    """The car's body in its own frame, m. `low_m` lies above the road, which is occupied too."""

    rear_m: float = -1.1
    front_m: float = 3.7
    half_width_m: float = 1.0
    low_m: float = 0.6
    high_m: float = 1.6

    def __post_init__(self):
        limits.check(self)


@dataclasses.dataclass(frozen=True)
class RewardConfig:
    """Weights of driving_reward (0 switches a term off) and its constants.

    Attributes:
      progress: per metre along the route, divided by the metres of a step at `speed_limit_mps`.
      collision: times the collision probability.
      comfort, speeding: times the respective penalty. The limit is the best speed where speeding exceeds progress; at
        twice progress a metre per second too fast costs what one too slow costs.
      terminal_collision: an imagined drive ends where the collision probability exceeds this; above 1 it never ends.
      route_tolerance_m: sigma of the decay with distance from the route.
      speed_limit_mps: what counts as fast.
      comfortable_mps2: acceleration, along and across, that costs 1.
      occupancy_scale: decode occupancy at 1, 1/2 or 1/4 of its resolution; coarser is cheaper.
      box: the car.
      route: scale of the route map; where it is left at the town's, `Environment.of_run` takes the recording's.
    """

    progress: Annotated[float, NOT_NEGATIVE] = 1.0
    collision: Annotated[float, NOT_NEGATIVE] = 5.0
    comfort: Annotated[float, NOT_NEGATIVE] = 0.05
    speeding: Annotated[float, NOT_NEGATIVE] = 2.0
    terminal_collision: Annotated[float, NOT_NEGATIVE] = 0.5
    route_tolerance_m: Annotated[float, above(0, unit="m")] = 2.0
    speed_limit_mps: Annotated[float, above(0, unit="m/s")] = 10.0
    comfortable_mps2: Annotated[float, above(0, unit="m/s2")] = 3.0
    occupancy_scale: Annotated[int, COUNT] = 1
    box: EgoBox = EgoBox()
    route: RouteMap = RouteMap()

    def __post_init__(self):
        limits.check(self)


@flax.struct.dataclass
class Moment:
    """One imagined step, all that a reward may look at. Leading axes: any.

    Attributes:
      before, after: Motion at the step's two ends, in the ego frame of the start.
      action: float32 [..., 2], applied in between.
      features: float32 [..., F], of the latent after the step.
      decoded: head -> full-size prediction after the step, for the heads that were asked for.
      route_map: uint8 or float32 [..., 64, 64], the last observed one, or None.
    """

    before: Motion
    after: Motion
    action: Array
    features: Array
    decoded: Mapping[str, Array]
    route_map: Array | None = None


def obstacle_plan(occupancy: Array, grid: config_lib.VoxelGrid, box: EgoBox) -> Array:
    """Probability that a column of voxels is occupied at the height of the car.

    Args:
      occupancy: logits [..., X, Y, Z, 2] as the head gives them; X may be a half or a quarter of the grid's.
      grid: the full-size grid.
      box: whose heights count; layers whose centre lies within, or the nearest one where there is none.

    Returns:
      float32 [..., X, Y], the largest softmax probability among those layers.
    """
    layers = occupancy.shape[-2]
    size_m = grid.voxel_size_m * grid.shape[2] / layers
    centres_m = grid.origin_m[2] + size_m * (np.arange(layers) + 0.5)
    chosen = np.flatnonzero((centres_m >= box.low_m) & (centres_m <= box.high_m))
    if not chosen.size:
        chosen = np.array([np.argmin(np.abs(centres_m - 0.5 * (box.low_m + box.high_m)))])
    logits = occupancy[..., chosen[0]:chosen[-1] + 1, :].astype(jnp.float32)
    return jax.nn.sigmoid(logits[..., 1] - logits[..., 0]).max(axis=-1)


def box_collision(plan: Array, pose: Array, grid: config_lib.VoxelGrid, box: EgoBox) -> Array:
    """Probability that the car at `pose` touches something: the largest one under its box.

    Args:
      plan: [..., X, Y] from obstacle_plan, in some ego frame.
      pose: [..., 3], x, y, yaw of the car in that frame; zeros for the occupancy decoded at the very step.
      grid: the full-size grid.
      box: the body, sampled bilinearly at most half a voxel apart; outside the grid nothing is occupied.

    Returns:
      float32 [...].
    """
    size_m = grid.voxel_size_m * grid.shape[0] / plan.shape[-2]
    along = np.linspace(box.rear_m, box.front_m, math.ceil((box.front_m - box.rear_m) / (0.5 * size_m)) + 1)
    across = np.linspace(-box.half_width_m, box.half_width_m, math.ceil(4 * box.half_width_m / size_m) + 1)
    x, y = (jnp.asarray(axis.ravel(), jnp.float32) for axis in np.meshgrid(along, across, indexing="ij"))
    pose = jnp.expand_dims(pose, -2)  # [..., 1, 3] beside the points [P]
    cosine, sine = jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2])
    lift = lambda value: value.reshape((1,) * (cosine.ndim - 1) + (-1,))
    world_x = pose[..., 0] + cosine * lift(x) - sine * lift(y)
    world_y = pose[..., 1] + sine * lift(x) + cosine * lift(y)
    rows = (world_x - grid.origin_m[0]) / size_m - 0.5
    columns = (world_y - grid.origin_m[1]) / size_m - 0.5
    return bilinear(plan, rows, columns).max(axis=-1)


def bilinear(plane: Array, rows: Array, columns: Array) -> Array:
    """Samples [..., R, C] at fractional pixel centres [..., P]; zero outside."""
    height, width = plane.shape[-2:]
    lead = jnp.broadcast_shapes(plane.shape[:-2], rows.shape[:-1])
    flat = jnp.broadcast_to(plane, (*lead, height, width)).reshape(*lead, height * width)
    rows, columns = (jnp.broadcast_to(value, (*lead, value.shape[-1])) for value in (rows, columns))
    low_row, low_column = jnp.floor(rows), jnp.floor(columns)
    total = jnp.zeros(rows.shape, jnp.float32)
    for row_shift in (0, 1):
        for column_shift in (0, 1):
            row, column = low_row + row_shift, low_column + column_shift
            weight = (1.0 - jnp.abs(rows - row)) * (1.0 - jnp.abs(columns - column))
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            index = jnp.clip(row, 0, height - 1).astype(jnp.int32) * width
            index = index + jnp.clip(column, 0, width - 1).astype(jnp.int32)
            total = total + jnp.where(inside, weight * jnp.take_along_axis(flat, index, axis=-1), 0.0)
    return total


def route_distance_m(route_map: Array, pose: Array, route: RouteMap) -> Array:
    """Distance [...] of the car at pose [..., 3] from the nearest pixel on the route of the map [..., 64, 64].

    The map is the last observed one; the pose lies in the ego frame in which it was drawn. Without a route pixel the
    distance is that of the map's diagonal.
    """
    height, width = route_map.shape[-2:]
    x = (route.ego_row - (jnp.arange(height, dtype=jnp.float32) + 0.5)) * route.metres_per_px
    y = (route.ego_column - (jnp.arange(width, dtype=jnp.float32) + 0.5)) * route.metres_per_px
    spread = lambda values, axis: values.reshape([-1 if index == axis else 1 for index in range(pose.ndim + 1)])
    offset_x = spread(x, pose.ndim - 1) - pose[..., 0][..., None, None]
    offset_y = spread(y, pose.ndim) - pose[..., 1][..., None, None]
    square = offset_x**2 + offset_y**2
    farthest = float(height**2 + width**2) * route.metres_per_px**2
    nearest = jnp.where(route_map > 127, square, farthest).min(axis=(-2, -1))
    return jnp.sqrt(nearest + 1e-6)


def progress_m(moment: Moment, config: RewardConfig) -> Array:
    """Metres driven, faded by exp(-d^2 / 2 sigma^2) with the distance d from the route (no fading without a map)."""
    step = moment.after.pose[..., :2] - moment.before.pose[..., :2]
    driven = jnp.sqrt((step**2).sum(axis=-1) + 1e-12)
    if moment.route_map is None:
        return driven
    away = route_distance_m(moment.route_map, moment.after.pose, config.route)
    return driven * jnp.exp(-0.5 * (away / config.route_tolerance_m) ** 2)


def discomfort(moment: Moment, contract: config_lib.ActionContract, step_s: float, config: RewardConfig) -> Array:
    """(a_along / a_ok)^2 + (v^2 curvature / a_ok)^2: accelerations along and across in units of `comfortable_mps2`.

    Without a bicycle they come from the motion: change of speed and speed times turn, per second.
    """
    if contract.kinematics == "bicycle":
        along = motion_ops.acceleration_mps2(moment.action, contract)
        across = moment.after.speed_mps**2 * motion_ops.curvature_per_m(moment.action, contract)
    else:
        along = (moment.after.speed_mps - moment.before.speed_mps) / step_s
        across = moment.after.speed_mps * (moment.after.pose[..., 2] - moment.before.pose[..., 2]) / step_s
    return (along**2 + across**2) / config.comfortable_mps2**2


def speeding(moment: Moment, config: RewardConfig) -> Array:
    """How far above the limit, as a fraction of it: max(0, v / limit - 1)."""
    return jnp.maximum(moment.after.speed_mps / config.speed_limit_mps - 1.0, 0.0)


def collision(moment: Moment, grid: config_lib.VoxelGrid, config: RewardConfig) -> Array:
    """Collision probability in the occupancy decoded after the step, in whose frame the car stands at the origin."""
    plan = obstacle_plan(moment.decoded["occupancy"], grid, config.box)
    return box_collision(plan, jnp.zeros((*plan.shape[:-2], 3), jnp.float32), grid, config.box)


def driving_reward(moment: Moment, *, grid: config_lib.VoxelGrid, contract: config_lib.ActionContract, step_s: float,
                   config: RewardConfig) -> tuple[Array, Array, dict[str, Array]]:
    """The weighted sum of the terms above.

    reward = progress * progress_m / (limit * step_s) - collision * p - comfort * discomfort - speeding * speeding

    Returns:
      reward [...], terminated bool [...] (p above config.terminal_collision), and the terms by name.
    """
    terms = {"progress_m": progress_m(moment, config), "discomfort": discomfort(moment, contract, step_s, config),
             "speeding": speeding(moment, config)}
    reward = (config.progress * terms["progress_m"] / (config.speed_limit_mps * step_s)
              - config.comfort * terms["discomfort"] - config.speeding * terms["speeding"])
    terminated = jnp.zeros(reward.shape, jnp.bool_)
    if config.collision:
        terms["collision"] = collision(moment, grid, config)
        reward = reward - config.collision * terms["collision"]
        terminated = terms["collision"] > config.terminal_collision
    return reward, terminated, terms


LEARNED_HEADS = ("reward", "continue")


def learned_reward(moment: Moment) -> tuple[Array, Array, dict[str, Array]]:
    """What the heads reward and continue learned from the recording: reward, and an end where going on is improbable.

    Returns:
      reward [...] in the recording's own unit, terminated bool [...] (probability of going on below one half), and that
      probability as the term "continue".
    """
    going_on = jax.nn.sigmoid(moment.decoded["continue"][..., 0])
    return moment.decoded["reward"][..., 0], going_on < 0.5, {"continue": going_on}
