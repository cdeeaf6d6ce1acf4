"""MobileViT-V2 as a feature pyramid (Mehta and Rastegari, 2022): inverted residuals, and attention
that costs as much per pixel in a large map as in a small one.

Sizes are those of timm's mobilevitv2_100 at width 64.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.nn import layers, norm
from muvo_jax.ops import resample

_EXPANSION = 2
_PATCH = 2
# Level -> width of its output in units of the pyramid's width, linear-attention blocks (the first level has none).
_LEVELS = {1: (2, 0), 2: (4, 2), 3: (6, 4), 4: (8, 3)}


class ConvNorm(linen.Module):
    """Convolution without bias (`size` 1 or 3; depthwise where said), BatchNorm, SiLU where said."""

    features: int
    size: int
    compute: layers.Compute = layers.Compute()
    stride: int = 1
    depthwise: bool = False
    activate: bool = True

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        if self.depthwise:
            x = layers.DepthwiseConv(self.size, self.compute, self.stride, name="conv")(x)
        elif self.size == 1:
            x = layers.Dense(self.features, self.compute, use_bias=False, name="conv")(x)
        else:
            x = layers.Conv(self.features, (self.size, self.size), self.compute, self.stride, use_bias=False,
                            name="conv")(x)
        x = norm.BatchNorm(name="bn")(x, mode)
        return jax.nn.silu(x) if self.activate else x


class Bottleneck(linen.Module):
    """Inverted residual: widen, depthwise 3x3, narrow; added to its input where the shapes agree."""

    features: int
    stride: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        wide = _EXPANSION * x.shape[-1]
        y = ConvNorm(wide, 1, self.compute, name="widen")(x, mode)
        y = ConvNorm(wide, 3, self.compute, self.stride, depthwise=True, name="depthwise")(y, mode)
        y = ConvNorm(self.features, 1, self.compute, activate=False, name="narrow")(y, mode)
        return x + y if y.shape == x.shape else y


class LinearAttention(linen.Module):
    """Tokens [N, P, L, C] attend to one context per patch position p: the sum of keys, weighted by a softmax over L."""

    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        channels = x.shape[-1]
        projected = layers.Dense(1 + 2 * channels, self.compute, name="qkv_proj")(x)
        query, key, value = jnp.split(projected, (1, 1 + channels), axis=-1)
        scores = jax.nn.softmax(query.astype(jnp.float32), axis=-2).astype(key.dtype)
        context = jnp.sum(key * scores, axis=-2, keepdims=True)
        return layers.Dense(channels, self.compute, name="out_proj")(jax.nn.relu(value) * context)


class LinearTransformerLayer(linen.Module):
    """Linear attention and a perceptron twice as wide, each behind a norm and added to its input."""

    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        channels = x.shape[-1]
        x = x + LinearAttention(self.compute, name="attn")(norm.SampleNorm(name="norm1")(x))
        y = norm.SampleNorm(name="norm2")(x)
        y = jax.nn.silu(layers.Dense(2 * channels, self.compute, name="fc1")(y))
        return x + layers.Dense(channels, self.compute, name="fc2")(y)


class MobileVitBlock(linen.Module):
    """Depthwise 3x3, linear attention at half width among equal places of 2x2 patches: [N, H, W, C] -> [N, H', W', C].

    An odd side grows by one, linearly and before all else, so that patches are whole: H' and W' are even.
    """

    blocks: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        frames, *size, channels = x.shape
        rows, columns = (side + side % _PATCH for side in size)
        x = resample.resize_corners(x, (rows, columns))
        x = ConvNorm(channels, 3, self.compute, depthwise=True, name="local")(x, mode)
        x = layers.Dense(channels // 2, self.compute, use_bias=False, name="enter")(x)
        x = x.reshape(frames, rows // _PATCH, _PATCH, columns // _PATCH, _PATCH, channels // 2)
        x = x.transpose(0, 2, 4, 1, 3, 5).reshape(frames, _PATCH**2, -1, channels // 2)
        for index in range(self.blocks):
            x = LinearTransformerLayer(self.compute, name=f"transformer{index}")(x)
        x = norm.SampleNorm(name="norm")(x)
        x = x.reshape(frames, _PATCH, _PATCH, rows // _PATCH, columns // _PATCH, channels // 2)
        x = x.transpose(0, 3, 1, 4, 2, 5).reshape(frames, rows, columns, channels // 2)
        return ConvNorm(channels, 1, self.compute, activate=False, name="leave")(x, mode)


class MobileVit(linen.Module):
    """Feature maps of chosen levels: [N, H, W, I] -> level l: [N, H / 2**(l+1), W / 2**(l+1), C of the level].

    The levels have 2, 4, 6 and 8 times `width` channels. Levels above the last one asked for have no parameters. A
    level with attention works on even sides; a map that grew for that is resized to its own size in the end.

    Attributes:
      keep_grown: such a map stays as it is, as in timm; without, necks and fusion can count on the sizes above.
    """

    width: int
    levels: tuple[int, ...]
    compute: layers.Compute = layers.Compute()
    keep_grown: bool = False

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> list[jax.Array]:
        sides = x.shape[1:3]
        x = ConvNorm(self.width // 2, 3, self.compute, stride=2, name="stem")(x, mode)
        x = Bottleneck(self.width, 1, self.compute, name="stage0_0")(x, mode)
        maps = []
        for level in range(1, max(self.levels) + 1):
            factor, blocks = _LEVELS[level]
            x = Bottleneck(factor * self.width, 2, self.compute, name=f"stage{level}_0")(x, mode)
            if blocks:
                x = MobileVitBlock(blocks, self.compute, name=f"stage{level}_1")(x, mode)
            else:
                x = Bottleneck(factor * self.width, 1, self.compute, name=f"stage{level}_1")(x, mode)
            if level in self.levels:
                rows, columns = (-(-side // 2 ** (level + 1)) for side in sides)
                maps.append(x if self.keep_grown else resample.resize_corners(x, (rows, columns)))
        return maps
