"""Structural similarity of pictures (Wang et al., 2004): a Gaussian window of 11 pixels, sigma 1.5, no padding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import types
from muvo_jax.objectives import regression

WINDOW_PX = 11
_SIGMA_PX, _C1, _C2 = 1.5, 0.01 ** 2, 0.03 ** 2


def window() -> np.ndarray:
    """float32 [11, 11]: the Gaussian over which pictures are compared."""
    offset = np.arange(WINDOW_PX) - WINDOW_PX // 2
    line = np.exp(-np.square(offset) / (2 * _SIGMA_PX ** 2)).astype(np.float32)
    line /= line.sum()
    return np.outer(line, line)


def frame_similarity(prediction: types.Array, target: types.Array) -> types.Array:
    """Mean structural similarity of each picture and channel: float32 [..., H, W, C] in [0, 1] -> [..., C].

    Raises:
      ValueError: for pictures smaller than the window.
    """
    if min(prediction.shape[-3:-1]) < WINDOW_PX:
        raise ValueError(f"structural similarity of pictures of {prediction.shape[-3]}x{prediction.shape[-2]} pixels: "
                         f"they must have at least {WINDOW_PX} on a side. The smallest scale is a quarter of "
                         f"model.image_size; choose larger images or loss.image_similarity=0.")
    line = jnp.asarray(window().sum(axis=0))

    def blur(image: jax.Array) -> jax.Array:
        for axis in (image.ndim - 3, image.ndim - 2):
            count = image.shape[axis] - WINDOW_PX + 1
            image = sum((line[tap] * jax.lax.slice_in_dim(image, tap, tap + count, axis=axis)
                         for tap in range(WINDOW_PX)), jnp.float32(0.0))
        return image

    mean_p, mean_t = blur(prediction), blur(target)
    # Variances do not depend on an offset; about the middle of [0, 1] their differences cancel less.
    from_p, from_t, about_p, about_t = prediction - 0.5, target - 0.5, mean_p - 0.5, mean_t - 0.5
    variance_p = blur(from_p * from_p) - about_p * about_p
    variance_t = blur(from_t * from_t) - about_t * about_t
    covariance = blur(from_p * from_t) - about_p * about_t
    contrast = (2.0 * covariance + _C2) / (variance_p + variance_t + _C2)
    similarity = (2.0 * mean_p * mean_t + _C1) / (mean_p ** 2 + mean_t ** 2 + _C1) * contrast
    return similarity.mean(axis=(-3, -2))


def dissimilarity_sums(prediction: types.Array, target: types.Array) -> regression.MeanSums:
    """1 - structural similarity of pictures [..., H, W, C], to be averaged over pictures and channels."""
    each = 1.0 - frame_similarity(prediction.astype(jnp.float32), target)
    return regression.MeanSums(each.sum(), jnp.float32(each.size))
