"""What an episode in imagination is made of: where it starts, what may change without compiling anew, its moments."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import route as route_lib
from muvo_jax.model import checks
from muvo_jax.model import memory as memory_lib
from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import Array, LatentState, Memory, Motion, Variables


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
        if jnp.shape(index) != lead or np.min(index) < 0 or np.max(index) >= count:
            raise ValueError(f"StartBank: {name} {list(jnp.shape(index))} reaches from {np.min(index)} to "
                             f"{np.max(index)}, but the memory holds {windows} windows of {frames} observations and "
                             f"there are {bank.size} starts. States and memory must come from one call of observe.")


@flax.struct.dataclass
class EnvParams:
    """Everything that may change without compiling anew.

    Attributes:
      variables: of the world model.
      bank: start states.
      max_steps_in_episode: int32, the horizon at which an episode is truncated.
      temperature: factor on the latent noise; 0 makes the world deterministic.
      routes: Route [M, ...], the line on each start's route map, or None where there are no maps.
      seen: float32 [M, X, Y], obstacles that each start's own scan showed (rewards.seen_plan), or None without memory.
    """

    variables: Variables
    bank: StartBank
    max_steps_in_episode: Array
    temperature: Array
    routes: route_lib.Route | None = None
    seen: Array | None = None


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
    """

    latent: LatentState
    motion: Motion
    start: Array
    time: Array
    reward: Array
    terminated: Array


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
