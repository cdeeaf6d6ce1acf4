"""Modules that the reference's 2D code holds but none of its models uses; packs of reference numbers cover them.

Their parameters are named so that muvo_jax.interop.names translates them as those of the 1D voxel decoder.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.nn import layers
from muvo_jax.ops import resample


class PlainTokenGRU(linen.Module):
    """(h [N, C], x [N, C]) -> h' = (1 - z) h + z q: the token GRU without what the tokens share."""

    channels: int

    @linen.compact
    def __call__(self, state: jax.Array, x: jax.Array) -> jax.Array:
        dense = lambda name, value: layers.Dense(self.channels, name=name)(value)
        joined = jnp.concatenate([state, x], axis=-1)
        update, reset = jax.nn.sigmoid(dense("fc_z", joined)), jax.nn.sigmoid(dense("fc_r", joined))
        new = jnp.tanh(dense("fc_q", jnp.concatenate([reset * state, x], axis=-1)))
        return (1.0 - update) * state + update * new


class SpatialInstanceNorm(linen.Module):
    """Normalises x [N, *S, C] over space; scale and shift come from a map of styles [N, *grid, F], *grid dividing *S.

    The map is repeated to the size of x and convolved, and its own mean over space is added to it.
    """

    epsilon: float = 1e-8

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        space = tuple(range(1, x.ndim - 1))
        for axis in space:
            style = jnp.repeat(style, x.shape[axis] // style.shape[axis], axis=axis)
        affine = layers.Conv(2 * x.shape[-1], (3,) * len(space), name="style")(style)
        scale, shift = jnp.split(affine + affine.mean(axis=space, keepdims=True), 2, axis=-1)
        centred = x - x.mean(axis=space, keepdims=True)
        variance = jnp.mean(jnp.square(centred), axis=space, keepdims=True)
        return centred * jax.lax.rsqrt(variance + self.epsilon) * scale + shift


class SpatiallyStyledConv(linen.Module):
    """Convolution of width 3, leaky ReLU 0.2, spatial instance norm."""

    features: int

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        x = layers.Conv(self.features, (3,) * (x.ndim - 2), name="conv")(x)
        return SpatialInstanceNorm(name="norm")(jax.nn.leaky_relu(x, 0.2), style)


class SpatiallyStyledBlock(linen.Module):
    """Linear enlargement by `factor`, then two styled convolutions."""

    features: int
    factor: int = 2

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        x = resample.upsample_linear(x, factor=self.factor)
        x = SpatiallyStyledConv(self.features, name="conv1")(x, style)
        return SpatiallyStyledConv(self.features, name="conv2")(x, style)


class SpatialStyleDecoder(linen.Module):
    """A map of styles [N, *grid, F] -> {scale: [N, *size / scale, channels]}: a constant grown under the styles.

    Attributes:
      start: size of the constant.
      channels: of every output.
      width: of the constant.
      middle: (width, factor) of the blocks before the first output.
      last: widths of the blocks that end in the scales 4, 2 and 1.
    """

    start: tuple[int, ...]
    channels: int
    width: int
    middle: tuple[tuple[int, int], ...]
    last: tuple[int, int, int]

    @linen.compact
    def __call__(self, style: jax.Array) -> dict[int, jax.Array]:
        constant = self.param("constant", layers.shape_only, (*self.start, self.width))
        x = jnp.broadcast_to(constant[None], (style.shape[0], *constant.shape))
        x = SpatialInstanceNorm(name="first_norm")(x, style)
        x = SpatiallyStyledConv(self.width, name="first_conv")(x, style)
        for index, (width, factor) in enumerate(self.middle):
            x = SpatiallyStyledBlock(width, factor, name=f"block{index}")(x, style)
        out = {}
        for scale, width in zip((4, 2, 1), self.last, strict=True):
            x = SpatiallyStyledBlock(width, name=f"up_{scale}")(x, style)
            out[scale] = layers.Dense(self.channels, name=f"head_{scale}")(x)
        return out


def style_decoder_2d(channels: int, start: tuple[int, int], blocks: int) -> SpatialStyleDecoder:
    """The reference's StyleDecoder2D."""
    return SpatialStyleDecoder(start, channels, 512, ((512, 2),) * blocks, (256, 128, 64))


def style_decoder_3d(channels: int, start: tuple[int, int, int], width: int) -> SpatialStyleDecoder:
    """The reference's StyleDecoder3D."""
    return SpatialStyleDecoder(start, channels, 2 * width, ((2 * width, 1), (width, 2)),
                               (width // 2, width // 4, width // 8))
