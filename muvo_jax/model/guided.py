"""Decoders that see the memory: a U-net whose deepest map is the latent's (model.first_guess="last_seen").

On the way down it reads the memory as it looks from the state's vantage, on the way up it draws what must be added to
that, where it covers anything, and to the average training frame elsewhere. So a fresh model predicts the moved memory
and learns the rest: to fill what was hidden, to move what moves, to blur what is uncertain.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common, outputs, tokens
from muvo_jax.model import glimpse as glimpse_lib
from muvo_jax.nn import layers
from muvo_jax.ops import conv_cpu, resample
from muvo_jax.types import RANGE_NO_RETURN_M

SCALES = (1, 2, 4)
_WIDTHS = {8: 1, 4: 1, 2: 2}  # what the width is divided by at each scale
_TRUST = 3.0  # log-odds that evidence of a hit or of a look through is worth to a fresh model
_NEAR_M = 10.0  # ranges are seen as 10 m / (10 m + range) too: near ones matter
_OVER_ROAD_M = 0.5  # a fresh model believes evidence above this height; the road's rings do not move with the world


def _activation(x: jax.Array) -> jax.Array:
    return jax.nn.leaky_relu(x, 0.1)


class GuidedDecoder(linen.Module):
    """Features and what is seen [N, *plane, C] -> {scale: [N, *plane / scale, outputs]}, raw.

    Attributes:
      config: of the model.
      head: of PARTS.
    """

    config: ModelConfig
    head: str

    @linen.compact
    def __call__(self, features: jax.Array, seen: jax.Array, numbers: jax.Array) -> dict[int, jax.Array]:
        config, compute, part = self.config, common.compute(self.config), PARTS[self.head]
        width = part.width(config)
        dense = lambda name, x, features: layers.Dense(features, compute, name=name)(x)
        conv = lambda name, x, features: _activation(layers.Conv(features, (3, 3), compute, name=name)(x))
        # Doubling and halving by dense layers on 2x2 pixels: whole matrix products, on any backend.
        grow = lambda name, x, features: _activation(conv_cpu.depth_to_space(dense(name, x, 4 * features), (2, 2)))
        down = {1: seen.astype(compute.dtype)}
        for scale in (2, 4, 8):
            blocks = conv_cpu.space_to_depth(down[scale // 2], (2, 2))
            down[scale] = conv(f"see_{scale}", blocks, width // _WIDTHS[scale])
        x = self._latent(features, width)
        while x.shape[1] < part.plane(config)[0] // 8:
            x = grow(f"pre_{x.shape[1]}", x, width)
        x = conv("join", x + down[8] + layers.spread(dense("numbers", numbers, width), 4), width)
        out = {}
        for scale in (4, 2):
            x = grow(f"grow_{scale}", x, width // _WIDTHS[scale])
            x = conv(f"draw_{scale}", jnp.concatenate([x, down[scale]], axis=-1), width // _WIDTHS[scale])
            out[scale] = dense(f"head_{scale}", x, part.outputs(config, scale)).astype(jnp.float32)
        # Full size is drawn in blocks of 2x2 pixels: a quarter of the places, with channels enough for a fast product.
        seen = conv_cpu.space_to_depth(down[1], (2, 2))
        x = conv("draw_1", jnp.concatenate([x, seen], axis=-1), width // _WIDTHS[2])
        blocks = dense("head_1", x, 4 * part.outputs(config, 1))
        if part.blurs:
            blocks = blocks + layers.Conv(4 * part.outputs(config, 1), (3, 3), compute, name="blur")(seen)
        return {1: conv_cpu.depth_to_space(blocks.astype(jnp.float32), (2, 2)), **out}

    def _latent(self, features: jax.Array, width: int) -> jax.Array:
        """The latent as a map of the plane: the head's tokens, or a vector unfolded."""
        compute = common.compute(self.config)
        if features.ndim == 2:
            part = PARTS[self.head]
            size = tuple(math.ceil(side / part.shrink) for side in part.plane(self.config))
            seed = layers.Dense(width, compute, name="linear")(features)
            return _activation(layers.Unfold(width, size, compute, name="seed")(seed))
        if features.ndim == 5:  # heights become channels
            features = features.reshape(*features.shape[:3], -1)
        return _activation(layers.Conv(width, (3, 3), compute, name="first")(features))


