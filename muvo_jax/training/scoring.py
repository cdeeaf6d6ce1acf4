"""Decoding frames and scoring them against a batch: the part of a training step whose memory grows with the frames.

At the paper's size one head keeps gigabytes of every few frames that it decodes until the backward pass has used them.
Where asked to (train.remat) heads are decoded one frame after the other: the loss terms are sums over frames, so that a
scan adds them up, and its backward pass computes again what a frame needs. It must be a scan: XLA's CPU backend drops
the barriers of jax.checkpoint elsewhere and computes again so early that nothing is saved.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.metrics import image as image_metrics
from muvo_jax.model import world_model
from muvo_jax.objectives import perceptual, regression, total

PSNR = "psnr_db"  # beside the loss terms, of the image
NamedSums = dict[str, head_lib.Sums]


def sums(model: world_model.WorldModel, variables: types.Variables, states: types.LatentState,
         memory: types.Memory | None, batch: types.Batch, keys: types.Array, *, config: config_lib.Config,
         frozen: perceptual.FrozenEncoder | None, one_by_one: bool) -> NamedSums:
    """Decodes states with all heads and reduces their loss terms, and PSNR, to sums over samples and frames.

    Args:
      model, variables: what decodes.
      states: LatentState [B, T, ...].
      memory: of the B drives, where the model has one.
      batch: the same frames, [B, T, ...].
      keys: typed keys [B], one per sample.
      config: of the run.
      frozen: the network of the perceptual term, where that is on.
      one_by_one: decode frame by frame, and again for the gradients; else all at once.
    """
    scored: NamedSums = {}
    rows = None
    if memory is not None:
        rows = jnp.repeat(jnp.arange(batch.batch_size, dtype=jnp.int32), batch.frames).reshape(-1, batch.frames)
    frame_keys = total.frame_keys(keys, batch.frames)
    for head in model.config.heads:
        def some(states, batch, keys, rows, head=head):
            predictions = model.decode(variables, states, (head,), memory=memory, rows=rows)
            return _with_psnr(predictions, batch, total.head_sums(
                head, predictions, batch, model=model.config, loss=config.loss, keys=keys, frozen=frozen))

        scored |= (_added_up if one_by_one else _at_once)(some, states, batch, frame_keys, rows)
    return scored


def _with_psnr(predictions: types.Predictions, batch: types.Batch, scored: NamedSums) -> NamedSums:
    if batch.image is None or "image" not in predictions:
        return scored
    each = image_metrics.frame_psnr_db(jax.lax.stop_gradient(predictions.image), batch.image)
    return scored | {PSNR: regression.MeanSums(each.sum(), jnp.float32(each.size))}


def _at_once(function: Callable[..., NamedSums], *frames: Any) -> NamedSums:
    return function(*frames)


def _added_up(function: Callable[..., NamedSums], states, batch, keys, rows) -> NamedSums:
    """The sum of function(...) over all frames, each of them as one of one window, [1, 1, ...]."""
    one_each = lambda leaf: leaf.reshape(-1, 1, 1, *leaf.shape[2:])
    count = batch.frames
    calibration = {name: jnp.repeat(jnp.asarray(getattr(batch, name)), count, axis=0)[:, None]
                   for name in types.UNTIMED_FIELDS if getattr(batch, name) is not None}
    states, keys, rows = jax.tree.map(one_each, (states, keys, rows))
    frames = (states, batch.map_frames(one_each).replace(**calibration), keys, rows)
    first = jax.tree.map(lambda leaf: leaf[0], frames)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *first))
    step = jax.checkpoint(function, prevent_cse=False)  # a scan keeps the two passes apart
    added, _ = jax.lax.scan(lambda so_far, frame: (jax.tree.map(jnp.add, so_far, step(*frame)), None), zeros, frames)
    return added
