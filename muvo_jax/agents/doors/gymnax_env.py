"""Gymnax 1.0: Environment with six values from `step`, auto-reset inside, the final observation in `info`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents.doors import optional
from muvo_jax.model import checks

Base: Any = optional.need("gymnax.environments.environment", "gymnax").Environment
gymnax_spaces: Any = optional.need("gymnax.environments.spaces", "gymnax")


class GymnaxImagination(Base):
    """The core under gymnax's names; the weights and start states are its params (pass them, or they are constants).

    `with_transition_gradients()` lets gradients through.
    """

    _supports_transition_gradients = True

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams):
        self.core = core
        self._params = params

    @property
    def default_params(self) -> environment_lib.EnvParams:
        return self._params

    def step(self, key, state, action, params=None):
        # Gymnax compiles `step`: inside, nothing lies on the host any more.
        checks.finite_on_host("GymnaxImagination.step", action=action, state=state)
        return super().step(key, state, action, params)

    def reset_env(self, key, params):
        return self.core.reset(key, params)

    def step_env(self, key, state, action, params):
        state, transition = self.core.step(key, state, action, params)
        observation, state = self._apply_transition_gradient_policy(transition.observation, state)
        return observation, state, transition.reward, transition.terminated, dict(transition.terms)

    def observe(self, key, state, action, params):
        del key, action
        return self.core.observe(state, params)

    def is_terminated(self, state, params):
        del params
        return state.terminated

    @property
    def name(self) -> str:
        return "MuvoImagination"

    def action_space(self, params=None):
        del params
        return gymnax_spaces.Box(-1.0, 1.0, (environment_lib.ACTION_CHANNELS,), jnp.float32)

    def observation_space(self, params=None):
        del params
        box = lambda leaf: gymnax_spaces.Box(-jnp.inf, jnp.inf, leaf.shape, leaf.dtype)
        shapes: Any = self.core.observation_shapes
        if isinstance(shapes, dict):
            return gymnax_spaces.Dict({name: box(leaf) for name, leaf in shapes.items()})
        return jax.tree.map(box, shapes)
