"""The recurrent state-space model with a vector state (paper section III-C, the 1D latent), and the registry of both.

Every transition offers what muvo_jax.model.filtering describes, over muvo_jax.types.LatentState and Gaussian.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.config import ModelConfig, TokenLatent, VectorLatent, as_kind
from muvo_jax.model import common, filtering, token_transition
from muvo_jax.nn import layers
from muvo_jax.ops import precision
from muvo_jax.types import Gaussian, LatentState


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
            value.astype(dtype), kernel.astype(dtype),
            precision=precision.PRODUCTS).astype(jnp.float32) + layers.per_channel(bias, value.ndim)
        input_reset, input_update, input_new = jnp.split(affine(x, input_kernel, input_bias), 3, axis=-1)
        hidden_reset, hidden_update, hidden_new = jnp.split(affine(state, hidden_kernel, hidden_bias), 3, axis=-1)
        reset = jax.nn.sigmoid(input_reset + hidden_reset)
        update = jax.nn.sigmoid(input_update + hidden_update)
        new = jnp.tanh(input_new + reset * hidden_new)
        return (1.0 - update) * new + update * state


class GaussianHead(linen.Module):
    """[..., C] and an action [..., 2] -> Gaussian [..., channels]: action embedding, two dense layers."""

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
        return filtering.gaussian(out)


class VectorTransition(filtering.Transition):
    """1D: h' = GRU(f(s), h); prior(h', action), posterior(h', embedding, action); no dropout inside."""

    def setup(self):
        config, compute = self.config, common.compute(self.config)
        latent = as_kind(config.latent, VectorLatent)
        self.slope = filtering.LEAKY_SLOPE[config.numerics]
        self.pre_gru = layers.Dense(latent.deterministic_channels, compute)
        self.gru = GRUCell(latent.deterministic_channels, compute)
        head = lambda: GaussianHead(latent.stochastic_channels, latent.action_channels, self.slope, compute)
        self.prior, self.posterior = head(), head()
        if config.action_path == "recurrence":
            self.action_spread = self.variable("batch_stats", "action_spread", jnp.ones, (2,))
            self.driven = layers.Dense(latent.deterministic_channels, compute)

    @staticmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        latent = as_kind(config.latent, VectorLatent)
        return (latent.deterministic_channels,), (latent.stochastic_channels,)

    @staticmethod
    def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
        bias = filtering.initial_moments(as_kind(config.latent, VectorLatent).stochastic_channels)
        return {f"{head}/out/bias": bias for head in ("prior", "posterior")}

    def recur(self, state: LatentState, effect: jax.Array | None) -> jax.Array:
        x = self.pre_gru(state.stochastic)
        if effect is not None:
            x = x + self.driven(effect)
        return self.gru(state.deterministic, jax.nn.leaky_relu(x, self.slope))

    def predict(self, deterministic: jax.Array, action: jax.Array, effect: jax.Array | None,
                keys: jax.Array | None) -> Gaussian:
        del effect, keys  # the recurrence has it already
        return self.prior(deterministic, action)

    def infer(self, deterministic: jax.Array, embedding: jax.Array, action: jax.Array, effect: jax.Array | None,
              keys: jax.Array | None) -> Gaussian:
        del effect, keys
        return self.posterior(jnp.concatenate([deterministic, embedding], axis=-1), action)


REGISTRY: dict[type, type[filtering.Transition]] = {
    VectorLatent: VectorTransition, TokenLatent: token_transition.TokenTransition}


def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
    """Path of a parameter -> its first value, for the latent that this model has."""
    constants = REGISTRY[type(config.latent)].initial_constants(config)
    return {f"transition/{name}": value for name, value in constants.items()}
