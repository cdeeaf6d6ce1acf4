"""Brings the maps of a feature pyramid together at the coarsest or at the finest size."""

from __future__ import annotations

import jax
from flax import linen

from muvo_jax.nn import layers, norm
from muvo_jax.ops import conv as conv_ops
from muvo_jax.ops import resample


class ConvNormRelu(linen.Module):
    """3x3 convolution without bias, BatchNorm, ReLU."""

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        x = layers.Conv(self.features, (3, 3), self.compute, use_bias=False, name="conv")(x)
        return jax.nn.relu(norm.BatchNorm(name="norm")(x, mode))


class DownsamplingPyramid(linen.Module):
    """[N, Hl, Wl, Cl], finest first -> [N, H, W, features] at the coarsest size.

    Starts from the finest map; at each coarser level the sum so far is max-pooled and the level's map is added.
    """

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, maps: list[jax.Array], mode: norm.Mode) -> jax.Array:
        x = ConvNormRelu(self.features, self.compute, name="level0")(maps[0], mode)
        for index, finer in enumerate(maps[1:], start=1):
            ratio = x.shape[2] // finer.shape[2]
            pooled = conv_ops.max_pool(x, window=ratio, stride=ratio)
            x = ConvNormRelu(self.features, self.compute, name=f"level{index}")(finer, mode) + pooled
        return x


class UpsamplingPyramid(linen.Module):
    """[N, Hl, Wl, Cl], finest first, each half as large as the one before -> [N, H, W, features] at the finest size.

    Starts from the coarsest map; at each finer level the sum so far is enlarged and the level's map is added.
    """

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, maps: list[jax.Array], mode: norm.Mode) -> jax.Array:
        x = ConvNormRelu(self.features, self.compute, name="coarsest")(maps[-1], mode)
        for index, finer in enumerate(reversed(maps[:-1])):
            larger = resample.upsample_linear(x, finer.shape[2] // x.shape[2])
            x = ConvNormRelu(self.features, self.compute, name=f"finer{index}")(finer, mode) + larger
        return x
