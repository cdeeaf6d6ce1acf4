"""Occupancy terms: cross-entropy and the semantic and geometric scene-class affinity losses (SCAL, MonoScene).

SCAL is -log of precision, recall and specificity over the whole batch, so it cannot be a mean of per-device values.
With two classes all of it follows from four soft counts (probability mass that is truly or falsely occupied or empty):
these sums add over samples and devices, and the logarithms come last.

Differences from the reference: a ratio whose denominator is zero (no occupied, or no empty, voxel in the batch) is left
out; there the geometric loss of the reference raises.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.objectives import regression

_LOG_FLOOR = -100.0  # the reference clamps each logarithm there
_SMALLEST_RATIO = 1e-37


@flax.struct.dataclass
class OccupancySums:
    """Everything the occupancy terms need from one scale; float32 scalars that add over samples and devices.

    Attributes:
      cross_entropy: sum over counted voxels.
      voxels: how many voxels count.
      true_occupied, false_occupied: probability of "occupied", summed over occupied and over empty voxels.
      true_empty, false_empty: probability of "empty", summed over empty and over occupied voxels.
    """

    cross_entropy: types.Array
    voxels: types.Array
    true_occupied: types.Array
    false_occupied: types.Array
    true_empty: types.Array
    false_empty: types.Array

    def terms(self, name: str) -> dict[str, types.Array]:
        """The loss terms that follow from the sums of the whole batch; `name` ends in the scale."""
        scale = name.rsplit("_", 1)[1]
        return {f"occupancy_cross_entropy_{scale}": cross_entropy(self),
                f"occupancy_semantic_scal_{scale}": semantic_scal(self),
                f"occupancy_geometric_scal_{scale}": geometric_scal(self)}


def occupancy_sums(logits: types.Array, target: types.Array, unknown_is_empty: bool = False,
                   unknown_weight: float = 0.0) -> OccupancySums:
    """Sums over all voxels of a scale.

    Args:
      logits: float [..., 2], (empty, occupied).
      target: uint8 [...], 0 empty, 1 occupied, 255 unknown.
      unknown_is_empty: whether unknown voxels count as empty; otherwise they do not count.
      unknown_weight: what an unknown voxel counts, as empty, in the cross-entropy alone.
    """
    if unknown_is_empty:
        target = jnp.where(target == types.OCCUPANCY_UNKNOWN, jnp.uint8(types.OCCUPANCY_EMPTY), target)
    sums = _known_sums(logits, target)
    if not unknown_weight:
        return sums
    unknown = target == types.OCCUPANCY_UNKNOWN
    margin = logits[..., 1].astype(jnp.float32) - logits[..., 0].astype(jnp.float32)
    added = unknown_weight * jnp.where(unknown, jax.nn.softplus(margin), 0.0).sum()
    counted = unknown_weight * unknown.sum().astype(jnp.float32)
    return sums.replace(cross_entropy=sums.cross_entropy + added, voxels=sums.voxels + counted)


@jax.checkpoint  # the backward pass then keeps only the arguments, not a dozen arrays of their size
def _known_sums(logits: types.Array, target: types.Array) -> OccupancySums:
    logits = logits.astype(jnp.float32)
    margin = logits[..., 1] - logits[..., 0]
    occupied = target == types.OCCUPANCY_OCCUPIED
    empty = target == types.OCCUPANCY_EMPTY
    p_occupied, p_empty = jax.nn.sigmoid(margin), jax.nn.sigmoid(-margin)

    def over(mask, value):
        return jnp.where(mask, value, 0.0).sum()

    return OccupancySums(
        cross_entropy=over(occupied, jax.nn.softplus(-margin)) + over(empty, jax.nn.softplus(margin)),
        voxels=(occupied | empty).sum().astype(jnp.float32),
        true_occupied=over(occupied, p_occupied),
        false_occupied=over(empty, p_occupied),
        true_empty=over(empty, p_empty),
        false_empty=over(occupied, p_empty),
    )


def cross_entropy(sums: OccupancySums) -> types.Array:
    """Mean cross-entropy over the counted voxels, 0 where none counts."""
    return regression.MeanSums(sums.cross_entropy, sums.voxels).value()


def semantic_scal(sums: OccupancySums) -> types.Array:
    """The three ratios of each class that occurs, averaged over these classes."""
    occupied = _affinity(sums.true_occupied, sums.false_occupied, sums.true_empty, sums.false_empty)
    empty = _affinity(sums.true_empty, sums.false_empty, sums.true_occupied, sums.false_occupied)
    has_occupied = (sums.true_occupied + sums.false_empty > 0.0).astype(jnp.float32)
    has_empty = (sums.true_empty + sums.false_occupied > 0.0).astype(jnp.float32)
    return (has_occupied * occupied + has_empty * empty) / jnp.maximum(has_occupied + has_empty, 1.0)


def geometric_scal(sums: OccupancySums) -> types.Array:
    """The three ratios once, for "not empty"."""
    return _affinity(sums.true_occupied, sums.false_occupied, sums.true_empty, sums.false_empty)


def _affinity(true_positive, false_positive, true_negative, false_negative) -> types.Array:
    precision = _negative_log_ratio(true_positive, true_positive + false_positive)
    recall = _negative_log_ratio(true_positive, true_positive + false_negative)
    specificity = _negative_log_ratio(true_negative, true_negative + false_positive)
    return precision + recall + specificity


def _negative_log_ratio(numerator: types.Array, denominator: types.Array) -> types.Array:
    defined = denominator > 0.0
    # The unused branch of `where` must be finite too, or its gradient is NaN: both arguments are made safe first.
    ratio = numerator / jnp.where(defined, denominator, 1.0)
    representable = ratio > _SMALLEST_RATIO
    logarithm = jnp.where(representable, jnp.log(jnp.where(representable, ratio, 1.0)), _LOG_FLOOR)
    return jnp.where(defined, -logarithm, 0.0)
