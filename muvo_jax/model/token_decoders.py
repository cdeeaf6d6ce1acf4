"""Decoders from the tokens of the 2D latent to images, range views and voxels (paper section III-D).

Each takes a map of tokens [N, *grid, C] to {scale: array}, scale 1 being the full size: a convolution, `stages`
doublings at full width, then three with half, a quarter and an eighth of it, each of which ends in one scale.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.model import decoders
from muvo_jax.nn import layers

_STAGES = ((4, 2), (2, 4), (1, 8))  # scale, by what the width is divided


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
    head: type[layers.Dense] | type[decoders.BirdsEyeHead] = layers.Dense
    flat: bool = False

    @linen.compact
    def __call__(self, tokens: jax.Array) -> dict[int, jax.Array]:
        if self.flat:
            tokens = tokens.max(axis=-2)
        rank = tokens.ndim - 2
        x = jax.nn.elu(layers.Conv(self.first_width, (3,) * rank, self.compute, name="first")(tokens))
        for index in range(self.stages):
            x = _Doubling(self.width, 4, self.compute, name=f"pre{index}")(x)
        out = {}
        for scale, divisor in _STAGES:
            x = _Doubling(self.width // divisor, 6, self.compute, name=f"grow_{scale}")(x)
            out[scale] = self.head(self.channels, self.compute, name=f"head_{scale}")(x).astype(jnp.float32)
        return out
