"""Another light on whole training windows, inputs and targets alike, so that few weathers teach more.

Unlike the photometric noise of augmentation.py, which the encoders alone see, this is another world under the same
geometry: every image of a window is tinted, darkened and hazed in one way.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from muvo_jax import types

_SITE = 0x1169  # separates these draws from all others made with the same sample key
BRIGHTNESS, TINT, HAZE = (0.55, 1.15), (0.88, 1.12), 0.45


def randomly(batch: types.Batch, keys: types.Array) -> types.Batch:
    """Every second window in a light drawn anew: image * brightness * tint (by channel), then mixed with a grey haze.

    Args:
      batch: windows [B, T, ...].
      keys: typed keys [B], one per window.
    """
    if batch.image is None:
        return batch

    def draw(key):
        coin, bright, tint, haze, grey = jax.random.split(jax.random.fold_in(key, _SITE), 5)
        share = jax.random.uniform(haze, (), jnp.float32, maxval=HAZE)
        factor = jax.random.uniform(bright, (), jnp.float32, minval=BRIGHTNESS[0], maxval=BRIGHTNESS[1])
        factor = factor * jax.random.uniform(tint, (3,), jnp.float32, minval=TINT[0], maxval=TINT[1])
        offset = share * jax.random.uniform(grey, (), jnp.float32, minval=100.0, maxval=210.0)
        on = jax.random.bernoulli(coin)
        return jnp.where(on, factor * (1.0 - share), 1.0), jnp.where(on, offset, 0.0)

    factor, offset = jax.vmap(draw)(keys)
    image = jnp.asarray(batch.image).astype(jnp.float32) * factor.reshape(-1, 1, 1, 1, 3)
    image = image + offset.reshape(-1, 1, 1, 1, 1)
    return dataclasses.replace(batch, image=jnp.clip(jnp.round(image), 0.0, 255.0).astype(jnp.uint8))
