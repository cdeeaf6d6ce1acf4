"""Nearest neighbours by brute force in bounded memory, differentiable."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax


def nearest_distance(points, targets, target_mask, chunk: int = 1024):
    """Distance from each point to its nearest target that counts.

    Args:
      points: float32 [P, 3].
      targets: float32 [Q, 3].
      target_mask: bool [Q], which targets count.
      chunk: points handled at a time; memory is chunk * Q.

    Returns:
      float32 [P]; +inf where no target counts. The gradient is 0 where the distance is.
    """
    count = points.shape[0]
    chunk = min(chunk, count)
    padded = jnp.pad(points, ((0, -count % chunk), (0, 0))).reshape(-1, chunk, 3)

    def distances(some):
        offset = some[:, None] - targets[None]
        squared = jnp.where(target_mask[None], jnp.square(offset).sum(-1), jnp.inf)
        index = lax.stop_gradient(jnp.argmin(squared, -1))
        # Only the nearest pair is differentiated; the inner `where` keeps the square root's slope finite at 0.
        nearest = jnp.square(some - targets[index]).sum(-1)
        safe = jnp.sqrt(jnp.where(nearest > 0.0, nearest, 1.0))
        return jnp.where(target_mask[index], jnp.where(nearest > 0.0, safe, 0.0), jnp.inf)

    return lax.map(jax.checkpoint(distances), padded).reshape(-1)[:count]
