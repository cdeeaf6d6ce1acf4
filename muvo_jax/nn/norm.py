"""Normalisation layers with float32 statistics: batch (synchronised over devices), layer, and adaptive instance norm.

Differs from flax.linen.BatchNorm where torch does: momentum 0.1, eps 1e-5, the running variance is the unbiased one,
and the variance is computed in two passes (no cancellation). Over an axis name, counts and sums are added up over the
devices before any division, so that the statistics are those of the whole batch.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.nn import layers


@dataclasses.dataclass(frozen=True)
class Mode:
    """Where BatchNorm takes its moments from.

    Attributes:
      train: use the moments of this batch and update the running ones.
      axis_name: mapped axis over which the batch is split, if any.
    """

    train: bool = False
    axis_name: str | None = None


class BatchNorm(linen.Module):
    """[..., C] -> [..., C], normalised over all leading axes; running moments in the collection "batch_stats"."""

    momentum: float = 0.1
    epsilon: float = 1e-5

    @linen.compact
    def __call__(self, x: jax.Array, mode: Mode, mask: jax.Array | None = None) -> jax.Array:
        """mask: bool [...], which rows the moments are taken over; None means all.

        Without rows on any device the running moments stay, with a single one the running variance does.
        """
        channels = x.shape[-1]
        scale = self.param("scale", layers.shape_only, (channels,))
        bias = self.param("bias", layers.shape_only, (channels,))
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (channels,), jnp.float32)
        running_var = self.variable("batch_stats", "var", jnp.ones, (channels,), jnp.float32)
        x32 = x.astype(jnp.float32)
        mean, var = running_mean.value, running_var.value
        if mode.train:
            mean, var, unbiased_var, count = batch_moments(x32, mode.axis_name, mask)
            if not self.is_initializing():
                for running, value, needed in ((running_mean, mean, 1.0), (running_var, unbiased_var, 2.0)):
                    change = self.momentum * (jax.lax.stop_gradient(value) - running.value)
                    running.value += jnp.where(count >= needed, change, 0.0)
        factor = scale * jax.lax.rsqrt(var + self.epsilon)
        rank = x.ndim
        y = (x32 - layers.per_channel(mean, rank)) * layers.per_channel(factor, rank) + layers.per_channel(bias, rank)
        return y.astype(x.dtype)


def batch_moments(x: jax.Array, axis_name: str | None,
                  mask: jax.Array | None = None) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Mean, biased and unbiased variance, each [C], of x [..., C] over all leading axes and over the mapped axis.

    With a mask [...], of the rows where it is true. Beside them the float32 number of rows; without any the moments
    are 0, as is the variance of one.
    """
    total = lambda value: value if axis_name is None else jax.lax.psum(value, axis_name)
    axes = tuple(range(x.ndim - 1))
    kept = None if mask is None else jnp.expand_dims(mask, -1)
    over_rows = lambda value: total(jnp.sum(value if kept is None else jnp.where(kept, value, 0.0), axes))
    count = total(jnp.float32(math.prod(x.shape[:-1])) if mask is None else jnp.sum(mask).astype(jnp.float32))
    divisor = count if mask is None else jnp.maximum(count, 1.0)
    mean = over_rows(x) / divisor
    # The derivative of the squares by the mean is sum(x - mean) = 0: leaving it out saves a reduction backwards.
    # What is taken off the squares is 0, and so is its slope; its curvature is what second derivatives need.
    centre = jax.lax.stop_gradient(mean)
    squares = over_rows(jnp.square(x - layers.per_channel(centre, x.ndim))) - count * jnp.square(mean - centre)
    return mean, squares / divisor, squares / jnp.maximum(count - 1.0, 1.0), count


def _centred(x: jax.Array, axes: tuple[int, ...], epsilon: float) -> tuple[jax.Array, jax.Array]:
    """x minus its mean over some axes, and 1 / sqrt(variance + epsilon) with those axes kept; float32."""
    x32 = x.astype(jnp.float32)
    centred = x32 - jnp.mean(x32, axis=axes, keepdims=True)
    return centred, jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=axes, keepdims=True) + epsilon)


class LayerNorm(linen.Module):
    """[..., C] normalised over the last axis, eps 1e-5."""

    epsilon: float = 1e-5

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        scale = self.param("scale", layers.shape_only, (x.shape[-1],))
        bias = self.param("bias", layers.shape_only, (x.shape[-1],))
        centred, inverse_std = _centred(x, (-1,), self.epsilon)
        y = centred * inverse_std * layers.per_channel(scale, x.ndim) + layers.per_channel(bias, x.ndim)
        return y.astype(x.dtype)


class SampleNorm(linen.Module):
    """[N, ..., C] normalised over everything but the first axis (torch: GroupNorm of one group), eps 1e-5."""

    epsilon: float = 1e-5

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        scale = self.param("scale", layers.shape_only, (x.shape[-1],))
        bias = self.param("bias", layers.shape_only, (x.shape[-1],))
        centred, inverse_std = _centred(x, tuple(range(1, x.ndim)), self.epsilon)
        y = centred * inverse_std * layers.per_channel(scale, x.ndim) + layers.per_channel(bias, x.ndim)
        return y.astype(x.dtype)


class AdaptiveInstanceNorm(linen.Module):
    """Normalises x [N, *S, C] per sample and channel over space; scale and shift are affine maps of a style [N, F].

    The scale is the map's output itself, not 1 plus it, as in the reference (StyleGAN).
    """

    compute: layers.Compute = layers.Compute()
    epsilon: float = 1e-8

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        affine = layers.Dense(2 * x.shape[-1], self.compute, name="style")(style).astype(jnp.float32)
        scale, shift = jnp.split(affine, 2, axis=-1)
        centred, inverse_std = _centred(x, tuple(range(1, x.ndim - 1)), self.epsilon)
        y = centred * (inverse_std * layers.spread(scale, x.ndim)) + layers.spread(shift, x.ndim)
        return y.astype(x.dtype)
