"""Peak signal-to-noise ratio (paper section IV): of each frame from its own mean squared error, then the mean."""

from __future__ import annotations

import jax.numpy as jnp

from muvo_jax import types

PSNR_LIMIT_DB = 100.0


def frame_psnr_db(prediction: types.ArrayLike, target: types.ArrayLike) -> types.Array:
    """PSNR in decibels at range 1, at most 100 (identical frames would have none).

    Args:
      prediction: float [..., H, W, C] in [0, 1].
      target: uint8 [..., H, W, C], or float in [0, 1].

    Returns:
      float32 [...].
    """
    target = jnp.asarray(target)
    if target.dtype == jnp.uint8:
        target = target.astype(jnp.float32) / 255.0
    error = jnp.square(jnp.asarray(prediction).astype(jnp.float32) - target).mean(axis=(-3, -2, -1))
    return -10.0 * jnp.log10(jnp.maximum(error, 10.0 ** (-PSNR_LIMIT_DB / 10.0)))
