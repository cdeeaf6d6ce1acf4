"""What an episode in imagination is made of: where it starts, what may change without compiling anew, its moments."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.agents import rewards
from muvo_jax.agents import route as route_lib
from muvo_jax.model import checks
from muvo_jax.model import memory as memory_lib
from muvo_jax.model.world_model import WorldModel
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import Array, Batch, LatentState, Memory, Motion, Observed, Variables


@flax.struct.dataclass
class StartBank:
    """Where imagined drives start: M moments of a recording.

    Attributes:
      latent: LatentState [M, ...], filtered.
      speed_mps: float32 [M].
      route_map: uint8 [M, 64, 64], or None.
      memory: Memory [W, ...] of W windows, for a model with first_guess="last_seen"; held once, whatever is imagined.
      row: int32 [M], the window of each start.
    """

    latent: LatentState
    speed_mps: Array
    route_map: Array | None = None
    memory: Memory | None = None
    row: Array | None = None

    @property
    def size(self) -> int:
        return self.speed_mps.shape[0]


def starts(observed: Observed, batch: Batch, *, skip: int = 0) -> StartBank:
    """All frames of observed windows as start states; the first `skip` of each window are left out.

    Args:
      observed: Observed [B, T, ...] of `batch`.
      batch: with speed_mps; its route_map comes along where there is one.
      skip: frames whose latent has seen too little yet.

    Raises:
      ValueError: if the batch has no speed, is not the one that was observed, or no frame is left.
    """
    if batch.speed_mps is None:
        raise ValueError("Environment.starts: Batch.speed_mps is None; imagined drives need the speed at their "
                         "start.")
    seen, came = observed.states.stochastic.shape[:2], (batch.batch_size, batch.frames)
    if seen != came:
        raise ValueError(f"Environment.starts: the observed states are [B, T] = {list(seen)}, the batch is "
                         f"{list(came)}; pass the batch that `observe` was given.")
    if not 0 <= skip < batch.frames:
        raise ValueError(f"Environment.starts: skip is {skip}, but windows have {batch.frames} frames.")
    merge = lambda leaf: jnp.asarray(leaf[:, skip:]).reshape(-1, *leaf.shape[2:])
    rows = jnp.repeat(jnp.arange(batch.batch_size, dtype=jnp.int32), batch.frames - skip)
    return StartBank(jax.tree.map(merge, observed.states), merge(batch.speed_mps),
                     None if batch.route_map is None else merge(batch.route_map), observed.memory, rows)


def check(model: WorldModel, bank: StartBank) -> None:
    """Raises ValueError for a bank that this model cannot start from: of another model or recording, or empty."""
    lead = checks.state(model, bank.latent)
    if len(lead) != 1 or bank.size < 1 or lead != bank.speed_mps.shape:
        raise ValueError(f"StartBank: got states {list(lead)} and speeds {list(bank.speed_mps.shape)}; expected "
                         f"both [M] with M at least 1.")
    checks.finite("StartBank", latent=bank.latent, speed_mps=bank.speed_mps)
    maps = bank.route_map
    if maps is not None and (jnp.ndim(maps) != 3 or maps.shape[0] != bank.size or maps.shape[1] != maps.shape[2]):
        raise ValueError(f"StartBank: got route maps {list(jnp.shape(maps))}, expected [{bank.size}, 64, 64], one for "
                         f"each start.")
    if bank.memory is None or bank.row is None:
        return
    memory_lib.check_sizes("StartBank", model.config, bank.memory)
    windows, frames = bank.memory.pose.shape[:2]
    indices = {"row": (bank.row, windows)}
    if bank.latent.vantage is not None:
        indices["latent.vantage.last"] = bank.latent.vantage.last, frames
    for name, (index, count) in indices.items():
        if isinstance(index, jax.core.Tracer):
            continue
        places = np.asarray(index)  # concrete where the rest is traced, too
        if places.shape != lead or places.min() < 0 or places.max() >= count:
            raise ValueError(f"StartBank: {name} {list(places.shape)} reaches from {places.min()} to "
                             f"{places.max()}, but the memory holds {windows} windows of {frames} observations and "
                             f"there are {bank.size} starts. States and memory must come from one call of observe.")


def routes(bank: StartBank, scale: config_lib.RouteMap) -> route_lib.Route | None:
    """Route [M, ...], the line on each start's route map; None where there are no maps."""
    return None if bank.route_map is None else _follow(jnp.asarray(bank.route_map), scale)


@functools.partial(jax.jit, static_argnames=("scale",))
def _follow(route_maps, scale):
    return jax.vmap(lambda route_map: route_lib.follow(route_map, scale))(route_maps)


