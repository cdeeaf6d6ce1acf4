"""Decoders that see the memory: a U-net whose deepest map is the latent's (config.LastSeen).

On the way down it reads the memory as it looks from the state's vantage, on the way up it draws what must be added to
that, where it covers anything, and to the average training frame elsewhere. So a fresh model predicts the moved memory
and learns the rest: to fill what was hidden, to move what moves, to blur what is uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import LastSeen, ModelConfig, as_kind
from muvo_jax.model import common, memory, outputs, tokens
from muvo_jax.nn import layers
from muvo_jax.ops import conv_cpu, resample
from muvo_jax.types import RANGE_NO_RETURN_M

SCALES = (1, 2, 4)
_SHRINK = {"image": tokens.IMAGE_SHRINK, "range_view": tokens.RANGE_VIEW_SHRINK}
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
      head: image, range_view or occupancy.
      plane: full size; the ground plan of the voxels, whose heights are channels.
      outputs: scale -> channels.
    """

    config: ModelConfig
    head: str
    plane: tuple[int, int]
    outputs: tuple[tuple[int, int], ...]

    @linen.compact
    def __call__(self, features: jax.Array, seen: jax.Array, numbers: jax.Array) -> dict[int, jax.Array]:
        config, compute = self.config, common.compute(self.config)
        widths = as_kind(config.first_guess, LastSeen).guided_channels
        width = widths[("image", "range_view", "occupancy").index(self.head)]
        dense = lambda name, x, features: layers.Dense(features, compute, name=name)(x)
        conv = lambda name, x, features: _activation(layers.Conv(features, (3, 3), compute, name=name)(x))
        # Doubling and halving by dense layers on 2x2 pixels: whole matrix products, on any backend.
        grow = lambda name, x, features: _activation(conv_cpu.depth_to_space(dense(name, x, 4 * features), (2, 2)))
        down = {1: seen.astype(compute.dtype)}
        for scale in (2, 4, 8):
            blocks = conv_cpu.space_to_depth(down[scale // 2], (2, 2))
            down[scale] = conv(f"see_{scale}", blocks, width // _WIDTHS[scale])
        x = self._latent(features, width)
        while x.shape[1] < self.plane[0] // 8:
            x = grow(f"pre_{x.shape[1]}", x, width)
        x = conv("join", x + down[8] + layers.spread(dense("numbers", numbers, width), 4), width)
        out, channels = {}, dict(self.outputs)
        for scale in (4, 2):
            x = grow(f"grow_{scale}", x, width // _WIDTHS[scale])
            x = conv(f"draw_{scale}", jnp.concatenate([x, down[scale]], axis=-1), width // _WIDTHS[scale])
            out[scale] = dense(f"head_{scale}", x, channels[scale]).astype(jnp.float32)
        # Full size is drawn in blocks of 2x2 pixels: a quarter of the places, with channels enough for a fast product.
        seen = conv_cpu.space_to_depth(down[1], (2, 2))
        x = conv("draw_1", jnp.concatenate([x, seen], axis=-1), width // _WIDTHS[2])
        blocks = dense("head_1", x, 4 * channels[1])
        if self.head == "image":
            # What is uncertain is best blurred, a linear function of what is seen, and learned soonest as one. (Ranges
            # are not: a linear path moved every return a little, and Chamfer from 0.65 m to 0.73 m.)
            blocks = blocks + layers.Conv(4 * channels[1], (3, 3), compute, name="blur")(seen)
        return {1: conv_cpu.depth_to_space(blocks.astype(jnp.float32), (2, 2)), **out}

    def _latent(self, features: jax.Array, width: int) -> jax.Array:
        """The latent as a map of the plane: the head's tokens, or a vector unfolded."""
        compute = common.compute(self.config)
        if features.ndim == 2:
            shrink = _SHRINK.get(self.head, 8)
            size = tuple(math.ceil(side / shrink) for side in self.plane)
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
    def __call__(self, features: jax.Array, glimpse: memory.Glimpse, numbers: jax.Array,
                 mean: outputs.FirstGuess) -> dict[int, jax.Array]:
        config = self.config
        plane = {"image": config.image_size, "range_view": (config.range_view.rows, config.range_view.columns),
                 "occupancy": config.voxels.shape[:2]}[self.head]
        outputs_of = {"image": lambda scale: 3, "range_view": lambda scale: 5,
                      "occupancy": lambda scale: 2 * config.voxels.shape[2] // scale}[self.head]
        decoder = GuidedDecoder(config, self.head, plane, tuple((scale, outputs_of(scale)) for scale in SCALES),
                                name="decoder")
        see, compose = _PARTS[self.head]
        raw = decoder(features, see(glimpse, config), numbers)
        return compose(raw, glimpse, mean, config)


def _see_image(glimpse: memory.ImageGlimpse, config: ModelConfig) -> jax.Array:
    del config
    return jnp.concatenate([glimpse.image - 0.5 * glimpse.covered, glimpse.covered], axis=-1)


def _compose_image(raw, glimpse: memory.ImageGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
    del config
    drawn, average = raw, mean(jax.tree.map(jnp.zeros_like, raw))
    moved, covered, result = glimpse.image, glimpse.covered, {}
    for scale in (1, 2, 4):
        if scale > 1:
            moved, covered = resample.mean_pool2(moved), resample.mean_pool2(covered)
        result[scale] = moved + (1.0 - covered) * average[scale] + drawn[scale]
    return result


def _nearness(range_m: jax.Array) -> jax.Array:
    return jnp.where(range_m > 0.0, _NEAR_M / (_NEAR_M + jnp.maximum(range_m, 0.0)), 0.0)


def _see_ranges(glimpse: memory.RangeGlimpse, config: ModelConfig) -> jax.Array:
    scale_m = config.range_scale_m
    given = [glimpse.filled_m, glimpse.newest_m, glimpse.still_m]
    channels = [*map(_nearness, given), *(jnp.maximum(value, 0.0) / scale_m for value in (given[0], given[2])),
                *((value > 0.0).astype(jnp.float32) for value in (glimpse.moved_m, *given)), glimpse.sky,
                glimpse.height_m / 5.0]
    return jnp.stack(channels, axis=-1)


def _compose_ranges(raw, glimpse: memory.RangeGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
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
        points = value[..., :3] + points
        result[scale] = jnp.concatenate([points, jnp.expand_dims(expected, -1)], axis=-1)
    return result


def _see_voxels(glimpse: memory.VoxelGlimpse, config: ModelConfig) -> jax.Array:
    del config
    return jnp.concatenate([glimpse.newest, glimpse.older], axis=-1)


def _compose_voxels(raw, glimpse: memory.VoxelGlimpse, mean, config: ModelConfig) -> dict[int, jax.Array]:
    grid = config.voxels
    heights = grid.origin_m[2] + grid.voxel_size_m * jnp.arange(grid.shape[2], dtype=jnp.float32)
    trust = jnp.where(heights >= _OVER_ROAD_M - 1e-3, _TRUST, 0.0).reshape(1, 1, 1, -1)
    # The newest scan has the say; the older ones where it has none. (Added up, what moves is cancelled out.)
    believed = trust * (glimpse.newest + (1.0 - jnp.abs(glimpse.newest)) * glimpse.older)
    raw = {scale: value.reshape(*value.shape[:3], -1, 2) for scale, value in raw.items()}
    own, result = mean(raw), {}
    for scale in (1, 2, 4):
        if scale > 1:
            believed = resample.max_pool2(believed)
        result[scale] = own[scale] + jnp.stack([jnp.zeros_like(believed), believed], axis=-1)
    return result


_PARTS: dict[str, tuple[Callable, Callable]] = {
    "image": (_see_image, _compose_image), "range_view": (_see_ranges, _compose_ranges),
    "occupancy": (_see_voxels, _compose_voxels)}
