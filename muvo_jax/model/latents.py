"""The recurrent state-space model (paper section III-C): how a latent state moves, and how an observation corrects it.

Both transitions are one filter, `Transition`; a subclass says how the state moves and how it looks at actions and
observations. As in the reference the action enters the prior and the posterior. With action_path="recurrence" what it
does, its `effect`, enters everything: a prior that reads one action among many tokens learns to ignore it. Differs from
the reference in the slope of the leaky ReLUs, 0.01 here and 1 there (numerics="reference"), and in drawing the RSSM
dropout's coin per sample instead of per batch.

1D: h and s are vectors [B, D] and [B, S], the recurrence is a GRU, prior and posterior are dense layers.

2D: h and s are rows of tokens [B, N, C] (muvo_jax.model.tokens). The recurrence is a GRU of 1x1 convolutions whose
gates also see a gated mean of all tokens. Prior and posterior are transformer decoders: learned queries, one for each
token of the state, look at the tokens of h', of the action and, for the posterior, of the observation. Differs from the
reference where the posterior looks at h' without the type embedding that marks it in the prior: an omission there, kept
by numerics="reference". With `aligned_tokens` a query starts from the token's own h' and, in the posterior, from what
the observation has in its place, which attention need not find first.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.config import ModelConfig, TokenLatent, VectorLatent, as_kind
from muvo_jax.model import memory, tokens
from muvo_jax.nn import attention, layers
from muvo_jax.ops import precision
from muvo_jax.types import Gaussian, LatentState, Motion, StepNoise

_LEAKY_SLOPE = {"standard": 0.01, "reference": 1.0}
# A fresh model's raw standard deviation: 2 sigmoid(-4 / 2) + 0.1 = 0.34. At 0, which gives 1.1, the noise of the first
# steps hides what the latent says, and it is long ignored. Trained weights bring their own.
_INITIAL_RAW_STD = -4.0
_STEP_UNITS = (1.0, 0.1, 0.05, 0.5, 5.0)  # forward m, left m, turn rad, gained m/s, m/s: about 1 in a town at 5 Hz


def _gaussian(moments: jax.Array) -> Gaussian:
    """[..., 2 S] -> Gaussian [..., S] in float32; std = 2 sigmoid(raw / 2) + 0.1 lies in (0.1, 2.1)."""
    mean, raw = jnp.split(moments.astype(jnp.float32), 2, axis=-1)
    return Gaussian(mean, 2.0 * jax.nn.sigmoid(raw / 2.0) + 0.1)


def _initial_moments(channels: int) -> np.ndarray:
    """First bias [2 channels] of the layer whose output `_gaussian` reads: zero means and the first deviation."""
    return np.repeat(np.array([0.0, _INITIAL_RAW_STD], np.float32), channels)


def _where(condition: jax.Array, chosen: jax.Array, other: jax.Array) -> jax.Array:
    """jnp.where for a condition that has the leading axes of the values only."""
    spread = condition.reshape(condition.shape + (1,) * (other.ndim - condition.ndim))
    return jnp.where(spread, chosen, other)


class Transition(linen.Module, abc.ABC):
    """One step of filtering or of imagination over states [B, ...], deterministic given its noise.

    A subclass sets up `gru`, says how large a state is and which layer of its heads gives the moments, and has

        predict(h', action, effect, keys)            -> prior
        infer(h', embedding, action, effect, keys)   -> posterior
    """

    config: ModelConfig
    moments_layer: ClassVar[str]

    def setup(self):
        config, compute = self.config, layers.Compute.of(self.config)
        channels = self.state_shapes(config)[0][-1]
        self.slope = _LEAKY_SLOPE[config.numerics]
        self.pre_gru = layers.Dense(channels, compute)
        if config.action_path == "recurrence":
            self.action_spread = self.variable("batch_stats", "action_spread", jnp.ones, (2,), jnp.float32)
            self.driven = layers.Dense(channels, compute)

    @staticmethod
    @abc.abstractmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of the deterministic and of the stochastic state of one sample."""

    @abc.abstractmethod
    def predict(self, deterministic: jax.Array, action: jax.Array, effect: jax.Array | None,
                keys: jax.Array | None) -> Gaussian:
        """The prior; keys [B] switch dropout on."""

    @abc.abstractmethod
    def infer(self, deterministic: jax.Array, embedding: jax.Array, action: jax.Array, effect: jax.Array | None,
              keys: jax.Array | None) -> Gaussian:
        """The posterior; keys [B] switch dropout on."""

    def recur(self, state: LatentState, effect: jax.Array | None) -> jax.Array:
        """The next deterministic state, GRU(f(s), h); effect [B, E] of the action, None with action_path="prior"."""
        x = self.pre_gru(state.stochastic)
        if effect is not None:
            x = x + jnp.expand_dims(self.driven(effect), tuple(range(1, x.ndim - 1)))  # the same for every token
        return self.gru(state.deterministic, jax.nn.leaky_relu(x, self.slope))

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
        state = jax.tree.map(lambda leaf: _where(is_first, jnp.zeros_like(leaf), leaf), state)
        action = _where(is_first, jnp.zeros_like(action), action)
        effect, _ = self.effect(action, state)
        deterministic = self.recur(state, effect)
        prior = self.predict(deterministic, action, effect, noise.dropout)
        posterior = self.infer(deterministic, embedding, action, effect, noise.dropout)
        stochastic = _where(noise.use_prior & ~is_first, prior.sample(noise.prior), posterior.sample(noise.posterior))
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
        return _gaussian(out)


class VectorTransition(Transition):
    """1D: prior(h', action), posterior(h', embedding, action); no dropout inside."""

    moments_layer = "out"

    def setup(self):
        super().setup()
        compute, latent = layers.Compute.of(self.config), as_kind(self.config.latent, VectorLatent)
        self.gru = GRUCell(latent.deterministic_channels, compute)
        head = lambda: GaussianHead(latent.stochastic_channels, latent.action_channels, self.slope, compute)
        self.prior, self.posterior = head(), head()

    @staticmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        latent = as_kind(config.latent, VectorLatent)
        return (latent.deterministic_channels,), (latent.stochastic_channels,)

    def predict(self, deterministic: jax.Array, action: jax.Array, effect: jax.Array | None,
                keys: jax.Array | None) -> Gaussian:
        del effect, keys  # the recurrence has it already
        return self.prior(deterministic, action)

    def infer(self, deterministic: jax.Array, embedding: jax.Array, action: jax.Array, effect: jax.Array | None,
              keys: jax.Array | None) -> Gaussian:
        del effect, keys
        return self.posterior(jnp.concatenate([deterministic, embedding], axis=-1), action)


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
        config, compute = self.config, layers.Compute.of(self.config)
        fusion, latent = tokens.fusion(config), as_kind(config.latent, TokenLatent)
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
        return _gaussian(layers.Dense(2 * channels, compute, name="moments")(x))


class TokenTransition(Transition):
    """2D: prior over [h', action], posterior over [h', observation, action], all of them tokens."""

    moments_layer = "moments"

    def setup(self):
        super().setup()
        config, compute = self.config, layers.Compute.of(self.config)
        channels = tokens.fusion(config).token_channels
        self.type_embedding = self.param("type_embedding", layers.shape_only, (3, channels))
        self.gru = TokenGRU(channels, compute)
        self.prior_action, self.posterior_action = (layers.Dense(channels, compute) for _ in range(2))
        self.prior, self.posterior = TokenGaussianHead(config), TokenGaussianHead(config)
        latent = as_kind(config.latent, TokenLatent)
        self.aligned, self.layers = latent.aligned_tokens, latent.transition_layers
        if self.aligned:
            self.prior_own, self.posterior_own, self.posterior_seen = (
                layers.Dense(channels, compute) for _ in range(3))
        if config.action_path == "recurrence":
            self.prior_driven, self.posterior_driven = (layers.Dense(channels, compute) for _ in range(2))

    @staticmethod
    def state_shapes(config: ModelConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
        shape = (tokens.count(config), tokens.fusion(config).token_channels)
        return shape, shape

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


TRANSITIONS: dict[type, type[Transition]] = {VectorLatent: VectorTransition, TokenLatent: TokenTransition}


def initial_constants(config: ModelConfig) -> dict[str, np.ndarray]:
    """Path of a parameter -> its first value: the biases that fresh means and deviations come from."""
    kind = TRANSITIONS[type(config.latent)]
    bias = _initial_moments(kind.state_shapes(config)[1][-1])
    return {f"transition/{head}/{kind.moments_layer}/bias": bias for head in ("prior", "posterior")}
