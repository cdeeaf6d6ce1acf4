"""Gymnasium: a functional environment (gymnasium.experimental.functional) and a plain gymnasium.Env."""

from __future__ import annotations

import functools
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
RENDER_MODES = ("rgb_array",)


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

    def render_init(self, params=None, **kwargs):
        del params, kwargs
        _check_rendered(self.core, "rgb_array")
        return ()

    def render_image(self, state, render_state, params=None):
        return render_state, camera_picture(self.core, self._or_default(params), state)

    def render_close(self, render_state, params=None):
        del render_state, params

    def _or_default(self, params):
        return self.default_params if params is None else params


class GymnasiumImagination(Env):
    """The core as a gymnasium.Env: NumPy in and out, one compiled step. Truncated at the horizon; does not restart.

    With render_mode="rgb_array", `render` gives the camera image that the model decodes: uint8 [H, W, 3].
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, core: environment_lib.Environment, params: environment_lib.EnvParams,
                 render_mode: str | None = None):
        _check_rendered(core, render_mode)
        optional.one_horizon("GymnasiumImagination", params)
        self.core, self.render_mode = core, render_mode
        self.metadata = self.metadata | {"render_fps": 1.0 / core.step_s}
        self.params = params
        self.observation_space, self.action_space = observation_space(core), action_space()
        self._state: environment_lib.EnvState | None = None

    def __getstate__(self):
        """For processes that spawn: arrays travel as NumPy's."""
        return vars(self) | {"params": jax.device_get(self.params), "_state": jax.device_get(self._state)}

    def __setstate__(self, kept):
        self.__dict__.update(kept)
        self.params = jax.tree.map(jnp.asarray, self.params)

    def reset(self, *, seed=None, options=None):
        forks.check("GymnasiumImagination.reset")
        super().reset(seed=seed, options=options)
        observation, self._state = _reset(self.core, self._key(), self.params)
        return jax.device_get(observation), {}

    def step(self, action):
        if self._state is None:
            raise ValueError("GymnasiumImagination.step before reset.")
        forks.check("GymnasiumImagination.step")
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():  # what is outside [-1, 1] is clipped
            raise ValueError(f"GymnasiumImagination.step: at step {int(self._state.time)} of the episode the action is "
                             f"{action.tolist()}; expected two finite numbers in [-1, 1] (acceleration, steering).")
        self._state, transition = _step(self.core, self._key(), self._state, action, self.params)
        transition = jax.device_get(transition)
        info = {name: float(value) for name, value in transition.terms.items()}
        return (transition.observation, float(transition.reward), bool(transition.terminated),
                bool(transition.truncated), info)

    def render(self):
        if self.render_mode is None:
            return None
        if self._state is None:
            raise ValueError("GymnasiumImagination.render before reset.")
        return camera_picture(self.core, self.params, self._state)

    def _key(self):
        return jax.random.key(int(self.np_random.integers(2**31)))


# Compiled once for all environments alike, copies included.
@functools.partial(jax.jit, static_argnames=("core",))
def _reset(core, key, params):
    return core.reset(key, params)


@functools.partial(jax.jit, static_argnames=("core",))
def _step(core, key, state, action, params):
    return core.step(key, state, action, params)


@functools.partial(jax.jit, static_argnames=("core",))
def _camera(core, params, state):
    image = core.decoded(state, params, ("image",))["image"]
    return jnp.round(255.0 * jnp.clip(image, 0.0, 1.0)).astype(jnp.uint8)


def camera_picture(core: environment_lib.Environment, params: environment_lib.EnvParams,
                   state: environment_lib.EnvState) -> np.ndarray:
    """The camera image that the model decodes of a state: uint8 [H, W, 3]."""
    return np.asarray(_camera(core, params, state))


def _check_rendered(core, render_mode):
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode is {render_mode!r}; expected {' or '.join(map(repr, RENDER_MODES))} or None.")
    if render_mode is not None and not hasattr(core, "model"):
        raise ValueError(f"render_mode={render_mode!r} decodes latents, and futures that were imagined before have "
                         f"none; pass None, or the environment itself.")
    if render_mode is not None and "image" not in core.model.config.heads:
        raise ValueError(f"render_mode={render_mode!r} shows the decoded camera image, but this run trained "
                         f"{', '.join(core.model.config.heads)}. Train the head (--with-heads=image), or pass None.")


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
