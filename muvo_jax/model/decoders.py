"""Decoders from the latent features to images, range views, voxels and numbers (paper section III-D).

Each maps features [N, F], or with the 2D latent a map of tokens [N, *grid, C], to {scale: array}, scale 1 being the
full size, 2 and 4 halved once and twice. Those of tokens are a convolution, doublings at full width, then three with
half, a quarter and an eighth of it, each of which ends in one scale. What heads are built of stands at the end.

With first_guess=TrainingMean, an addition to the paper (docs/design.md says what it brings), a decoder draws the
difference from the average training frame, which the training loop measures before the first step (FirstGuess): a
fresh model predicts the average and learns the rest.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import head as head_lib
from muvo_jax.config import ModelConfig, TokenLatent, ZeroGuess
from muvo_jax.model import memory, tokens
from muvo_jax.nn import layers, norm

_PLANE_KERNELS = (5, 5, 6, 6, 6, 6)
INSTANCE_CHANNELS = 3  # offset and centre
_TOKEN_STAGES = ((4, 2), (2, 4), (1, 8))  # scale, by what the width is divided


def plane_start(size: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Constant size and stride of the first stage, per axis, so that six stages end at `size` exactly.

    A side that is a multiple of 64 starts at side / 64 and doubles six times, as in the reference (320 x 832 from
    5 x 13). One that is a multiple of 32 only starts at side / 32, and the first stage leaves it as it is.
    """
    halves = tuple(side % 64 == 0 for side in size)
    start = tuple(side // 64 if even else side // 32 for side, even in zip(size, halves, strict=True))
    return start, tuple(2 if even else 1 for even in halves)


class UpStage(linen.Module):
    """Transposed convolution, ELU."""

    features: int
    kernel: int
    stride: tuple[int, ...]
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return jax.nn.elu(layers.ConvTranspose(self.features, (self.kernel, self.kernel), self.stride, self.compute,
                                               name="conv")(x))


class PlaneDecoder(linen.Module):
    """Features -> planes [N, H/scale, W/scale, channels]: a stack of transposed convolutions, no output activation."""

    size: tuple[int, int]
    channels: int
    width: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, features: jax.Array) -> dict[int, jax.Array]:
        start, first_stride = plane_start(self.size)
        x = layers.Dense(self.width, self.compute, name="linear")(features)
        x = jax.nn.elu(layers.Unfold(self.width, start, self.compute, name="seed")(x))
        widths = (self.width,) * 3 + (self.width // 2, self.width // 4, self.width // 8)
        out = {}
        for index, (width, kernel) in enumerate(zip(widths, _PLANE_KERNELS, strict=True)):
            stride = first_stride if index == 0 else (2, 2)
            x = UpStage(width, kernel, stride, self.compute, name=f"up{index}")(x)
            if index >= 3:
                scale = 2 ** (5 - index)
                out[scale] = layers.Dense(self.channels, self.compute, name=f"head_{scale}")(x).astype(jnp.float32)
        return out


class BirdsEyeHead(linen.Module):
    """[N, X, Y, C] -> [N, X, Y, features]: class logits, then offset (2) and centre (1, in (0, 1)) of instances."""

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        dense = lambda features, name: layers.Dense(features, self.compute, name=name)(x)
        return jnp.concatenate([dense(self.features - INSTANCE_CHANNELS, "segmentation"), dense(2, "offset"),
                                jax.nn.sigmoid(dense(1, "center"))], axis=-1)


class StyledConv(linen.Module):
    """3x3x3 (3x3) convolution, of x or of x doubled linearly; leaky ReLU 0.2, adaptive instance norm."""

    features: int
    compute: layers.Compute = layers.Compute()
    doubled: bool = False

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        conv = layers.Conv(self.features, (3,) * (x.ndim - 2), self.compute, doubled=self.doubled, name="conv")
        return norm.AdaptiveInstanceNorm(self.compute, name="norm")(jax.nn.leaky_relu(conv(x), 0.2), style)


class StyledUpBlock(linen.Module):
    """Linear doubling, then two styled convolutions."""

    features: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, style: jax.Array) -> jax.Array:
        x = StyledConv(self.features, self.compute, doubled=True, name="conv1")(x, style)
        return StyledConv(self.features, self.compute, name="conv2")(x, style)


