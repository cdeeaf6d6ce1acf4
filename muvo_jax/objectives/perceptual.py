"""Perceptual distance: pictures compared by the maps that a frozen image network makes of them.

The reference's ResNet-18 is in evaluation mode when it is made, but its trainer's train() puts the BatchNorms back into
training mode; here it stays frozen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import types
from muvo_jax.model import encoders
from muvo_jax.nn import norm
from muvo_jax.objectives import regression


@dataclasses.dataclass(frozen=True)
class FrozenEncoder:
    """An image network and its weights, which are never trained.

    Attributes:
      network: pictures [N, H, W, 3], normalised as ImageNet's, and a norm.Mode -> maps [N, h, w, C] of several levels.
      variables: {"params": ..., "batch_stats": ...}.
      source: where the weights come from, for people.
    """

    network: linen.Module
    variables: types.Variables
    source: str

    def maps(self, pictures: types.Array) -> list[types.Array]:
        """Maps of pictures float32 [..., H, W, 3] in [0, 1], leading axes merged."""
        flat = pictures.reshape(-1, *pictures.shape[-3:])
        maps: Any = self.network.apply(self.variables, encoders.normalise_image(255.0 * flat), norm.Mode())
        return maps

    def distance_sums(self, prediction: types.Array, target: types.Array) -> PerceptualSums:
        """Sums of squared differences of each level, for pictures [..., H, W, 3] in [0, 1]."""
        ours, theirs = self.maps(prediction.astype(jnp.float32)), jax.lax.stop_gradient(self.maps(target))
        return distance_sums(ours, theirs)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerceptualSums:
    """A sum of means, one a level, none of them divided yet."""

    levels: tuple[regression.MeanSums, ...]

    def terms(self, name: str) -> dict[str, types.Array]:
        """The loss term that follows from the sums of the whole batch."""
        return {name: jnp.stack([level.value() for level in self.levels]).sum()}


def distance_sums(maps: Sequence[types.Array], targets: Sequence[types.Array]) -> PerceptualSums:
    """Sums of squared differences of the maps of each level, [N, h, w, C]."""
    return PerceptualSums(tuple(
        regression.MeanSums(jnp.square((ours - theirs).astype(jnp.float32)).sum(), jnp.float32(ours.size))
        for ours, theirs in zip(maps, targets, strict=True)))
