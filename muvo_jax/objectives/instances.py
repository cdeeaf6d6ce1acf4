"""Instances on the ground plan: where their centres are, and where each of their cells finds its own.

Targets follow from a map of instance numbers, at each scale from the subsampled map, with a bump that shrinks along. As
in the reference a bump is exp(-(distance / sigma)**2), and centres are whole cells, halves rounded to even.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.objectives import regression

MOST_INSTANCES = 64  # of a frame; higher numbers are left out
SIGMA_CELLS = 4.0


def targets(instances: types.Array, sigma_cells: float) -> tuple[types.Array, types.Array, types.Array]:
    """Targets of maps of instance numbers.

    Args:
      instances: integers [..., X, Y], 0 for none, up to MOST_INSTANCES.
      sigma_cells: of the bumps.

    Returns:
      float32 [..., X, Y, 1], the largest bump; float32 [..., X, Y, 2], cells along x and y to the own centre, 0 outside
      of instances; bool [..., X, Y], where there is an instance.
    """
    lead, size = instances.shape[:-2], instances.shape[-2:]
    flat = instances.reshape(-1, *size)
    centre, offset = jax.vmap(functools.partial(_frame_targets, sigma_cells=sigma_cells))(flat)
    inside = (flat > 0) & (flat <= MOST_INSTANCES)
    return (centre.reshape(*lead, *size, 1), offset.reshape(*lead, *size, 2), inside.reshape(*lead, *size))


def _frame_targets(instances: types.Array, sigma_cells: float) -> tuple[types.Array, types.Array]:
    place = jnp.stack(jnp.meshgrid(*(jnp.arange(side, dtype=jnp.float32) for side in instances.shape), indexing="ij"),
                      axis=-1)

    def add(carry, number):
        bumps, offsets = carry
        mask = instances == number
        count = mask.sum().astype(jnp.float32)
        middle = jnp.round(jnp.where(mask[..., None], place, 0.0).sum(axis=(0, 1)) / jnp.maximum(count, 1.0))
        away = middle[None, None] - place
        bump = jnp.where(count > 0, jnp.exp(-jnp.square(away).sum(axis=-1) / sigma_cells ** 2), 0.0)
        return (jnp.maximum(bumps, bump), jnp.where(mask[..., None], away, offsets)), None

    start = (jnp.zeros(instances.shape, jnp.float32), jnp.zeros((*instances.shape, 2), jnp.float32))
    (bumps, offsets), _ = jax.lax.scan(add, start, jnp.arange(1, MOST_INSTANCES + 1, dtype=instances.dtype))
    return bumps, offsets


def sums(centre: types.Array, offset: types.Array, instances: types.Array,
         scale: int) -> tuple[regression.MeanSums, regression.MeanSums]:
    """L2 of the centre map, to be averaged over cells, and L1 of the offsets, over the cells of instances.

    Args:
      centre, offset: float [..., X, Y, 1] and [..., X, Y, 2], predicted.
      instances: integers [..., X, Y].
      scale: by which both were halved, for the size of the bumps.
    """
    true_centre, true_offset, inside = targets(instances, SIGMA_CELLS / scale)
    return regression.l2_sums(centre, true_centre), regression.l1_sums(offset, true_offset, inside)
