"""ResNet-18 as a feature pyramid (He et al., 2016), and its basic block, which also serves for compression."""

from __future__ import annotations

import jax
from flax import linen

from muvo_jax.nn import layers, norm
from muvo_jax.ops import conv as conv_ops

LEVEL_MULTIPLIERS = (1, 2, 4, 8)


class BasicBlock(linen.Module):
    """Two 3x3 convolutions with a shortcut: [N, H, W, I] -> [N, H/stride, W/stride, features].

    The shortcut is a 1x1 convolution where `project` says so, else the identity.
    """

    features: int
    compute: layers.Compute = layers.Compute()
    stride: int = 1
    project: bool = False

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        conv = lambda size, stride, name: layers.Conv(self.features, (size, size), self.compute, stride, use_bias=False,
                                                      name=name)
        y = jax.nn.relu(norm.BatchNorm(name="bn1")(conv(3, self.stride, "conv1")(x), mode))
        y = norm.BatchNorm(name="bn2")(conv(3, 1, "conv2")(y), mode)
        if self.project:
            x = norm.BatchNorm(name="downsample_norm")(conv(1, self.stride, "downsample_conv")(x), mode)
        return jax.nn.relu(x + y)


class ResNet18(linen.Module):
    """Feature maps of chosen levels: [N, H, W, I] -> level l: [N, H / 2**(l+1), W / 2**(l+1), width * 2**(l-1)].

    Levels above the last one asked for have no parameters.
    """

    width: int
    levels: tuple[int, ...]
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> list[jax.Array]:
        x = layers.Conv(self.width, (7, 7), self.compute, stride=2, use_bias=False, name="conv1")(x)
        x = jax.nn.relu(norm.BatchNorm(name="bn1")(x, mode))
        x = conv_ops.max_pool(x, window=3, stride=2, padding=1)
        maps = []
        for level in range(1, max(self.levels) + 1):
            features, first = self.width * LEVEL_MULTIPLIERS[level - 1], level == 1
            x = BasicBlock(features, self.compute, 1 if first else 2, not first, name=f"layer{level}_0")(x, mode)
            x = BasicBlock(features, self.compute, name=f"layer{level}_1")(x, mode)
            if level in self.levels:
                maps.append(x)
        return maps
