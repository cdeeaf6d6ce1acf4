"""Perceptual distance: pictures compared by the maps that a frozen image network makes of them.

The reference's ResNet-18 is in evaluation mode when it is made, but its trainer's train() puts the BatchNorms back into
training mode; here it stays frozen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import types
from muvo_jax.model import camera
from muvo_jax.nn import norm
from muvo_jax.objectives import regression

_MEASURES: dict[str, Callable] = {"l1": jnp.abs, "l2": jnp.square}


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
        maps: Any = self.network.apply(self.variables, camera.normalise_image(255.0 * flat), norm.Mode())
        return maps

    def distance_sums(self, prediction: types.Array, target: types.Array) -> PerceptualSums:
        """Sums of squared differences of each level, for pictures [..., H, W, 3] in [0, 1]."""
        ours, theirs = self.maps(prediction.astype(jnp.float32)), jax.lax.stop_gradient(self.maps(target))
        return PerceptualSums(tuple(
            regression.MeanSums(jnp.square((a - b).astype(jnp.float32)).sum(), jnp.float32(a.size))
            for a, b in zip(ours, theirs, strict=True)))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerceptualSums:
    """A sum of means, one a level, none of them divided yet."""

    levels: tuple[regression.MeanSums, ...]

    def terms(self, name: str) -> dict[str, types.Array]:
        """The loss term that follows from the sums of the whole batch."""
        return {name: jnp.stack([level.value() for level in self.levels]).sum()}


def feature_distance(features: Sequence[types.Array], targets: Sequence[types.Array], *, norm: str,
                     style: bool) -> types.Array:
    """Sum over levels of the mean squared ("l2") or absolute ("l1") difference of maps, and of their Gram matrices."""
    measure, pairs = _MEASURES[norm], list(zip(features, targets, strict=True))
    total = jnp.stack([measure(ours - theirs).mean() for ours, theirs in pairs]).sum()
    if style:
        total += jnp.stack([jnp.square(_gram(ours) - _gram(theirs)).mean() for ours, theirs in pairs]).sum()
    return total


def _gram(maps: types.Array) -> types.Array:
    flat = maps.reshape(maps.shape[0], -1, maps.shape[-1])
    return jnp.einsum("npc,npd->ncd", flat, flat) / (flat.shape[1] * flat.shape[2])