class GuidedHead(linen.Module):
    """One head of a model with memory: (features, Glimpse, numbers, average frame) -> {scale: raw prediction}."""

    config: ModelConfig
    head: str

    @linen.compact
    def __call__(self, features: jax.Array, glimpse: glimpse_lib.Glimpse, numbers: jax.Array,
                 mean: outputs.FirstGuess) -> dict[int, jax.Array]:
        part = PARTS[self.head]
        raw = GuidedDecoder(self.config, self.head, name="decoder")(features, part.see(glimpse, self.config), numbers)
        return part.compose(raw, glimpse, mean, self.config)


def _see_image(glimpse: glimpse_lib.ImageGlimpse, config: ModelConfig) -> jax.Array:
    del config
    return jnp.concatenate([glimpse.image - 0.5 * glimpse.covered, glimpse.covered], axis=-1)


def _compose_image(raw, glimpse: glimpse_lib.ImageGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
    """The average frame is put in the light of the newest image: at night it would fill every turn with daylight."""
    del config
    drawn, average = raw, mean(jax.tree.map(jnp.zeros_like, raw))
    usual = average[1].mean(axis=(1, 2), keepdims=True)
    light = jnp.where((glimpse.colour > 0.0) & (usual > 0.0), glimpse.colour / jnp.where(usual > 0.0, usual, 1.0), 1.0)
    moved, covered, result = glimpse.image, glimpse.covered, {}
    for scale in SCALES:
        if scale > 1:
            moved, covered = resample.mean_pool2(moved), resample.mean_pool2(covered)
        result[scale] = moved + (1.0 - covered) * light * average[scale] + drawn[scale]
    return result


def _nearness(range_m: jax.Array) -> jax.Array:
    return jnp.where(range_m > 0.0, _NEAR_M / (_NEAR_M + jnp.maximum(range_m, 0.0)), 0.0)


def _see_ranges(glimpse: glimpse_lib.RangeGlimpse, config: ModelConfig) -> jax.Array:
    scale_m = config.range_scale_m
    given = [glimpse.filled_m, glimpse.newest_m, glimpse.still_m]
    channels = [*map(_nearness, given), *(jnp.maximum(value, 0.0) / scale_m for value in (given[0], given[2])),
                *((value > 0.0).astype(jnp.float32) for value in (glimpse.moved_m, *given)), glimpse.sky,
                glimpse.height_m / 5.0]
    return jnp.stack(channels, axis=-1)


def _compose_ranges(raw, glimpse: glimpse_lib.RangeGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
    """x, y, z and range in units of range_scale_m; the range is -1 m where nothing is expected to return."""
    average = mean({scale: jnp.zeros_like(value[..., :4]) for scale, value in raw.items()})
    nothing, result = RANGE_NO_RETURN_M / config.range_scale_m, {}
    for scale, value in raw.items():
        moved, filled, sky = (array[:, ::scale, ::scale] for array in (glimpse.moved_m, glimpse.filled_m, glimpse.sky))
        usual = average[scale][..., 3]
        range_ = jnp.where(filled > 0.0, filled / config.range_scale_m, jnp.maximum(usual, 0.0)) + value[..., 3]
        prior = jnp.where(moved > 0.0, 2.0, jnp.where(filled > 0.0, 1.0, jnp.where(usual > 0.0, 0.5, -1.0)))
        logit = value[..., 4] + jnp.where(sky > 0.0, -2.0, prior)
        soft = jax.nn.sigmoid(logit)
        # Decided, because half a range is no range; the gradient is that of the probability.
        returned = jax.lax.stop_gradient((logit > 0.0).astype(jnp.float32) - soft) + soft
        expected = nothing + returned * (range_ - nothing)
        points = average[scale][..., :3]  # with range_view_points="beams" they are differences from the beam already
        if config.range_view_points == "free":
            on_beam = outputs.along_beams(jnp.concatenate([jnp.zeros_like(points), jnp.expand_dims(range_, -1)], -1),
                                          scale, config)
            points = jnp.where(jnp.expand_dims(filled > 0.0, -1), on_beam[..., :3], points)
        points = value[..., :3] + points + glimpse.off_beam_m[:, ::scale, ::scale] / config.range_scale_m
        result[scale] = jnp.concatenate([points, jnp.expand_dims(expected, -1)], axis=-1)
    return result


def _see_voxels(glimpse: glimpse_lib.VoxelGlimpse, config: ModelConfig) -> jax.Array:
    del config
    moving = [] if glimpse.onward is None else [glimpse.onward]
    return jnp.concatenate([glimpse.newest, glimpse.older, *moving], axis=-1)


def _compose_voxels(raw, glimpse: glimpse_lib.VoxelGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
    grid = config.voxels
    heights = grid.origin_m[2] + grid.voxel_size_m * jnp.arange(grid.shape[2], dtype=jnp.float32)
    trust = jnp.where(heights >= _OVER_ROAD_M - 1e-3, _TRUST, 0.0).reshape(1, 1, 1, -1)
    # The newest scan has the say; the older ones where it has none. (Added up, what moves is cancelled out.)
    evidence = glimpse.newest + (1.0 - jnp.abs(glimpse.newest)) * glimpse.older
    if glimpse.onward is not None:  # where it was may be hidden by it now, or not: that is left to be learned
        evidence = jnp.maximum(evidence, glimpse.onward)
    believed = trust * evidence
    raw = {scale: value.reshape(*value.shape[:3], -1, 2) for scale, value in raw.items()}
    own, result = mean(raw), {}
    for scale in SCALES:
        if scale > 1:
            believed = resample.max_pool2(believed)
        result[scale] = own[scale] + jnp.stack([jnp.zeros_like(believed), believed], axis=-1)
    return result


@dataclasses.dataclass(frozen=True)
class Part:
    """How the decoder of one head uses the memory.

    Attributes:
      plane: full size; the ground plan of the voxels, whose heights are channels.
      width: of the decoder.
      outputs: channels at a scale.
      shrink: sides of the deepest map are those of the plane over this, where a vector is unfolded to it.
      see: what the memory shows, as input channels.
      compose: what is drawn, put upon what the memory shows and upon the average frame.
      blurs: whether what is seen reaches what is drawn by a linear path too. What is uncertain of an image is best
        blurred, a linear function, and learned soonest as one. (Ranges are not: such a path moved every return a
        little.)
    """

    plane: Callable[[ModelConfig], tuple[int, int]]
    width: Callable[[ModelConfig], int]
    outputs: Callable[[ModelConfig, int], int]
    shrink: int
    see: Callable[[Any, ModelConfig], jax.Array]
    compose: Callable[[dict[int, jax.Array], Any, outputs.FirstGuess, ModelConfig], dict[int, jax.Array]]
    blurs: bool = False


PARTS = {
    "image": Part(lambda config: config.image_size, lambda config: config.guided_channels[0], lambda config, scale: 3,
                  tokens.IMAGE_SHRINK, _see_image, _compose_image, blurs=True),
    "range_view": Part(lambda config: (config.range_view.rows, config.range_view.columns),
                       lambda config: config.guided_channels[1], lambda config, scale: 5, tokens.RANGE_VIEW_SHRINK,
                       _see_ranges, _compose_ranges),
    "occupancy": Part(lambda config: config.voxels.shape[:2], lambda config: config.guided_channels[2],
                      lambda config, scale: 2 * config.voxels.shape[2] // scale, 8, _see_voxels, _compose_voxels),
}
