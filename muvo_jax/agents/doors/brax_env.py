"""Brax: an Env whose State is brax's dataclass. Raw keys at the border, float `done`, typed keys inside.

`done` says that the drive ended in imagination (terminated). The horizon is a truncation, which brax leaves to its
EpisodeWrapper: give `episode_length` to brax.envs.training.wrap or to brax's train functions. Without that wrapper
`info["truncation"]` says so. Brax has no environment parameters: weights and starts become constants of what it
compiles.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents.doors import optional

_base: Any = optional.need("brax.envs.base", "brax")
Base: Any = _base.Env


class BraxImagination(Base):
    """The core as a brax Env; decoded sensors come as a dict by head."""

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams):
        optional.one_horizon("BraxImagination", params)
        self.core = core
        self._params = params

    def reset(self, rng: jax.Array) -> Any:
        key, key_start = jax.random.split(_typed(rng))
        observation, state = self.core.reset(key_start, self._params)
        metrics = jax.eval_shape(lambda: self.core.step(key, state, jnp.zeros(2, jnp.float32), self._params)[1].terms)
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), metrics)
        info = {"key": jax.random.key_data(key), "truncation": jnp.float32(0)}
        return _base.State(state, observation, jnp.float32(0), jnp.float32(0), zeros, info)

    def step(self, state: Any, action: jax.Array) -> Any:
        key, key_step = jax.random.split(_typed(state.info["key"]))
        after, transition = self.core.step(key_step, state.pipeline_state, action, self._params)
        truncation = (transition.truncated & ~transition.terminated).astype(jnp.float32)
        info = {**state.info, "key": jax.random.key_data(key), "truncation": truncation}
        return state.replace(pipeline_state=after, obs=transition.observation, reward=transition.reward,
                             done=transition.terminated.astype(jnp.float32), metrics={**state.metrics,
                                                                                      **transition.terms}, info=info)

    @property
    def episode_length(self) -> int:
        """The horizon, for brax's EpisodeWrapper."""
        return int(self._params.max_steps_in_episode)

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:
        """Channels of the vector, or the shape of each head."""
        shapes = self.core.observation_shapes
        return {name: leaf.shape for name, leaf in shapes.items()} if isinstance(shapes, dict) else shapes.shape[-1]

    @property
    def action_size(self) -> int:
        return environment_lib.ACTION_CHANNELS

    @property
    def backend(self) -> str:
        return "muvo_jax"


def _typed(key: jax.Array) -> jax.Array:
    return key if jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)
