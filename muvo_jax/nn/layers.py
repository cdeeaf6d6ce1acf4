"""Dense, convolution and transposed convolution as Flax modules over muvo_jax.ops, channels last.

Parameters stay float32 and are cast to the compute dtype where they are used. The modules declare shapes only: their
own initialiser gives zeros, and muvo_jax.nn.init fills the shapes by rules (tracing random initialisers is what makes
the usual `module.init` slow to compile).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.ops import conv as conv_ops
from muvo_jax.ops import conv_doubled, precision


@dataclasses.dataclass(frozen=True)
class Compute:
    """How the matrix work is done.

    Attributes:
      dtype: name of the dtype of activations and of the weights as they are used.
      convolution: form of the convolutions, see muvo_jax.ops.conv.
    """

    dtype: str = "float32"
    convolution: conv_ops.Implementation = "auto"

    @classmethod
    def of(cls, config: ModelConfig) -> Compute:
        """How a model of this configuration does it."""
        return cls(config.compute_dtype, config.convolution)


def shape_only(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The initialiser of every parameter: zeros, to be replaced by muvo_jax.nn.init.fill."""
    del key
    return jnp.zeros(shape, jnp.float32)


def per_channel(vector: jax.Array, rank: int) -> jax.Array:
    """[C] -> [1, ..., 1, C] with `rank` axes."""
    return vector.reshape((1,) * (rank - 1) + (-1,))


def varying_as(carry: Any, given: Any) -> Any:
    """The same carry of a scan, over those axes of a mesh, too, over which something given varies.

    Inside of jax.shard_map a carry must be as a step returns it; elsewhere this is the carry as it is.
    """
    never = functools.reduce(jnp.logical_or, [jnp.zeros_like(leaf, bool, shape=()) for leaf in jax.tree.leaves(given)])
    return jax.tree.map(lambda leaf: jnp.where(never, leaf, leaf), carry)


def spread(vector: jax.Array, rank: int) -> jax.Array:
    """[N, C] -> [N, 1, ..., 1, C] with `rank` axes."""
    return vector.reshape(vector.shape[:1] + (1,) * (rank - 2) + vector.shape[-1:])


class Dense(linen.Module):
    """x @ kernel + bias over the last axis: [..., I] -> [..., features], in the compute dtype."""

    features: int
    compute: Compute = Compute()
    use_bias: bool = True

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("kernel", shape_only, (x.shape[-1], self.features))
        y = jnp.dot(x.astype(self.compute.dtype), kernel.astype(self.compute.dtype), precision=precision.PRODUCTS)
        if self.use_bias:
            bias = self.param("bias", shape_only, (self.features,))
            y = y + per_channel(bias.astype(y.dtype), y.ndim)
        return y


class Conv(linen.Module):
    """Correlation with a kernel [*K, I, features]: [N, *S, I] -> [N, *S', features].

    Attributes:
      doubled: correlate x enlarged linearly to twice its size; kernels have 3 taps an axis, the stride is 1.
    """

    features: int
    kernel_size: tuple[int, ...]
    compute: Compute = Compute()
    stride: int = 1
    use_bias: bool = True
    doubled: bool = False

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("kernel", shape_only, (*self.kernel_size, x.shape[-1], self.features))
        x, kernel = x.astype(self.compute.dtype), kernel.astype(self.compute.dtype)
        if self.doubled:
            if self.stride != 1:
                raise ValueError(f"Conv: doubled with a stride of {self.stride}; expected 1.")
            y = conv_doubled.conv_doubled(x, kernel, implementation=self.compute.convolution)
        else:
            y = conv_ops.conv(x, kernel, stride=self.stride, padding=tuple(size // 2 for size in self.kernel_size),
                              implementation=self.compute.convolution)
        if self.use_bias:
            bias = self.param("bias", shape_only, (self.features,))
            y = y + per_channel(bias.astype(y.dtype), y.ndim)
        return y


class DepthwiseConv(linen.Module):
    """Correlation of each channel with a kernel of its own, [*K, 1, C]: [N, H, W, C] -> [N, H/stride, W/stride, C]."""

    size: int
    compute: Compute = Compute()
    stride: int = 1

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("kernel", shape_only, (self.size, self.size, 1, x.shape[-1]))
        return conv_ops.depthwise_conv(x.astype(self.compute.dtype), kernel.astype(self.compute.dtype),
                                       stride=self.stride, padding=self.size // 2,
                                       implementation=self.compute.convolution)


class ConvTranspose(linen.Module):
    """Transposed convolution, kernel [*K, I, features]: an axis of stride s and size n becomes s * n.

    padding and output padding follow from that: for an odd kernel at stride 2 padding (k - 1) / 2 and output padding 1,
    for an even one (k - 2) / 2 and 0; at stride 1 the size stays and the kernel must be odd.
    """

    features: int
    kernel_size: tuple[int, ...]
    stride: tuple[int, ...]
    compute: Compute = Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("transposed_kernel", shape_only, (*self.kernel_size, x.shape[-1], self.features))
        bias = self.param("bias", shape_only, (self.features,))
        excess = [size - step for size, step in zip(self.kernel_size, self.stride, strict=True)]
        y = conv_ops.conv_transpose(
            x.astype(self.compute.dtype), kernel.astype(self.compute.dtype), stride=self.stride,
            padding=tuple(math.ceil(extra / 2) for extra in excess),
            output_padding=tuple(extra % 2 for extra in excess), implementation=self.compute.convolution)
        return y + per_channel(bias.astype(y.dtype), y.ndim)


class Unfold(linen.Module):
    """A transposed convolution on a single pixel: [N, I] -> [N, *size, features], one dense map per output pixel."""

    features: int
    size: tuple[int, ...]
    compute: Compute = Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("seed_kernel", shape_only, (*self.size, x.shape[-1], self.features))
        bias = self.param("bias", shape_only, (self.features,))
        y = jnp.einsum("ni,...io->n...o", x.astype(self.compute.dtype), kernel.astype(self.compute.dtype),
                       precision=precision.PRODUCTS)
        return y + per_channel(bias.astype(y.dtype), y.ndim)


class Mlp(linen.Module):
    """Dense layers with ReLU between them, none after the last."""

    features: tuple[int, ...]
    compute: Compute = Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for index, features in enumerate(self.features):
            x = Dense(features, self.compute, name=f"linear{index}")(x if index == 0 else jax.nn.relu(x))
        return x
