"""Mctx: `root` and `recurrent_fn` over imagined states. Mctx knows discrete actions only, so continuous ones are chosen
from a fixed grid, or from candidates that a policy samples anew in every node (sampled MuZero).

The embedding of a node is the environment's state (and the node's candidates): no decoded images.
Mctx asks for a model that is deterministic given its key; EnvParams with temperature 0 make it so whatever the key.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents.doors import optional
from muvo_jax.types import Array

mctx: Any = optional.need("mctx", "mctx")

# (agent parameters, observation [F]) -> (prior logits [K], value []) for a grid;
# (agent parameters, key, observation [F]) -> (candidates [K, 2], prior logits [K], value []) for sampled candidates.
GridPrior = Callable[[Any, Array], tuple[Array, Array]]
CandidatePrior = Callable[[Any, Array, Array], tuple[Array, Array, Array]]


@flax.struct.dataclass
class SearchParams:
    """What mctx passes through as `params`: the environment's and the agent's."""

    environment: environment_lib.EnvParams
    agent: Any


@flax.struct.dataclass
class Embedding:
    """What a node of the tree stores: EnvState [B, ...] and the actions that can be chosen there, [B, K, 2]."""

    state: environment_lib.EnvState
    candidates: Array


def action_grid(accelerations: int = 3, steerings: int = 5) -> Array:
    """All pairs of evenly spaced accelerations and steerings in [-1, 1], float32 [K, 2]."""
    axes = np.meshgrid(np.linspace(-1, 1, accelerations), np.linspace(-1, 1, steerings), indexing="ij")
    return jnp.asarray(np.stack(axes, axis=-1).reshape(-1, 2), jnp.float32)


@dataclasses.dataclass(frozen=True)
class MctxModel:
    """`root` and `recurrent_fn` of one environment and one prior.

    Attributes:
      core: the environment.
      prior: a CandidatePrior; `on_grid` makes one of a GridPrior.
      discount: per step; nodes that terminated get 0.
    """

    core: environment_lib.Environment
    prior: CandidatePrior
    discount: float = 0.99

    def root(self, params: SearchParams, rng_key: Array, state: environment_lib.EnvState) -> Any:
        """The root over EnvStates [B, ...]."""
        candidates, logits, value = self._prior(params, rng_key, state)
        return mctx.RootFnOutput(prior_logits=logits, value=value, embedding=Embedding(state, candidates))

    def recurrent_fn(self, params: SearchParams, rng_key: Array, action: Array,
                     embedding: Embedding) -> tuple[Any, Embedding]:
        """One imagined step from each of B nodes; action int32 [B] indexes the node's candidates."""
        key_step, key_prior = jax.random.split(rng_key)
        chosen = jnp.take_along_axis(embedding.candidates, action[:, None, None], axis=1)[:, 0]
        keys = jax.random.split(key_step, action.shape[0])
        advance = jax.vmap(self.core.step, (0, 0, 0, None))
        state, transition = advance(keys, embedding.state, chosen, params.environment)
        candidates, logits, value = self._prior(params, key_prior, state)
        ends = transition.terminated
        output = mctx.RecurrentFnOutput(reward=transition.reward, discount=jnp.where(ends, 0.0, self.discount),
                                        prior_logits=logits, value=jnp.where(ends, 0.0, value))
        return output, Embedding(state, candidates)

    def action(self, root: Any, chosen: Array) -> Array:
        """The continuous actions [B, 2] of the indices [B] that a search chose at `root`."""
        return jnp.take_along_axis(root.embedding.candidates, chosen[:, None, None], axis=1)[:, 0]

    def _prior(self, params, key, state):
        observation = jax.vmap(self.core.observe, (0, None))(state, params.environment)
        keys = jax.random.split(key, state.time.shape[0])
        return jax.vmap(self.prior, (None, 0, 0))(params.agent, keys, observation)


def on_grid(grid: Array, prior: GridPrior) -> CandidatePrior:
    """A prior over a fixed grid of actions [K, 2]."""
    def with_grid(agent, key, observation):
        del key
        return (grid, *prior(agent, observation))

    return with_grid
