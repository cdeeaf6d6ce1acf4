"""Doubling and halving of channels-last maps, with the numbers of torch's interpolate (align_corners False)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax


def upsample_linear(x, factor: int = 2):
    """Doubles every spatial axis linearly: [N, *S, C] -> [N, *(2 S), C].

    Output 2i is 0.25 x[i-1] + 0.75 x[i], output 2i+1 is 0.75 x[i] + 0.25 x[i+1], the edges repeated, as bilinear and
    trilinear interpolation without aligned corners have it.

    Raises:
      ValueError: for another factor than 2.
    """
    if factor != 2:
        raise ValueError(f"upsample_linear: factor {factor}, expected 2.")
    for axis in range(1, x.ndim - 1):
        size = x.shape[axis]
        before = jnp.concatenate([lax.slice_in_dim(x, 0, 1, axis=axis),
                                  lax.slice_in_dim(x, 0, size - 1, axis=axis)], axis)
        after = jnp.concatenate([lax.slice_in_dim(x, 1, size, axis=axis),
                                 lax.slice_in_dim(x, size - 1, size, axis=axis)], axis)
        pair = jnp.stack([0.25 * before + 0.75 * x, 0.75 * x + 0.25 * after], axis + 1)
        x = pair.reshape(*x.shape[:axis], 2 * size, *x.shape[axis + 1:])
    return x
