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
from muvo_jax.agents import route as route_lib
from muvo_jax.config import RouteMap
from muvo_jax.limits import COUNT, NOT_NEGATIVE, above, between
from muvo_jax.ops import motion as motion_ops
from muvo_jax.ops import reproject
from muvo_jax.types import Array, Motion

ROAD_M = 0.0  # its height in the ego frame; the voxels that hold it are occupied


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
      progress: per metre along the route, divided by the metres of a step at `speed_limit_mps`; what is more than those
        earns nothing.
      collision: times the probability that the drive collides in the step; what comes later counts as far as it has not
        (see `weighed`). It must cost more than all that a plan or an episode can earn until then: a drive that ends has
        no more to lose, and where collisions are cheap it is worth as much as braking in time.
      tolerated_collision: a collision probability up to this counts as none; it is about what a car parked beside the
        lane gives.
      comfort, speeding: times the respective penalty. The limit is the best speed whatever `speeding` is; equal to
        progress, a metre per second too fast costs what one too slow costs.
      terminal_collision: an imagined drive ends where the collision probability exceeds this; at 1 it never ends.
      ahead_s: the collision is sought where the car is and where it will be within this time; see `collision`.
      seen_s: what was seen at the start is an obstacle for this long, wherever imagination has it go.
      route_tolerance_m: sigma of the decay with distance from the route.
      speed_limit_mps: what counts as fast.
      comfortable_mps2: acceleration, along and across, that costs 1.
      occupancy_scale: decode occupancy at 1, 1/2 or 1/4 of its resolution; coarser is cheaper.
      box: the car.
      route: scale of the route map; where it is left at the town's, `Environment.of_run` takes the recording's.
    """

    progress: Annotated[float, NOT_NEGATIVE] = 1.0
    collision: Annotated[float, NOT_NEGATIVE] = 20.0
    comfort: Annotated[float, NOT_NEGATIVE] = 0.05
    speeding: Annotated[float, NOT_NEGATIVE] = 1.0
    tolerated_collision: Annotated[float, between(0, 0.99)] = 0.3
    terminal_collision: Annotated[float, NOT_NEGATIVE] = 0.7
    ahead_s: Annotated[float, NOT_NEGATIVE] = 0.4
    seen_s: Annotated[float, NOT_NEGATIVE] = 1.0
    route_tolerance_m: Annotated[float, above(0, unit="m")] = 1.0
    speed_limit_mps: Annotated[float, above(0, unit="m/s")] = 10.0
    comfortable_mps2: Annotated[float, above(0, unit="m/s2")] = 3.0
    occupancy_scale: Annotated[int, COUNT] = 1
    box: EgoBox = EgoBox()
    route: RouteMap = RouteMap()

    def __post_init__(self):
        limits.check(self)
        if self.occupancy_scale not in (1, 2, 4):
            raise ValueError(f"RewardConfig: occupancy_scale is {self.occupancy_scale}; expected 1, 2 or 4, the scales "
                             f"at which the head occupancy is decoded.")


@flax.struct.dataclass
class Moment:
    """One imagined step, all that a reward may look at. Leading axes: any.

    Attributes:
      before, after: Motion at the step's two ends, in the ego frame of the start.
      action: float32 [..., 2], applied in between.
      features: float32 [..., F], of the latent after the step.
      decoded: head -> full-size prediction after the step, for the heads that were asked for.
      route_map: uint8 or float32 [..., 64, 64], the last observed one, or None.
      route: the line that it shows, in the same frame as the motions, or None.
      seen: float32 [..., X, Y], 1 where something stood at the height of the car when the start was observed (see
        `seen_plan`), in the same frame; None where that is unknown.
      unharmed: float32 [...], the probability that the drive has not collided before the step; None counts as 1.
    """

    before: Motion
    after: Motion
    action: Array
    features: Array
    decoded: Mapping[str, Array]
    route_map: Array | None = None
    route: route_lib.Route | None = None
    seen: Array | None = None
    unharmed: Array | float | None = None


def obstacle_plan(occupancy: Array, grid: config_lib.VoxelGrid, box: EgoBox, *, pooled: bool = True) -> Array:
    """Probability that a column of voxels is occupied at the height of the car.

    Args:
      occupancy: logits [..., X, Y, Z, 2] as the head gives them; X may be a half or a quarter of the grid's.
      grid: the full-size grid.
      box: whose heights count; layers whose centre lies within, or the nearest one where there is none.
      pooled: see `centres_m`.

    Returns:
      float32 [..., X, Y], the largest softmax probability among those layers.
    """
    chosen = obstacle_layers(occupancy.shape[-2], grid, box, pooled=pooled)
    logits = occupancy[..., chosen[0]:chosen[-1] + 1, :].astype(jnp.float32)
    return jax.nn.sigmoid(logits[..., 1] - logits[..., 0]).max(axis=-1)


def centres_m(cells: int, axis: int, grid: config_lib.VoxelGrid, *, pooled: bool) -> tuple[np.ndarray, float]:
    """Where the `cells` of occupancy at some scale lie along an axis, as they were trained: (middles, spacing), m.

    A pooled cell stands for all voxels that it covers; numerics="reference" trains cell i of scale s on voxel s * i
    alone.
    """
    spacing_m = grid.voxel_size_m * grid.shape[axis] / cells
    first_m = 0.5 * (spacing_m if pooled else grid.voxel_size_m)
    return grid.origin_m[axis] + first_m + spacing_m * np.arange(cells), spacing_m


def obstacle_layers(layers: int, grid: config_lib.VoxelGrid, box: EgoBox, *, pooled: bool = True) -> np.ndarray:
    """The layers of occupancy that tell of obstacles, int [n].

    Raises:
      ValueError: where one of them holds the road, which is always occupied.
    """
    heights_m, spacing_m = centres_m(layers, 2, grid, pooled=pooled)
    chosen = np.flatnonzero((heights_m >= box.low_m) & (heights_m <= box.high_m))
    if not chosen.size:
        chosen = np.array([np.argmin(np.abs(heights_m - 0.5 * (box.low_m + box.high_m)))])
    thick_m = spacing_m if pooled else grid.voxel_size_m
    low_m, high_m = heights_m[chosen[0]] - 0.5 * thick_m, heights_m[chosen[-1]] + 0.5 * thick_m
    if low_m <= ROAD_M < high_m:
        raise ValueError(f"occupancy in {layers} layers: the one for the heights of a car, {box.low_m:g} to "
                         f"{box.high_m:g} m, reaches from {low_m:g} to {high_m:g} m and holds the road, so everything "
                         f"would be an obstacle. Read a finer scale (occupancy_scale), or lift the box.")
    return chosen


def full_size(plan: Array, grid: config_lib.VoxelGrid) -> Array:
    """A plan [..., x, y] of coarse occupancy as [..., X, Y]: each cell stands for all voxels that it covers."""
    for axis in (0, 1):
        plan = jnp.repeat(plan, grid.shape[axis] // plan.shape[axis - 2], axis=axis - 2)
    return plan


def seen_plan(range_view: Array, grid: config_lib.VoxelGrid, box: EgoBox) -> Array:
    """Where a scan [Hr, Wr, 4] hit something at the height of the car, but not under it: float32 [X, Y], 1 or 0."""
    points = range_view.reshape(1, -1, 4)
    hits = reproject.hit_voxels(points[..., :3], points[..., 3] > 0.0, grid)[0]
    layers = obstacle_layers(grid.shape[2], grid, box)
    (x, _), (y, _) = (centres_m(grid.shape[axis], axis, grid, pooled=True) for axis in (0, 1))
    own = ((x > box.rear_m) & (x < box.front_m))[:, None] & (np.abs(y) < box.half_width_m)[None]
    return jnp.where(own, 0.0, (hits[..., layers[0]:layers[-1] + 1] > 0.0).any(axis=-1).astype(jnp.float32))


def box_collision(plan: Array, poses: Array, grid: config_lib.VoxelGrid, box: EgoBox, *, pooled: bool = True) -> Array:
    """Probability that a car at each of N poses touches something: the largest one under its box.

    Args:
      plan: [..., X, Y] from obstacle_plan, in some ego frame.
      poses: [..., N, 3], x, y, yaw of the car in that frame; zeros for the occupancy decoded at the very step.
      grid: the full-size grid.
      box: the body, sampled bilinearly at most half a voxel apart, to a quarter of a voxel within its sides: an
        occupied voxel that begins where the car ends gives 1/4. Outside the grid nothing is occupied.
      pooled: see `centres_m`.

    Returns:
      float32 [..., N].
    """
    (rows_m, size_m), (columns_m, _) = (centres_m(plan.shape[axis - 2], axis, grid, pooled=pooled) for axis in (0, 1))
    spread = lambda low_m, high_m: np.linspace(low_m, high_m, math.ceil(2 * max(high_m - low_m, 0) / size_m) + 1)
    margin_m = min(0.25 * size_m, 0.5 * box.half_width_m)
    along = spread(box.rear_m + margin_m, box.front_m - margin_m)
    across = spread(margin_m - box.half_width_m, box.half_width_m - margin_m)
    x, y = (jnp.asarray(axis.ravel(), jnp.float32) for axis in np.meshgrid(along, across, indexing="ij"))
    poses = jnp.expand_dims(poses, -2)  # [..., N, 1, 3] beside the points [P]
    cosine, sine = jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])
    lift = lambda value: value.reshape((1,) * (cosine.ndim - 1) + (-1,))
    world_x = poses[..., 0] + cosine * lift(x) - sine * lift(y)
    world_y = poses[..., 1] + sine * lift(x) + cosine * lift(y)
    flat = lambda value: value.reshape(*value.shape[:-2], -1)
    sampled = bilinear(plan, flat((world_x - rows_m[0]) / size_m), flat((world_y - columns_m[0]) / size_m))
    return sampled.reshape(world_x.shape).max(axis=-1)


def poses_ahead(pose: Array, before: Motion, after: Motion, ahead_s: float) -> Array:
    """Where a car at pose [..., 3] is now and within `ahead_s` if it keeps speed and bend: [..., 5, 3].

    before, after: Motion [...] at the two ends of its last step; they give speed and bend.
    """
    step = after.pose - before.pose
    driven = jnp.sqrt((step[..., :2] ** 2).sum(axis=-1) + 1e-6)
    reach_m = jnp.stack([share * ahead_s * after.speed_mps for share in (0.0, 0.25, 0.5, 0.75, 1.0)], axis=-1)
    turn = reach_m * jnp.expand_dims(step[..., 2] / driven, -1)
    heading = jnp.expand_dims(pose[..., 2], -1) + 0.5 * turn
    way = jnp.stack([reach_m * jnp.cos(heading), reach_m * jnp.sin(heading), turn], axis=-1)
    return jnp.expand_dims(pose, -2) + way


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


def progress_m(moment: Moment, config: RewardConfig) -> Array:
    """Metres gained along the route in the direction in which the car stood on it at the start.

    What is gained counts exp(-d^2 / 2 sigma^2) at the distance d from the route, and never more than was driven; what
    is lost counts in full, wherever it was. So no drive, however it circles, leaves and rejoins, sums up to more than
    its end lies farther along than its start. Without a route map: metres along the heading of the start.
    """
    before, after = moment.before.pose, moment.after.pose
    if moment.route is None:
        return after[..., 0] - before[..., 0]
    driven = jnp.sqrt(((after - before)[..., :2] ** 2).sum(axis=-1) + 1e-12)
    along = route_lib.place(moment.route, before)[0]
    along_after, away = route_lib.place(moment.route, after)
    gained = along_after - along
    earned = jnp.minimum(gained, driven) * jnp.exp(-0.5 * (away / config.route_tolerance_m) ** 2)
    return jnp.where(gained > 0.0, earned, gained)


def discomfort(moment: Moment, contract: config_lib.ActionContract, step_s: float, config: RewardConfig) -> Array:
    """(a_along / a_ok)^2 + (v^2 curvature / a_ok)^2: accelerations along and across in units of `comfortable_mps2`.

    Without a bicycle they come from the motion: change of speed and speed times turn, per second. So does that along
    where a car has come to stand, whose brake is no acceleration.
    """
    along_as_moved = (moment.after.speed_mps - moment.before.speed_mps) / step_s
    if contract.kinematics == "bicycle":
        along = jnp.where(moment.after.speed_mps > 0.0, motion_ops.acceleration_mps2(moment.action, contract),
                          along_as_moved)
        across = moment.after.speed_mps**2 * motion_ops.curvature_per_m(moment.action, contract)
    else:
        along = along_as_moved
        across = moment.after.speed_mps * (moment.after.pose[..., 2] - moment.before.pose[..., 2]) / step_s
    return (along**2 + across**2) / config.comfortable_mps2**2


def speeding(moment: Moment, config: RewardConfig) -> Array:
    """How far above the limit, as a fraction of it: max(0, v / limit - 1)."""
    return jnp.maximum(moment.after.speed_mps / config.speed_limit_mps - 1.0, 0.0)


def collision(moment: Moment, grid: config_lib.VoxelGrid, config: RewardConfig, *, pooled: bool = True) -> Array:
    """Collision probability [...] after a step: the largest one where the car is and where it will be within `ahead_s`,
    in the occupancy decoded after the step (there the car stands at the origin) and in what was seen at the start.

    Imagination alone is not to be trusted here: no car of a recording ever saw an obstacle in its own place or close
    before it at speed, so a model learns that these places are empty and clears away what the car is about to hit.
    """
    plan = obstacle_plan(moment.decoded["occupancy"], grid, config.box, pooled=pooled)
    poses = poses_ahead(jnp.zeros_like(moment.after.pose), moment.before, moment.after, config.ahead_s)
    imagined = box_collision(plan, poses, grid, config.box, pooled=pooled).max(axis=-1)
    if moment.seen is None:
        return imagined
    poses = poses_ahead(moment.after.pose, moment.before, moment.after, config.ahead_s)
    return jnp.maximum(imagined, box_collision(moment.seen, poses, grid, config.box).max(axis=-1))


def driving_reward(moment: Moment, *, grid: config_lib.VoxelGrid, contract: config_lib.ActionContract, step_s: float,
                   config: RewardConfig, pooled: bool = True) -> tuple[Array, Array, dict[str, Array]]:
    """The weighted sum of the terms above; see `weighed`. `pooled`: see `centres_m`."""
    touched = collision(moment, grid, config, pooled=pooled) if config.collision else None
    return weighed(moment, touched, contract=contract, step_s=step_s, config=config)


def weighed(moment: Moment, touched: Array | None, *, contract: config_lib.ActionContract, step_s: float,
            config: RewardConfig) -> tuple[Array, Array, dict[str, Array]]:
    """The driving reward where the collision probability `touched` [...] is known; None leaves it out.

    reward = unharmed * (progress * progress_m / (limit * step_s) - collision * likely(p) - comfort * discomfort
             - speeding * speeding); gains above the limit are divided by speed / limit

    It is what is to be expected where the drive ends in each step with probability likely(p): all contacts of a drive
    together cost no more than one certain collision, and after them there is as little to gain. A reward function that
    wraps this one returns its terms, from which the environment knows how unharmed a drive is.

    Returns:
      reward [...], terminated bool [...] (p above config.terminal_collision), and the terms by name: among them
      "unharmed", the probability that the drive has not collided after the step either.
    """
    terms = {"progress_m": progress_m(moment, config), "discomfort": discomfort(moment, contract, step_s, config),
             "speeding": speeding(moment, config)}
    unharmed = 1.0 if moment.unharmed is None else moment.unharmed
    if touched is not None:
        terms |= {"collision": touched, "unharmed": unharmed * (1.0 - likely(touched, config))}
    reward = total(terms, moment.after.speed_mps, unharmed, step_s=step_s, config=config)
    ends = jnp.zeros(reward.shape, jnp.bool_) if touched is None else touched > config.terminal_collision
    return reward, ends, terms


def likely(touched: Array, config: RewardConfig) -> Array:
    """How likely a step of collision probability p ends the drive: max(0, p - q) / (1 - q), q what is tolerated."""
    return jnp.clip((touched - config.tolerated_collision) / (1.0 - config.tolerated_collision), 0.0, 1.0)


def unharmed_before(touched: Array, config: RewardConfig, at_first: Array | float = 1.0) -> Array:
    """The probability [..., H] that a drive has not collided before each step, from the collision probabilities
    [..., H] of all, `at_first` before the first."""
    after = at_first * jnp.cumprod(1.0 - likely(touched, config), axis=-1)
    return jnp.concatenate([jnp.broadcast_to(at_first, (*touched.shape[:-1], 1)), after[..., :-1]], axis=-1)


def total(terms: Mapping[str, Array], speed_mps: Array, unharmed: Array | float = 1.0, *, step_s: float,
          config: RewardConfig) -> Array:
    """The driving reward [...] of its terms, as `weighed` says; without the term "collision" nothing is touched.

    unharmed: as Moment's, before the step.
    """
    gained = terms["progress_m"] / (config.speed_limit_mps * step_s)
    fast = jnp.maximum(speed_mps / config.speed_limit_mps, 1.0)
    reward = (config.progress * jnp.where(gained > 0.0, gained / fast, gained)
              - config.comfort * terms["discomfort"] - config.speeding * terms["speeding"])
    if "collision" not in terms:
        return unharmed * reward
    return unharmed * (reward - config.collision * likely(terms["collision"], config))


LEARNED_HEADS = ("reward", "continue")


def learned_reward(moment: Moment) -> tuple[Array, Array, dict[str, Array]]:
    """What the heads reward and continue learned from the recording: reward, and an end where going on is improbable.

    Returns:
      reward [...] in the recording's own unit, terminated bool [...] (probability of going on below one half), and that
      probability as the term "continue".
    """
    going_on = jax.nn.sigmoid(moment.decoded["continue"][..., 0])
    return moment.decoded["reward"][..., 0], going_on < 0.5, {"continue": going_on}
