"""The recurrent state-space model over tokens (paper section III-C, the 2D latent).

h and s are rows of tokens [B, N, C] (muvo_jax.model.tokens). The recurrence is a GRU of 1x1 convolutions whose gates
also see a gated mean of all tokens. Prior and posterior are transformer decoders: learned queries, one for each token
of the state, look at the tokens of h', of the action and, for the posterior, of the observation.

Differs from the reference where the posterior looks at h' without the type embedding that marks it in the prior: an
omission there, kept by numerics="reference". With `aligned_tokens` a query starts from the token's own h' and, in
the posterior, from what the observation has in its place, which attention need not find first.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.config import ModelConfig, TokenLatent, as_kind
from muvo_jax.model import common, filtering, tokens
from muvo_jax.nn import attention, layers
from muvo_jax.types import Gaussian, LatentState


class TokenGRU(linen.Module):
    """(h [B, N, C], x [B, N, C]) -> h': a gated recurrent unit per token, its gates moved by what all tokens share.

    With g the mean over tokens of sigmoid(W [h, x]) * [h, x]:
    z, r = sigmoid(conv [h, x] + dense g), q = tanh(conv [r * h, x] + dense g), h' = (1 - z) h + z q.
    """

    channels: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, state: jax.Array, x: jax.Array) -> jax.Array:
        dense = lambda name, value, channels=self.channels: layers.Dense(
            channels, self.compute, name=name)(value).astype(jnp.float32)
        joined = jnp.concatenate([state, x.astype(jnp.float32)], axis=-1)
        gate = jax.nn.sigmoid(dense("gate", joined, joined.shape[-1]))
        shared = jnp.mean(gate * joined, axis=-2, keepdims=True)
        update = jax.nn.sigmoid(dense("update", joined) + dense("update_shared", shared))
        reset = jax.nn.sigmoid(dense("reset", joined) + dense("reset_shared", shared))
        moved = jnp.concatenate([reset * state, joined[..., self.channels:]], axis=-1)
        new = jnp.tanh(dense("new", moved) + dense("new_shared", shared))
        return (1.0 - update) * state + update * new


class TokenGaussianHead(linen.Module):
    """Memory [B, M, C] -> Gaussian [B, N, C]: one learned query per token of the state, decoded over the memory.

    With `start` [B, N, C] the query is what is learned of a token beside that.
    """

    config: ModelConfig

    @linen.compact
    def __call__(self, memory: jax.Array, keys: jax.Array | None, first_site: int,
                 start: jax.Array | None = None) -> Gaussian:
        config, compute = self.config, common.compute(self.config)
        fusion, latent = common.token_fusion(config), as_kind(config.latent, TokenLatent)
        channels, groups = fusion.token_channels, tokens.groups(config)
        type_embedding = self.param("type_embedding", layers.shape_only, (len(groups), channels))
        queries = []
        for index, (name, grid) in enumerate(groups.items()):
            query = self.param(f"query_{name}", layers.shape_only, (math.prod(grid), channels))
            if grid:
                query = query + jnp.asarray(attention.sine_positions(grid, channels))
            queries.append(query + type_embedding[index][None])
        x = jnp.concatenate(queries).astype(compute.dtype)
        x = jnp.broadcast_to(x[None], (memory.shape[0], *x.shape))
        if start is not None:
            x = x + start.astype(x.dtype)
        x = attention.TransformerDecoder(
            latent.transition_layers, fusion.heads, fusion.hidden_channels, fusion.dropout, compute,
            name="transformer")(x, memory.astype(compute.dtype), keys, first_site)
        return filtering.gaussian(layers.Dense(2 * channels, compute, name="moments")(x))


class TokenTransition(filtering.Transition):
    """2D: h' = GRU(f(s), h); prior over [h', action], posterior over [h', observation, action], all of them tokens."""

    def setup(self):
        config, compute = self.config, common.compute(self.config)
        channels = common.token_fusion(config).token_channels
        self.slope = filtering.LEAKY_SLOPE[config.numerics]
        self.type_embedding = self.param("type_embedding", layers.shape_only, (3, channels))
        self.pre_gru = layers.Dense(channels, compute)
        self.gru = TokenGRU(channels, compute)
        self.prior_action, self.posterior_action = (layers.Dense(channels, compute) for _ in range(2))
        self.prior, self.posterior = TokenGaussianHead(config), TokenGaussianHead(config)
        latent = as_kind(config.latent, TokenLatent)
        self.aligned, self.layers = latent.aligned_tokens, latent.transition_layers
        if self.aligned:
            self.prior_own, self.posterior_own, self.posterior_seen = (
                layers.Dense(channels, compute) for _ in range(3))
        if config.action_path == "recurrence":
            self.action_spread = self.variable("batch_stats", "action_spread", jnp.ones, (2,))
            self.driven, self.prior_driven, self.posterior_driven = (
                layers.Dense(channels, compute) for _ in range(3))

    @staticmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        shape = (tokens.count(config), common.token_fusion(config).token_channels)
        return shape, shape

    @staticmethod
    def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
        bias = filtering.initial_moments(common.token_fusion(config).token_channels)
        return {f"{head}/moments/bias": bias for head in ("prior", "posterior")}

    def recur(self, state: LatentState, effect: jax.Array | None) -> jax.Array:
        x = self.pre_gru(state.stochastic)
        if effect is not None:
            x = x + jnp.expand_dims(self.driven(effect), -2)
        return self.gru(state.deterministic, jax.nn.leaky_relu(x, self.slope))

    def predict(self, deterministic: jax.Array, action: jax.Array, effect: jax.Array | None,
                keys: jax.Array | None) -> Gaussian:
        memory = jnp.concatenate([self._typed(deterministic, 1), self._action(self.prior_action, action)], axis=-2)
        start = self.prior_own(deterministic) if self.aligned else None
        if effect is not None:
            start = _added(start, self.prior_driven(effect), deterministic.shape)
        return self.prior(memory, keys, 0, start)

    def infer(self, deterministic: jax.Array, embedding: jax.Array, action: jax.Array, effect: jax.Array | None,
              keys: jax.Array | None) -> Gaussian:
        remembered = deterministic if self.config.numerics == "reference" else self._typed(deterministic, 1)
        memory = jnp.concatenate([remembered, self._typed(embedding, 0), self._action(self.posterior_action, action)],
                                 axis=-2)
        start = None
        if self.aligned:
            seen = tokens.of_observation(self.posterior_seen(embedding), self.config)
            start = self.posterior_own(deterministic) + seen
        if effect is not None:
            start = _added(start, self.posterior_driven(effect), deterministic.shape)
        sites = attention.SITES_PER_DECODER_LAYER * self.layers
        return self.posterior(memory, keys, sites, start)

    def _typed(self, values: jax.Array, kind: int) -> jax.Array:
        """Marks tokens [B, n, C] as those of the observation (0), of the state (1) or of the action (2)."""
        return values + layers.per_channel(self.type_embedding[kind], values.ndim)

    def _action(self, embed: layers.Dense, action: jax.Array) -> jax.Array:
        embedded = jax.nn.leaky_relu(embed(action), self.slope).astype(jnp.float32)
        return self._typed(jnp.expand_dims(embedded, -2), 2)


def _added(start: jax.Array | None, value: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Tokens [B, N, C] of this shape with one value [B, C] added to each; a missing start counts as zeros."""
    value = jnp.expand_dims(value, -2)
    return jnp.broadcast_to(value, shape) if start is None else start + value
