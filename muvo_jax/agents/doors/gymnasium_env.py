"""Gymnasium: a functional environment (gymnasium.experimental.functional) and a plain gymnasium.Env."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import forks
from muvo_jax.agents.doors import optional

gymnasium: Any = optional.need("gymnasium", "gymnasium")
Functional: Any = optional.need("gymnasium.experimental.functional", "gymnasium").FuncEnv
Env: Any = gymnasium.Env


class FunctionalImagination(Functional):
    """The core as a FuncEnv. A FuncEnv has no truncation: FunctionalJaxEnv(...) needs a TimeLimit of the horizon.

    Keys may be raw or typed. Gymnasium's wrapper gives one key to transition and observation alike; the observation
    here draws nothing.
    """

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams):
        self.core = core
        self.observation_space, self.action_space = observation_space(core), action_space()
        super().__init__()
        self.default_params = params

    def initial(self, rng, params=None):
        return self.core.reset(rng, self._or_default(params))[1]

    def transition(self, state, action, rng, params=None):
        return self.core.step(rng, state, action, self._or_default(params))[0]

    def observation(self, state, rng, params=None):
        del rng
        return self.core.observe(state, self._or_default(params))

    def reward(self, state, action, next_state, rng, params=None):
        del state, action, rng, params
        return next_state.reward

    def terminal(self, state, rng, params=None):
        del rng, params
        return state.terminated

    def _or_default(self, params):
        return self.default_params if params is None else params


class GymnasiumImagination(Env):
    """The core as a gymnasium.Env: NumPy in and out, one compiled step. Truncated at the horizon; does not restart."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own form)
    render_mode = None

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams):
        self.core = core
        self.params = params
        self.observation_space, self.action_space = observation_space(core), action_space()
        self._compile()
        self._state: environment_lib.EnvState | None = None

    def _compile(self):
        self._reset, self._step = jax.jit(self.core.reset), jax.jit(self.core.step)

    def __getstate__(self):
        """For processes that spawn: compiled functions are made anew there, arrays travel as NumPy's."""
        kept = {name: value for name, value in vars(self).items() if name not in ("_reset", "_step")}
        return kept | {"params": jax.device_get(self.params), "_state": jax.device_get(self._state)}

    def __setstate__(self, kept):
        self.__dict__.update(kept)
        self.params = jax.tree.map(jnp.asarray, self.params)
        self._compile()

    def reset(self, *, seed=None, options=None):
        forks.check("GymnasiumImagination.reset")
        super().reset(seed=seed, options=options)
        observation, self._state = self._reset(self._key(), self.params)
        return jax.device_get(observation), {}

    def step(self, action):
        if self._state is None:
            raise ValueError("GymnasiumImagination.step before reset.")
        forks.check("GymnasiumImagination.step")
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():  # what is outside [-1, 1] is clipped
            raise ValueError(f"GymnasiumImagination.step: at step {int(self._state.time)} of the episode the action is "
                             f"{action.tolist()}; expected two finite numbers in [-1, 1] (acceleration, steering).")
        self._state, transition = self._step(self._key(), self._state, action, self.params)
        transition = jax.device_get(transition)
        info = {name: float(value) for name, value in transition.terms.items()}
        return (transition.observation, float(transition.reward), bool(transition.terminated),
                bool(transition.truncated), info)

    def _key(self):
        return jax.random.key(int(self.np_random.integers(2**31)))


def action_space():
    """(acceleration, steering)."""
    return gymnasium.spaces.Box(-1.0, 1.0, (environment_lib.ACTION_CHANNELS,), np.float32)


def observation_space(core: environment_lib.Environment):
    """A Box, or a Dict of them by head."""
    box = lambda leaf: gymnasium.spaces.Box(-np.inf, np.inf, leaf.shape, np.float32)
    shapes = core.observation_shapes
    if isinstance(shapes, dict):
        return gymnasium.spaces.Dict({name: box(leaf) for name, leaf in shapes.items()})
    return box(shapes)
