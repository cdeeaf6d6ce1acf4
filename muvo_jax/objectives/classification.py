"""Terms of class maps, and the Dice term of occupancy, as sums over frames.

As in the reference, weighted cross-entropies are averaged over all pixels, not divided by the sum of the weights, and a
share of each frame's pixels, the ones predicted worst, may stand for all of them.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.objectives import regression

UNLABELLED = 255


def cross_entropy_sums(logits: types.Array, target: types.Array, *, weights: tuple[float, ...] = (),
                       top_share: float = 1.0, poly: float = 0.0) -> regression.MeanSums:
    """Cross-entropy, to be averaged over the pixels that count.

    Args:
      logits: float [B, T, *S, classes].
      target: integers [B, T, *S]; 255, and what is no class of the logits, does not count.
      weights: of each class; empty for 1.
      top_share: of each frame only the int(share * pixels) largest losses count.
      poly: adds poly * (1 - exp(-loss)) to each pixel's loss.

    Raises:
      ValueError: where there are weights for another number of classes.
    """
    classes = logits.shape[-1]
    if weights and len(weights) != classes:
        raise ValueError(f"cross-entropy: {len(weights)} class weights for {classes} classes; give one a class.")
    frames, pixels = math.prod(target.shape[:2]), math.prod(target.shape[2:])
    target = target.reshape(frames, pixels).astype(jnp.int32)
    known = (target >= 0) & (target < classes) & (target != UNLABELLED)
    index = jnp.where(known, target, 0)
    logarithm = jax.nn.log_softmax(logits.astype(jnp.float32).reshape(frames, pixels, classes), axis=-1)
    loss = -jnp.take_along_axis(logarithm, index[..., None], axis=-1)[..., 0]
    if weights:
        loss = loss * jnp.asarray(weights, jnp.float32)[index]
    if poly:
        loss = loss + poly * (1.0 - jnp.exp(-loss))
    loss, count = jnp.where(known, loss, 0.0), known.sum(axis=1)
    if top_share < 1.0:
        most = max(int(top_share * pixels), 1)
        loss, count = jax.lax.top_k(loss, most)[0], jnp.minimum(count, most)
    return regression.MeanSums(loss.sum(), count.sum().astype(jnp.float32))


def dice_sums(probability: types.Array, truth: types.Array, *, epsilon: float = 1.0,
              naive: bool = False) -> regression.MeanSums:
    """1 - Dice coefficient of each frame, to be averaged over frames.

    Args:
      probability: float32 [F, P], of being occupied; 0 where the truth is unknown.
      truth: float32 [F, P], 0 or 1.
      epsilon: keeps the ratio defined where a frame is empty.
      naive: divide by sums instead of sums of squares.
    """
    both = 2.0 * (probability * truth).sum(axis=1)
    if naive:
        dice = (both + epsilon) / (probability.sum(axis=1) + truth.sum(axis=1) + epsilon)
    else:
        dice = both / (jnp.square(probability).sum(axis=1) + jnp.square(truth).sum(axis=1) + 2.0 * epsilon)
    return regression.MeanSums((1.0 - dice).sum(), jnp.float32(dice.size))


def occupancy_dice_sums(logits: types.Array, target: types.Array, unknown_is_empty: bool) -> regression.MeanSums:
    """Dice term of occupancy logits [B, T, *S, 2] and uint8 targets [B, T, *S]; arguments as scal.occupancy_sums."""
    frames = math.prod(target.shape[:2])
    known = jnp.bool_(unknown_is_empty) | (target != types.OCCUPANCY_UNKNOWN)
    logits = logits.astype(jnp.float32)
    probability = jnp.where(known, jax.nn.sigmoid(logits[..., 1] - logits[..., 0]), 0.0)
    truth = (target == types.OCCUPANCY_OCCUPIED).astype(jnp.float32)
    return dice_sums(probability.reshape(frames, -1), truth.reshape(frames, -1))
