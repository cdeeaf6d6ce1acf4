"""Stoa (package stoa-env), natively: TimeSteps of type FIRST, MID, TERMINATED, TRUNCATED; the key is in the state."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents.doors import optional
from muvo_jax.types import Array

Base: Any = optional.need("stoa.environment", "stoa").Environment
stoa_types: Any = optional.need("stoa.env_types", "stoa")
stoa_spaces: Any = optional.need("stoa.spaces", "stoa")


@flax.struct.dataclass
class StoaState:
    """The core's state and the key of what comes (raw where the reset's key was raw)."""

    core: environment_lib.EnvState
    rng_key: Array


class StoaImagination(Base):
    """The core as a stoa Environment; env_params are the core's EnvParams (default: those given here).

    The discount is 0 where the drive terminated and 1 elsewhere, at the horizon too.
    """

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams):
        self.core = core
        self.params = params

    def reset(self, rng_key, env_params=None):
        rng_key, key_start = jax.random.split(rng_key)
        observation, state = self.core.reset(key_start, self.params if env_params is None else env_params)
        step_type = stoa_types.StepType.FIRST
        return StoaState(state, rng_key), stoa_types.TimeStep(step_type, jnp.float32(0), jnp.float32(1), observation)

    def step(self, state, action, env_params=None):
        rng_key, key_step = jax.random.split(state.rng_key)
        after, transition = self.core.step(key_step, state.core, action,
                                           self.params if env_params is None else env_params)
        kinds = stoa_types.StepType
        step_type = jnp.where(transition.terminated, kinds.TERMINATED,
                              jnp.where(transition.truncated, kinds.TRUNCATED, kinds.MID))
        discount = 1.0 - transition.terminated.astype(jnp.float32)
        return StoaState(after, rng_key), stoa_types.TimeStep(step_type, transition.reward, discount,
                                                              transition.observation)

    def observation_space(self, env_params=None):
        del env_params
        return _spaces(self.core.observation_shapes, "observation")

    def action_space(self, env_params=None):
        del env_params
        return stoa_spaces.BoundedArraySpace((environment_lib.ACTION_CHANNELS,), jnp.float32, -1.0, 1.0, "action")

    def state_space(self, env_params=None):
        params = self.params if env_params is None else env_params
        state = jax.eval_shape(lambda: self.core.reset(jax.random.key(0), params)[1])
        return _spaces({jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(state)},
                       "state")


def _spaces(shapes: Any, name: str):
    if isinstance(shapes, dict):
        return stoa_spaces.DictSpace({key: _spaces(leaf, key) for key, leaf in shapes.items()}, name)
    return stoa_spaces.ArraySpace(shapes.shape, shapes.dtype, name)
