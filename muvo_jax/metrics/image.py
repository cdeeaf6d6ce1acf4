"""Peak signal-to-noise ratio (paper section IV): of each frame from its own mean squared error, then the mean."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from muvo_jax import types
from muvo_jax.metrics import streaming

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


def masked_sums(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """What `masked_psnr_db` needs of the pixels of a mask, float64 [B, T].

    Args:
      prediction: float [B, T, H, W, 3] in [0, 1].
      target: uint8 [B, T, H, W, 3].
      mask: bool [B, T, H, W].
    """
    error = np.square(np.asarray(prediction, np.float32) - np.asarray(target, np.float32) / 255.0).mean(axis=-1)
    return {"error": np.where(mask, error, 0.0).sum(axis=(2, 3), dtype=np.float64), "pixels": mask.sum(axis=(2, 3))}


def masked_psnr_db(sums: streaming.Sums) -> np.ndarray:
    """PSNR of the mean squared error over all pixels of the mask together (a frame may show few); NaN without any."""
    error = streaming.divide_or_nan(sums["error"], sums["pixels"])
    return -10.0 * np.log10(np.maximum(error, 10.0 ** (-PSNR_LIMIT_DB / 10.0)))
