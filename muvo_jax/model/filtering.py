"""What both transitions have in common: one step of filtering or of imagination, deterministic given its noise.

A subclass says how the state moves and how it looks at actions and observations:

    state_shapes(config)                              shapes of h and s of one sample
    initial_constants(config)                         first values of some parameters
    recur(state, effect)                         -> h'    the recurrence
    predict(h', action, effect, keys)            -> prior
    infer(h', embedding, action, effect, keys)   -> posterior

As in the reference the action enters the prior and the posterior. With action_path="recurrence" what it does, its
`effect`, enters everything: a prior that reads one action among many tokens learns to ignore it. Differs from the
reference in the slope of the leaky ReLUs, 0.01 here and 1 there (numerics="reference"), and in drawing the RSSM
dropout's coin per sample instead of per batch.
"""

from __future__ import annotations

import abc
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import memory
from muvo_jax.nn import layers
from muvo_jax.types import Gaussian, LatentState, Motion, StepNoise

LEAKY_SLOPE = {"standard": 0.01, "reference": 1.0}
# A fresh model's raw standard deviation: 2 sigmoid(-4 / 2) + 0.1 = 0.34. At 0, which gives 1.1, the noise of the first
# steps hides what the latent says, and it is long ignored. Trained weights bring their own.
_INITIAL_RAW_STD = -4.0
_STEP_UNITS = (1.0, 0.1, 0.05, 0.5, 5.0)  # forward m, left m, turn rad, gained m/s, m/s: about 1 in a town at 5 Hz


def gaussian(moments: jax.Array) -> Gaussian:
    """[..., 2 S] -> Gaussian [..., S] in float32; std = 2 sigmoid(raw / 2) + 0.1 lies in (0.1, 2.1)."""
    mean, raw = jnp.split(moments.astype(jnp.float32), 2, axis=-1)
    return Gaussian(mean, 2.0 * jax.nn.sigmoid(raw / 2.0) + 0.1)


def initial_moments(channels: int) -> np.ndarray:
    """First bias [2 channels] of the layer whose output `gaussian` reads: zero means and the first deviation."""
    return np.repeat(np.array([0.0, _INITIAL_RAW_STD], np.float32), channels)


def where(condition: jax.Array, chosen: jax.Array, other: jax.Array) -> jax.Array:
    """jnp.where for a condition that has the leading axes of the values only."""
    spread = condition.reshape(condition.shape + (1,) * (other.ndim - condition.ndim))
    return jnp.where(spread, chosen, other)


class Transition(linen.Module, abc.ABC):
    """The interface of muvo_jax.model.transition.REGISTRY, over states [B, ...]."""

    config: ModelConfig

    @staticmethod
    @abc.abstractmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of the deterministic and of the stochastic state of one sample."""

    @staticmethod
    @abc.abstractmethod
    def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
        """Path of a parameter below "transition" -> its first value."""

    @abc.abstractmethod
    def recur(self, state: LatentState, effect: jax.Array | None) -> jax.Array:
        """The next deterministic state; effect [B, E] of the action, None where action_path is "prior"."""

    @abc.abstractmethod
    def predict(self, deterministic: jax.Array, action: jax.Array, effect: jax.Array | None,
                keys: jax.Array | None) -> Gaussian:
        """The prior; keys [B] switch dropout on."""

    @abc.abstractmethod
    def infer(self, deterministic: jax.Array, embedding: jax.Array, action: jax.Array, effect: jax.Array | None,
              keys: jax.Array | None) -> Gaussian:
        """The posterior; keys [B] switch dropout on."""

    @classmethod
    def initial_state(cls, config: ModelConfig, batch_size: int) -> LatentState:
        """The zero state, [batch_size, ...], before anything was seen."""
        vantage = memory.initial_vantage(config, batch_size) if config.tracks_motion else None
        deterministic, stochastic = cls.state_shapes(config)
        return LatentState(jnp.zeros((batch_size, *deterministic), jnp.float32),
                           jnp.zeros((batch_size, *stochastic), jnp.float32), vantage)

    def observe_step(self, noise: StepNoise, state: LatentState, action: jax.Array, embedding: jax.Array,
                     is_first: jax.Array) -> tuple[LatentState, tuple[Gaussian, Gaussian]]:
        """One step with an observation; see WorldModel.observe_step. The vantage is left to whoever observed."""
        state = jax.tree.map(lambda leaf: where(is_first, jnp.zeros_like(leaf), leaf), state)
        action = where(is_first, jnp.zeros_like(action), action)
        effect, _ = self.effect(action, state)
        deterministic = self.recur(state, effect)
        prior = self.predict(deterministic, action, effect, noise.dropout)
        posterior = self.infer(deterministic, embedding, action, effect, noise.dropout)
        stochastic = where(noise.use_prior & ~is_first, prior.sample(noise.prior), posterior.sample(noise.posterior))
        return dataclasses.replace(state, deterministic=deterministic, stochastic=stochastic), (prior, posterior)

    def imagine_step(self, noise: jax.Array, state: LatentState, action: jax.Array) -> tuple[LatentState, Gaussian]:
        """One step without an observation; see WorldModel.imagine_step."""
        effect, step = self.effect(action, state)
        deterministic = self.recur(state, effect)
        prior = self.predict(deterministic, action, effect, None)
        vantage = state.vantage
        if vantage is not None and step is not None:
            vantage = memory.moved_on(vantage, step)
        return LatentState(deterministic, prior.sample(noise), vantage), prior

    def effect(self, action: jax.Array, state: LatentState) -> tuple[jax.Array | None, Motion | None]:
        """What an action does: as the recurrence reads it, and the step of the car, each where the model knows it."""
        config, vantage = self.config, state.vantage
        step = memory.intended(config, vantage, action) if vantage is not None and config.kinematics else None
        if config.action_path == "prior":
            return None, step
        parts = [action / layers.per_channel(self.action_spread.value, action.ndim)]
        if vantage is not None and step is not None:
            gained_mps = step.speed_mps - vantage.motion.speed_mps
            moved = jnp.concatenate([step.pose, jnp.stack([gained_mps, step.speed_mps], axis=-1)], axis=-1)
            parts.append(moved / layers.per_channel(jnp.asarray(_STEP_UNITS, jnp.float32), moved.ndim))
        return jnp.concatenate(parts, axis=-1), step