class StyledDecoder(linen.Module):
    """Features -> [N, *shape / scale, channels] over two or three axes: a learned constant grown under adaptive norms.

    `blocks` doublings at full width, then three with half, a quarter and an eighth of it.

    Attributes:
      constant_width: channels of the constant.
      head: the layer that ends each scale.
    """

    shape: tuple[int, ...]
    channels: int
    constant_width: int
    width: int
    blocks: int
    head: type[layers.Dense] | type[BirdsEyeHead] = layers.Dense
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, features: jax.Array) -> dict[int, jax.Array]:
        shrink = 2 ** (self.blocks + 3)
        if any(side % shrink for side in self.shape):
            raise ValueError(f"a decoder of {self.shape} voxels doubles {self.blocks + 3} times: each side must be a "
                             f"multiple of {shrink}. Change model.voxels or model.latent.occupancy_blocks.")
        start = tuple(side // shrink for side in self.shape)
        constant = self.param("constant", layers.shape_only, (*start, self.constant_width)).astype(self.compute.dtype)
        x = jnp.broadcast_to(constant[None], (features.shape[0], *constant.shape))
        x = norm.AdaptiveInstanceNorm(self.compute, name="first_norm")(x, features)
        x = StyledConv(self.width, self.compute, name="first_conv")(x, features)
        for index in range(self.blocks):
            x = StyledUpBlock(self.width, self.compute, name=f"block{index}")(x, features)
        out = {}
        for scale, width in ((4, self.width // 2), (2, self.width // 4), (1, self.width // 8)):
            x = StyledUpBlock(width, self.compute, name=f"up_{scale}")(x, features)
            out[scale] = self.head(self.channels, self.compute, name=f"head_{scale}")(x).astype(jnp.float32)
        return out


class _Doubling(linen.Module):
    """Transposed convolution of stride 2, ELU: every side doubles."""

    features: int
    kernel: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        rank = x.ndim - 2
        conv = layers.ConvTranspose(self.features, (self.kernel,) * rank, (2,) * rank, self.compute, name="conv")
        return jax.nn.elu(conv(x))


class TokenDecoder(linen.Module):
    """[N, *grid, C] -> [N, *(grid * 2**(stages + 3) / scale), channels], for two or three axes; no output activation.

    Attributes:
      channels: of every output.
      first_width: of the first convolution.
      width: of the `stages` doublings, and what the last three divide.
      stages: doublings before the first output.
      head: the layer that ends each scale.
      flat: decode the ground plan, the largest value over the last of three axes.
    """

    channels: int
    first_width: int
    width: int
    stages: int
    compute: layers.Compute = layers.Compute()
    head: type[layers.Dense] | type[BirdsEyeHead] = layers.Dense
    flat: bool = False

    @linen.compact
    def __call__(self, cells: jax.Array) -> dict[int, jax.Array]:
        if self.flat:
            cells = cells.max(axis=-2)
        rank = cells.ndim - 2
        x = jax.nn.elu(layers.Conv(self.first_width, (3,) * rank, self.compute, name="first")(cells))
        for index in range(self.stages):
            x = _Doubling(self.width, 4, self.compute, name=f"pre{index}")(x)
        out = {}
        for scale, divisor in _TOKEN_STAGES:
            x = _Doubling(self.width // divisor, 6, self.compute, name=f"grow_{scale}")(x)
            out[scale] = self.head(self.channels, self.compute, name=f"head_{scale}")(x).astype(jnp.float32)
        return out


class ActionDecoder(linen.Module):
    """Features -> action [N, 2] in (-1, 1): a perceptron as wide as the features, the driver's behaviour cloned."""

    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, features: jax.Array) -> dict[int, jax.Array]:
        width = features.shape[-1]
        out = layers.Mlp((width, width, width // 2, 2), self.compute, name="mlp")(features)
        return {1: jnp.tanh(out.astype(jnp.float32))}


class VectorDecoder(linen.Module):
    """Features -> [N, channels] at scale 1: a perceptron with two hidden layers, no output activation."""

    channels: int
    width: int
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, features: jax.Array) -> dict[int, jax.Array]:
        out = layers.Mlp((self.width, self.width, self.channels), self.compute, name="mlp")(features)
        return {1: out.astype(jnp.float32)}


class FirstGuess(linen.Module):
    """{scale: [N, *size, C]} -> the same plus one constant [*size, C] a scale, kept beside BatchNorm's statistics."""

    @linen.compact
    def __call__(self, outputs: dict[int, jax.Array]) -> dict[int, jax.Array]:
        constant = lambda scale, shape: self.variable("batch_stats", f"scale_{scale}", jnp.zeros, shape, jnp.float32)
        return {scale: value + constant(scale, value.shape[1:]).value[None] for scale, value in outputs.items()}


def first_guess_path(head: str) -> str:
    """Where the constants of a head lie in `batch_stats`."""
    return f"first_guess_{head}"


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value, for the heads whose decoders do not see the memory.

    Where the average training frame is the first guess, the last layers start at zero and add nothing to it.
    """
    values: dict[str, float] = {}
    guessed = memory.guessed_heads(config)
    for name in config.heads:
        head = head_lib.get(name)
        if head.initial_bias is None or name in guessed:
            continue
        for scale in head.scales:
            path = f"decoders_{name}/head_{scale}"
            if not isinstance(config.first_guess, ZeroGuess) and head.average is not None:
                values |= {f"{path}/bias": 0.0, f"{path}/kernel": 0.0}
            else:
                values[f"{path}/bias"] = head.initial_bias
    return values


def of_image(config: ModelConfig, channels: int) -> linen.Module:
    """What draws on the image's plane."""
    return _plane(config, channels, config.image_size, tokens.IMAGE_SHRINK)


def of_range_view(config: ModelConfig, channels: int) -> linen.Module:
    """What draws on the range view's plane."""
    return _plane(config, channels, (config.range_view.rows, config.range_view.columns), tokens.RANGE_VIEW_SHRINK)


def of_voxels(config: ModelConfig, channels: int) -> linen.Module:
    """What fills the voxel grid."""
    width, compute = config.occupancy_channels, layers.Compute.of(config)
    if isinstance(config.latent, TokenLatent):
        return TokenDecoder(channels, 2 * width, width, config.latent.occupancy_token_stages, compute)
    return StyledDecoder(config.voxels.shape, channels, 2 * width, width, config.latent.occupancy_blocks,
                         compute=compute)


def of_ground_plan(config: ModelConfig, classes: int) -> linen.Module:
    """What draws classes and instances on the ground plan of the voxel grid."""
    width, compute, channels = config.decoder_channels, layers.Compute.of(config), classes + INSTANCE_CHANNELS
    if isinstance(config.latent, TokenLatent):
        return TokenDecoder(channels, width, width, config.latent.occupancy_token_stages, compute, BirdsEyeHead,
                            flat=True)
    return StyledDecoder(config.voxels.shape[:2], channels, width, width, config.latent.occupancy_blocks, BirdsEyeHead,
                         compute)


def of_numbers(config: ModelConfig, channels: int) -> linen.Module:
    """A few numbers, without an output activation: reward, motion and the like."""
    return VectorDecoder(channels, config.decoder_channels, layers.Compute.of(config))


def _plane(config: ModelConfig, channels: int, size: tuple[int, int], token_shrink: int) -> linen.Module:
    width, compute = config.decoder_channels, layers.Compute.of(config)
    if isinstance(config.latent, TokenLatent):
        stages = token_shrink.bit_length() - 4  # three more doublings end in an output each
        return TokenDecoder(channels, width, width, stages, compute)
    return PlaneDecoder(size, channels, width, compute)
