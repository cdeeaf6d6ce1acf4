"""Sine positions and post-norm transformers: the encoder that fuses the sensors' tokens (paper section III-B), and the
decoder in which learned queries read the 2D latent's next state (section III-C).

Dropout masks are drawn from one key per sample (row of the batch), so that they do not depend on how a batch is split
over devices.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax.nn import layers, norm
from muvo_jax.ops import precision

_TEMPERATURE = 10_000.0
_LARGE = 2**16  # weights of a head


def sine_positions(size: tuple[int, ...], channels: int) -> np.ndarray:
    """float32 [prod(size), channels]: an equal share of the channels encodes each axis, sine and cosine interleaved.

    Coordinate i of n is 2 pi (i + 1) / (n + 1e-6), as in DETR; cells are in row-major order.

    Raises:
      ValueError: if the channels cannot be shared evenly in pairs.
    """
    share, rest = divmod(channels, len(size))
    if rest or share % 2:
        raise ValueError(f"sine_positions: got {channels} channels, expected a multiple of {2 * len(size)} for "
                         f"{len(size)} axes.")
    frequencies = _TEMPERATURE ** (-2.0 * (np.arange(share) // 2) / share)
    encoded = []
    for axis, count in enumerate(size):
        angle = 2 * math.pi * np.arange(1, count + 1) / (count + 1e-6)
        phase = angle[:, None] * frequencies[None]
        values = np.where(np.arange(share)[None] % 2 == 0, np.sin(phase), np.cos(phase))
        shape = [1] * len(size) + [share]
        shape[axis] = count
        encoded.append(np.broadcast_to(values.reshape(shape), (*size, share)))
    return np.concatenate(encoded, axis=-1).reshape(-1, channels).astype(np.float32)


def dropout(x: jax.Array, keys: jax.Array | None, site: int | jax.Array, rate: float) -> jax.Array:
    """Zeroes entries of x [N, ...] with probability `rate` and scales the rest by 1 / (1 - rate).

    Args:
      x: any float array.
      keys: one typed key per row of x; None switches dropout off.
      site: which dropout of the network this is; different sites draw different masks from the same keys.
      rate: probability of zeroing.
    """
    if keys is None or rate == 0.0:
        return x
    return _kept(x, _keep(x.shape, keys, site, rate), rate)


def _keep(shape: tuple[int, ...], keys: jax.Array, site: int | jax.Array, rate: float) -> jax.Array:
    """Which entries of an array [N, ...] dropout keeps, bool.

    By 16 random bits each: to draw them took half the time of attention's gradients.
    """
    def of_sample(key: jax.Array) -> jax.Array:
        words = jax.random.bits(jax.random.fold_in(key, site), (-(-math.prod(shape[1:]) // 2),), jnp.uint32)
        halves = jax.lax.bitcast_convert_type(words, jnp.uint16).reshape(-1)[:math.prod(shape[1:])]
        return (halves.astype(jnp.uint32) < round((1.0 - rate) * 2**16)).reshape(shape[1:])

    return jax.vmap(of_sample)(keys)


def _kept(x: jax.Array, keep: jax.Array | None, rate: float) -> jax.Array:
    return x if keep is None else jnp.where(keep, x / (1.0 - rate), jnp.zeros_like(x))


class InProjection(linen.Module):
    """Tokens x [N, L, C] and a memory [N, M, C] -> query [N, L, C], key and value [N, M, C]."""

    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, memory: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        channels, dtype = x.shape[-1], self.compute.dtype
        kernel = self.param("kernel", layers.shape_only, (channels, 3 * channels)).astype(dtype)
        bias = self.param("bias", layers.shape_only, (3 * channels,)).astype(dtype)
        affine = lambda values, part: jnp.dot(values.astype(dtype), kernel[:, part],
                                              precision=precision.PRODUCTS) + bias[part][None, None]
        if memory is x:
            query, key, value = jnp.split(affine(x, slice(None)), 3, axis=-1)
            return query, key, value
        key, value = jnp.split(affine(memory, slice(channels, None)), 2, axis=-1)
        return affine(x, slice(channels)), key, value


class Attention(linen.Module):
    """Multi-head attention of tokens x [N, L, C] on a memory [N, M, C]; the softmax is computed in float32.

    With `memory is x` it is self-attention.
    """

    heads: int
    dropout_rate: float
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, memory: jax.Array, keys: jax.Array | None, site: int | jax.Array) -> jax.Array:
        count, length, channels = x.shape
        head_channels = channels // self.heads
        query, key, value = (jnp.swapaxes(part.reshape(count, -1, self.heads, head_channels), 1, 2)
                             for part in InProjection(self.compute, name="in_proj")(x, memory))
        keep = None
        if keys is not None and self.dropout_rate:
            keep = _keep((*query.shape[:-1], key.shape[-2]), keys, site, self.dropout_rate)
        mixed = _attend(self.dropout_rate, query, key, value, keep)
        mixed = jnp.swapaxes(mixed, 1, 2).reshape(count, length, channels)
        return layers.Dense(channels, self.compute, name="out_proj")(mixed)


def _attend(rate: float, query: jax.Array, key: jax.Array, value: jax.Array, keep: jax.Array | None) -> jax.Array:
    """What heads see: float32 [N, H, L, c] of query [N, H, L, c], key and value [N, H, M, c], and what dropout keeps of
    the weights, bool [N, H, L, M] or None.

    On a CPU most of the time went into passing over the weights. So they are never divided, what they mix is; and where
    they are large, one head is worked out after the other, whose weights stay in the cache.
    """
    at_once, one_by_one = (functools.partial(form, rate) for form in (_mixed, _one_by_one))
    if query.shape[-2] * key.shape[-2] < _LARGE:
        return at_once(query, key, value, keep)
    return jax.lax.platform_dependent(query, key, value, keep, cpu=one_by_one, default=at_once)


def _one_by_one(rate: float, *heads: jax.Array | None) -> jax.Array:
    by_head = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), heads)
    return jnp.swapaxes(jax.lax.map(lambda head: _mixed(rate, *head), by_head), 0, 1)


def _mixed(rate: float, query: jax.Array, key: jax.Array, value: jax.Array, keep: jax.Array | None) -> jax.Array:
    scores = jnp.einsum("...qc,...kc->...qk", query, key, precision=precision.PRODUCTS,
                        preferred_element_type=jnp.float32) / math.sqrt(query.shape[-1])
    weights = jnp.exp(scores - jax.lax.stop_gradient(scores.max(axis=-1, keepdims=True)))
    mixed = jnp.einsum("...qk,...kc->...qc", _kept(weights, keep, rate).astype(value.dtype), value,
                       precision=precision.PRODUCTS, preferred_element_type=jnp.float32)
    return mixed / weights.sum(axis=-1, keepdims=True)


class _Layer(linen.Module):
    """What a layer of either transformer is told."""

    heads: int
    hidden_channels: int
    dropout_rate: float
    compute: layers.Compute = layers.Compute()


class _Stack(linen.Module):
    """What either transformer is told: the number of its layers and what they are told."""

    layers_count: int
    heads: int
    hidden_channels: int
    dropout_rate: float
    compute: layers.Compute = layers.Compute()


class EncoderLayer(_Layer):
    """Post-norm layer: x = norm(x + attention(x)), x = norm(x + feed-forward(x)), ReLU inside."""

    @linen.compact
    def __call__(self, x: jax.Array, keys: jax.Array | None, first_site: int) -> jax.Array:
        drop = lambda value, offset: dropout(value, keys, first_site + offset, self.dropout_rate)
        attended = Attention(self.heads, self.dropout_rate, self.compute, name="self_attn")(x, x, keys, first_site)
        x = norm.LayerNorm(name="norm1")(x + drop(attended, 1))
        hidden = jax.nn.relu(layers.Dense(self.hidden_channels, self.compute, name="linear1")(x))
        out = layers.Dense(x.shape[-1], self.compute, name="linear2")(drop(hidden, 2))
        return norm.LayerNorm(name="norm2")(x + drop(out, 3))


SITES_PER_LAYER = 4


class TransformerEncoder(_Stack):
    """A stack of encoder layers over tokens [N, L, C], no mask and no final norm.

    A plain loop: stacked parameters (scan) would turn biases into matrices, which weight decay tells apart.
    """

    @linen.compact
    def __call__(self, x: jax.Array, keys: jax.Array | None = None) -> jax.Array:
        for index in range(self.layers_count):
            x = EncoderLayer(self.heads, self.hidden_channels, self.dropout_rate, self.compute,
                             name=f"layer{index}")(x, keys, SITES_PER_LAYER * index)
        return x


class DecoderLayer(_Layer):
    """Post-norm layer over x and a memory: self-attention, attention on the memory, feed-forward with ReLU inside."""

    @linen.compact
    def __call__(self, x: jax.Array, memory: jax.Array, keys: jax.Array | None,
                 first_site: int | jax.Array) -> jax.Array:
        drop = lambda value, offset: dropout(value, keys, first_site + offset, self.dropout_rate)
        attend = lambda name: Attention(self.heads, self.dropout_rate, self.compute, name=name)
        x = norm.LayerNorm(name="norm1")(x + drop(attend("self_attn")(x, x, keys, first_site), 1))
        x = norm.LayerNorm(name="norm2")(x + drop(attend("cross_attn")(x, memory, keys, first_site + 2), 3))
        hidden = jax.nn.relu(layers.Dense(self.hidden_channels, self.compute, name="linear1")(x))
        out = layers.Dense(x.shape[-1], self.compute, name="linear2")(drop(hidden, 4))
        return norm.LayerNorm(name="norm3")(x + drop(out, 5))


SITES_PER_DECODER_LAYER = 6


class TransformerDecoder(_Stack):
    """A stack of decoder layers over tokens x [N, L, C] and a memory [N, M, C], no mask and no final norm.

    The backward pass computes each layer anew: the weights of a layer at the paper's size, [N, 8, 1093, 1612], with
    their dropout, would otherwise be kept for every layer and time step. The loop is a scan, because the CPU compiler
    moves what a plain loop computes anew to the front, all layers at once. Its stack of parameters is made on the way:
    a tree of stacked ones would turn biases into matrices, which weight decay tells apart.
    """

    @linen.compact
    def __call__(self, x: jax.Array, memory: jax.Array, keys: jax.Array | None = None,
                 first_site: int = 0) -> jax.Array:
        layer = functools.partial(DecoderLayer, self.heads, self.hidden_channels, self.dropout_rate, self.compute)
        names = [f"layer{index}" for index in range(self.layers_count)]
        if self.is_initializing():
            for name in names:
                x = layer(name=name)(x, memory, keys, first_site)
            return x

        @jax.checkpoint
        def step(x, inputs):
            params, site = inputs
            return layer(parent=None).apply({"params": params}, x, memory, keys, site), None

        params = self.variables["params"]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(params[name] for name in names))
        sites = first_site + SITES_PER_DECODER_LAYER * jnp.arange(self.layers_count)
        return jax.lax.scan(step, layers.varying_as(x, (memory, keys)), (stacked, sites))[0]