@flax.struct.dataclass
class Plans:
    """What stood at the height of the car at some moments, the newest last. Leading axes [..., moments] unless said.

    Attributes:
      plan: float32 [..., X, Y] in the frame of the car of that moment, of rewards.obstacle_plan or rewards.seen_plan.
      pose: float32 [..., 3], where that car stood, in the frame of the start.
    """

    plan: Array
    pose: Array

    def __getitem__(self, index: Any) -> Plans:
        return jax.tree.map(lambda leaf: leaf[index], self)

    def then(self, plan: Array, pose: Array) -> Plans:
        """As many moments [moments, ...] with a new one; the oldest is forgotten."""
        return jax.tree.map(lambda kept, new: jnp.concatenate([kept[1:], new[None]]), self, Plans(plan, pose))


def seen(bank: StartBank, grid: config_lib.VoxelGrid, box: rewards.EgoBox, before: int) -> Plans | None:
    """Plans [M, before + 1] of what each start's own scan showed, and the scans of so many observations before it; None
    without memory. Where there were not so many, the oldest stands for those that are missing."""
    if bank.memory is None or bank.row is None or bank.latent.vantage is None:
        return None
    vantage = bank.latent.vantage
    return _seen(bank.memory.range_view, bank.memory.pose, bank.row, vantage.first, vantage.last, grid, box, before)


@functools.partial(jax.jit, static_argnames=("grid", "box", "before"))
def _seen(scans, poses, row, first, last, grid, box, before):
    index = jnp.maximum(last[:, None] + jnp.arange(-before, 1, dtype=jnp.int32)[None], jnp.maximum(first, 0)[:, None])
    rows = jnp.broadcast_to(row[:, None], index.shape)
    plan = jax.lax.map(lambda which: rewards.seen_plan(scans[which[0], which[1]], grid, box),
                       (rows.reshape(-1), index.reshape(-1)))
    pose = motion_ops.relative(poses[rows, index], poses[row, last][:, None])
    return Plans(plan.reshape(*index.shape, *plan.shape[1:]), pose)


@flax.struct.dataclass
class EnvParams:
    """Everything that may change without compiling anew.

    Attributes:
      variables: of the world model.
      bank: start states.
      max_steps_in_episode: int32, the horizon at which an episode is truncated.
      temperature: factor on the latent noise; 0 makes the world deterministic.
      routes: Route [M, ...], the line on each start's route map, or None where there are no maps.
      seen: Plans [M, ...] of rewards.seen_plan, what each start's own scan and those before it showed, or None without
        memory.
    """

    variables: Variables
    bank: StartBank
    max_steps_in_episode: Array
    temperature: Array
    routes: route_lib.Route | None = None
    seen: Plans | None = None

    def route_of(self, state: EnvState) -> route_lib.Route | None:
        """The route of a state's start, or None."""
        return None if self.routes is None else jax.tree.map(lambda leaf: leaf[state.start], self.routes)


@flax.struct.dataclass
class EnvState:
    """A moment of an episode.

    Attributes:
      latent: LatentState [...].
      motion: Motion of the car in the ego frame of the start.
      start: int32, index into the bank.
      time: int32, steps since the start.
      reward: float32, of the step that led here; 0 at the start.
      terminated: bool, at that step; false at the start.
      unharmed: float32, the probability that the drive has not collided so far; 1 at the start, and where the reward's
        terms do not say it (rewards.weighed).
      past: Plans [road.BEFORE_S earlier .. now], of scans until the start and decoded since, for the observation "road"
        of a model with memory; else None.
    """

    latent: LatentState
    motion: Motion
    start: Array
    time: Array
    reward: Array
    terminated: Array
    unharmed: Array | float = 1.0
    past: Plans | None = None


@flax.struct.dataclass
class Transition:
    """What a step gives beside the next state.

    Attributes:
      observation: float32 [P] of that state (model.policy_features), or a dict of decoded heads.
      reward: float32.
      terminated: bool, whether the reward function ends the episode.
      truncated: bool, whether its horizon does; both may be true, and `final` is either.
      terms: float32 each, what the reward is made of, by name.
    """

    observation: Any
    reward: Array
    terminated: Array
    truncated: Array
    terms: dict[str, Array]

    @property
    def final(self) -> Array:
        return self.terminated | self.truncated


def restart(core: Any, key: Array, state: EnvState, observation: Any, final: Array,
            params: Any) -> tuple[EnvState, Any]:
    """Where `final`, a fresh start of an environment takes the place of state and observation."""
    fresh_observation, fresh = core.reset(key, params)
    choose = lambda new, old: jnp.where(final, new, old)
    return jax.tree.map(choose, fresh, state), jax.tree.map(choose, fresh_observation, observation)
