"""What an episode in imagination is made of: where it starts, what may change without compiling anew, its moments."""

from __future__ import annotations

from typing import Any

import flax.struct

from muvo_jax.agents import route as route_lib
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
