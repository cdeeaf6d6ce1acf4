"""Decoders that see the memory: a U-net whose deepest map is the latent's (config.LastSeen).

On the way down it reads the memory as it looks from the state's vantage, on the way up it draws what must be added to
that, where it covers anything, and to the average training frame elsewhere. So a fresh model predicts the moved memory
and learns the rest: to fill what was hidden, to move what moves, to blur what is uncertain.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import head as head_lib
from muvo_jax.config import ModelConfig
from muvo_jax.model import decoders, memory
from muvo_jax.model import glimpse as glimpse_lib
from muvo_jax.nn import layers
from muvo_jax.ops import conv_cpu

_WIDTHS = {8: 1, 4: 1, 2: 2}  # what the width is divided by at each scale


def _activation(x: jax.Array) -> jax.Array:
    return jax.nn.leaky_relu(x, 0.1)


class GuidedDecoder(linen.Module):
    """Features and what is seen [N, *plane, C] -> {scale: [N, *plane / scale, outputs]}, raw.

    Attributes:
      config: of the model.
      guide: how it uses the memory.
    """

    config: ModelConfig
    guide: head_lib.Guide

    @linen.compact
    def __call__(self, features: jax.Array, seen: jax.Array, numbers: jax.Array) -> dict[int, jax.Array]:
        config, compute, guide = self.config, layers.Compute.of(self.config), self.guide
        width = guide.width(config)
        dense = lambda name, x, features: layers.Dense(features, compute, name=name)(x)
        conv = lambda name, x, features: _activation(layers.Conv(features, (3, 3), compute, name=name)(x))
        # Doubling and halving by dense layers on 2x2 pixels: whole matrix products, on any backend.
        grow = lambda name, x, features: _activation(conv_cpu.depth_to_space(dense(name, x, 4 * features), (2, 2)))
        down = {1: seen.astype(compute.dtype)}
        for scale in (2, 4, 8):
            blocks = conv_cpu.space_to_depth(down[scale // 2], (2, 2))
            down[scale] = conv(f"see_{scale}", blocks, width // _WIDTHS[scale])
        x = self._latent(features, width)
        while x.shape[1] < guide.plane(config)[0] // 8:
            x = grow(f"pre_{x.shape[1]}", x, width)
        x = conv("join", x + down[8] + layers.spread(dense("numbers", numbers, width), 4), width)
        out = {}
        for scale in (4, 2):
            x = grow(f"grow_{scale}", x, width // _WIDTHS[scale])
            x = conv(f"draw_{scale}", jnp.concatenate([x, down[scale]], axis=-1), width // _WIDTHS[scale])
            out[scale] = dense(f"head_{scale}", x, guide.channels(config, scale)).astype(jnp.float32)
        # Full size is drawn in blocks of 2x2 pixels: a quarter of the places, with channels enough for a fast product.
        seen = conv_cpu.space_to_depth(down[1], (2, 2))
        x = conv("draw_1", jnp.concatenate([x, seen], axis=-1), width // _WIDTHS[2])
        blocks = dense("head_1", x, 4 * guide.channels(config, 1))
        if guide.blurs:
            blocks = blocks + layers.Conv(4 * guide.channels(config, 1), (3, 3), compute, name="blur")(seen)
        return {1: conv_cpu.depth_to_space(blocks.astype(jnp.float32), (2, 2)), **out}

    def _latent(self, features: jax.Array, width: int) -> jax.Array:
        """The latent as a map of the plane: the head's tokens, or a vector unfolded."""
        compute = layers.Compute.of(self.config)
        if features.ndim == 2:
            size = tuple(math.ceil(side / self.guide.shrink) for side in self.guide.plane(self.config))
            seed = layers.Dense(width, compute, name="linear")(features)
            return _activation(layers.Unfold(width, size, compute, name="seed")(seed))
        if features.ndim == 5:  # heights become channels
            features = features.reshape(*features.shape[:3], -1)
        return _activation(layers.Conv(width, (3, 3), compute, name="first")(features))


class GuidedHead(linen.Module):
    """One head of a model with memory: (features, Glimpse, numbers, average frame) -> {scale: raw prediction}."""

    config: ModelConfig
    guide: head_lib.Guide

    @linen.compact
    def __call__(self, features: jax.Array, glimpse: glimpse_lib.Glimpse, numbers: jax.Array,
                 mean: decoders.FirstGuess) -> dict[int, jax.Array]:
        seen = self.guide.see(glimpse, self.config)
        raw = GuidedDecoder(self.config, self.guide, name="decoder")(features, seen, numbers)
        return self.guide.compose(raw, glimpse, mean, self.config)


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value: the last layers of a fresh model add nothing to what the memory shows."""
    values: dict[str, float] = {}
    for name in memory.guessed_heads(config):
        decoder, head = f"decoders_{name}/decoder", head_lib.get(name)
        values |= {f"{decoder}/head_{scale}/{leaf}": 0.0 for scale in head.scales for leaf in ("kernel", "bias")}
        if head.guide is not None and head.guide.blurs:
            values[f"{decoder}/blur/kernel"] = 0.0
    return values
