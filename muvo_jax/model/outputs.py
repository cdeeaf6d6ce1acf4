"""From a decoder's raw outputs to predictions: the average frame underneath, the geometry of beams, the units.

Two additions to the paper, off by default (docs/design.md says what they bring). With `model.first_guess =
"training_mean"` a decoder draws the difference from the average training frame, which the training loop measures before
the first step: a fresh model predicts the average and learns the rest. With `model.range_view_points = "beams"` the
three coordinates of a pixel are the difference from the point at the predicted range along the pixel's beam: geometry
that is known need not be learned.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax import head as head_lib
from muvo_jax.config import ModelConfig
from muvo_jax.model import memory
from muvo_jax.ops import range_view as range_view_ops


class FirstGuess(linen.Module):
    """{scale: [N, *size, C]} -> the same plus one constant [*size, C] a scale, kept beside BatchNorm's statistics."""

    @linen.compact
    def __call__(self, outputs: dict[int, jax.Array]) -> dict[int, jax.Array]:
        return {scale: value + self.variable("batch_stats", f"scale_{scale}", jnp.zeros, value.shape[1:]).value[None]
                for scale, value in outputs.items()}


def first_guess_path(head: str) -> str:
    """Where the constants of a head lie in `batch_stats`."""
    return f"first_guess_{head}"


def along_beams(raw: jax.Array, scale: int, config: ModelConfig) -> jax.Array:
    """Raw range view [N, Hr/scale, Wr/scale, 4] (units of range_scale_m): x, y, z become differences from the beam."""
    geometry = config.range_view
    beams = range_view_ops.beam_directions(geometry)[::scale, ::scale]
    position = np.asarray(geometry.position_m, np.float32) / np.float32(config.range_scale_m)
    ranges = raw[..., 3:]
    points = raw[..., :3] + jnp.asarray(beams)[None] * ranges + jnp.asarray(position).reshape(1, 1, 1, 3)
    return jnp.concatenate([points, ranges], axis=-1)


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value, for the heads whose decoders do not see the memory.

    Where the average training frame is the first guess, the last layers start at zero and add nothing to it.
    """
    values: dict[str, float] = {}
    guessed = memory.guessed_heads(config)
    for name in config.heads:
        head = head_lib.get(name)
        if head.initial_bias is None or name in guessed:
            continue
        for scale in head.scales:
            path = f"decoders_{name}/head_{scale}"
            if config.first_guess != "zero" and head.average is not None:
                values |= {f"{path}/bias": 0.0, f"{path}/kernel": 0.0}
            else:
                values[f"{path}/bias"] = head.initial_bias
    return values
