"""Optional Chamfer term between predicted and measured lidar points.

The third point-cloud term of paper Eq. 1, which neither its text nor the reference's code defines: here the mean
nearest distance from prediction to truth plus the same backwards, over a keyed subset of the returns of each frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.objectives import regression
from muvo_jax.ops import nearest


def chamfer_sums(prediction: types.Array, target: types.Array, keys: types.Array, *, points: int,
                 return_threshold_m: float, scale_m: float) -> regression.MeanSums:
    """Sums over frames; a frame in which one side has no return does not count.

    Args:
      prediction, target: float32 [B, T, Hr, Wr, 4], metres.
      keys: typed keys [B, T], one per frame.
      points: size of the subset of each side.
      return_threshold_m: a predicted return is a predicted range above this.
      scale_m: metres per unit of the loss.
    """
    def frame_sums(predicted, measured, key):
        predicted, measured = predicted.reshape(-1, 4), measured.reshape(-1, 4)
        key_predicted, key_measured = jax.random.split(key)
        some, some_mask = _subset(predicted, predicted[:, 3] > return_threshold_m, key_predicted, points)
        others, others_mask = _subset(measured, measured[:, 3] > 0.0, key_measured, points)
        return frame_chamfer(some / scale_m, some_mask, others / scale_m, others_mask)

    distance, defined = jax.vmap(jax.vmap(frame_sums))(prediction.astype(jnp.float32), target, keys)
    return regression.MeanSums(distance.sum(), defined.sum().astype(jnp.float32))


def frame_chamfer(some: types.Array, some_mask: types.Array, others: types.Array,
                  others_mask: types.Array) -> tuple[types.Array, types.Array]:
    """Both mean nearest distances of two masked clouds, added.

    Args:
      some, others: float32 [P, 3] and [Q, 3].
      some_mask, others_mask: bool [P] and [Q].

    Returns:
      The distance, 0 where undefined, and whether it is defined (both clouds have a point).
    """
    there, there_count, back, back_count = nearest.chamfer_sums(some, others, some_mask, others_mask)
    return there / jnp.maximum(there_count, 1.0) + back / jnp.maximum(back_count, 1.0), there_count > 0.0


def _subset(cloud: types.Array, mask: types.Array, key: types.Array, points: int) -> tuple[types.Array, types.Array]:
    """At most `points` of the masked rows of a [P, 4] range view, without repetition, as [K, 3] and a mask."""
    score = jnp.where(mask, jax.random.uniform(key, mask.shape, jnp.float32, minval=0.5), 0.0)
    score, index = jax.lax.top_k(score, min(points, cloud.shape[0]))
    return cloud[index, :3], score > 0.0
