"""The recurrent state-space model with a vector state (paper section III-C, the 1D latent).

A step is deterministic given its noise. Every transition of the registry offers the same three things: `initial_state`,
`observe_step` and `imagine_step`, over muvo_jax.types.LatentState and Gaussian.

The action enters the prior and the posterior, not the recurrence, as in the reference. Differs from the reference in
the slope of its leaky ReLUs, 0.01 here and 1 there (numerics="reference"), and in drawing the RSSM dropout's coin per
sample instead of per batch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common
from muvo_jax.nn import layers
from muvo_jax.types import Gaussian, LatentState, StepNoise

LEAKY_SLOPE = {"standard": 0.01, "reference": 1.0}
# A fresh model's raw standard deviation: 2 sigmoid(-4 / 2) + 0.1 = 0.34. At 0, which gives 1.1, the noise of the first
# steps hides what the latent says, and it is long ignored. Trained weights bring their own.
_INITIAL_RAW_STD = -4.0


def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
    """Path of a parameter -> its first value: zero means and the first standard deviation of both Gaussian heads."""
    bias = np.repeat(np.array([0.0, _INITIAL_RAW_STD], np.float32), config.stochastic_channels)
    return {f"transition/{head}/out/bias": bias for head in ("prior", "posterior")}


class GRUCell(linen.Module):
    """Torch's GRU, (state [..., D], x [..., I]) -> state: gates in the order reset, update, new; two bias vectors."""

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, state: jax.Array, x: jax.Array) -> jax.Array:
        dtype = self.compute.dtype
        size = 3 * self.features
        input_kernel = self.param("input_kernel", layers.shape_only, (x.shape[-1], size))
        hidden_kernel = self.param("hidden_kernel", layers.shape_only, (self.features, size))
        input_bias = self.param("input_bias", layers.shape_only, (size,))
        hidden_bias = self.param("hidden_bias", layers.shape_only, (size,))
        affine = lambda value, kernel, bias: jnp.dot(
            value.astype(dtype), kernel.astype(dtype)).astype(jnp.float32) + layers.per_channel(bias, value.ndim)
        input_reset, input_update, input_new = jnp.split(affine(x, input_kernel, input_bias), 3, axis=-1)
        hidden_reset, hidden_update, hidden_new = jnp.split(affine(state, hidden_kernel, hidden_bias), 3, axis=-1)
        reset = jax.nn.sigmoid(input_reset + hidden_reset)
        update = jax.nn.sigmoid(input_update + hidden_update)
        new = jnp.tanh(input_new + reset * hidden_new)
        return (1.0 - update) * new + update * state


class GaussianHead(linen.Module):
    """[..., C] and an action [..., 2] -> Gaussian [..., channels]: action embedding, two dense layers.

    std = 2 sigmoid(raw / 2) + 0.1 lies in (0.1, 2.1).
    """

    channels: int
    action_channels: int
    slope: float
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, action: jax.Array) -> Gaussian:
        embedded = layers.Dense(self.action_channels, self.compute, name="action")(action)
        joined = jnp.concatenate([x.astype(embedded.dtype), jax.nn.leaky_relu(embedded, self.slope)], axis=-1)
        hidden = layers.Dense(joined.shape[-1], self.compute, name="hidden")(joined)
        out = layers.Dense(2 * self.channels, self.compute, name="out")(jax.nn.leaky_relu(hidden, self.slope))
        mean, raw = jnp.split(out.astype(jnp.float32), 2, axis=-1)
        return Gaussian(mean, 2.0 * jax.nn.sigmoid(raw / 2.0) + 0.1)


class VectorTransition(linen.Module):
    """1D: h' = GRU(f(s), h); prior(h', action), posterior(h', embedding, action)."""

    config: ModelConfig

    def setup(self):
        config, compute = self.config, common.compute(self.config)
        self.slope = LEAKY_SLOPE[config.numerics]
        self.pre_gru = layers.Dense(config.deterministic_channels, compute)
        self.gru = GRUCell(config.deterministic_channels, compute)
        head = lambda: GaussianHead(config.stochastic_channels, config.action_channels, self.slope, compute)
        self.prior, self.posterior = head(), head()

    @staticmethod
    def initial_state(config: ModelConfig, batch_size: int) -> LatentState:
        """The zero state, [batch_size, ...], before anything was seen."""
        return LatentState(jnp.zeros((batch_size, config.deterministic_channels), jnp.float32),
                           jnp.zeros((batch_size, config.stochastic_channels), jnp.float32))

    def observe_step(self, noise: StepNoise, action: jax.Array, state: LatentState, embedding: jax.Array,
                     is_first: jax.Array) -> tuple[LatentState, tuple[Gaussian, Gaussian]]:
        """One step with an observation; see WorldModel.observe_step."""
        fresh = jnp.expand_dims(is_first, -1)
        state = jax.tree.map(lambda leaf: jnp.where(fresh, jnp.zeros_like(leaf), leaf), state)
        action = jnp.where(fresh, jnp.zeros_like(action), action)
        imagined, prior = self.imagine_step(noise.prior, action, state)
        deterministic = imagined.deterministic
        posterior = self.posterior(jnp.concatenate([deterministic, embedding], axis=-1), action)
        from_prior = jnp.expand_dims(noise.use_prior & ~is_first, -1)
        stochastic = jnp.where(from_prior, imagined.stochastic, posterior.sample(noise.posterior))
        return LatentState(deterministic, stochastic), (prior, posterior)

    def imagine_step(self, noise: jax.Array, action: jax.Array, state: LatentState) -> tuple[LatentState, Gaussian]:
        """One step without an observation; see WorldModel.imagine_step."""
        recurrent_input = jax.nn.leaky_relu(self.pre_gru(state.stochastic), self.slope)
        deterministic = self.gru(state.deterministic, recurrent_input)
        prior = self.prior(deterministic, action)
        return LatentState(deterministic, prior.sample(noise)), prior


REGISTRY = {"1d": VectorTransition}
