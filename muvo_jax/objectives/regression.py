"""Regression terms as (sum, count), so that a batch spread over devices has one mean, not a mean of means."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax import types


@flax.struct.dataclass
class MeanSums:
    """A mean that is not divided yet; both fields are float32 scalars and add over samples and devices."""

    total: types.Array
    count: types.Array

    def value(self) -> types.Array:
        """The mean, 0 where nothing was counted (nothing to learn from is no loss; it must not be NaN)."""
        return self.total / jnp.maximum(self.count, 1.0)

    def terms(self, name: str) -> dict[str, types.Array]:
        """The loss terms that follow from the sums of the whole batch: this one mean."""
        return {name: self.value()}


def l1_sums(prediction: types.Array, target: types.Array, mask: types.Array | None = None) -> MeanSums:
    """Absolute error summed over channels, to be averaged over every other axis.

    Args:
      prediction, target: float [..., C].
      mask: bool [...], true where the error counts; None counts everything.
    """
    error = jnp.abs(prediction.astype(jnp.float32) - target.astype(jnp.float32))
    return _masked_sums(error.sum(axis=-1), mask)


def l2_sums(prediction: types.Array, target: types.Array, mask: types.Array | None = None) -> MeanSums:
    """Squared error summed over channels, to be averaged over every other axis; arguments as `l1_sums`."""
    error = jnp.square(prediction.astype(jnp.float32) - target.astype(jnp.float32))
    return _masked_sums(error.sum(axis=-1), mask)


def binary_cross_entropy_sums(logits: types.Array, target: types.Array) -> MeanSums:
    """-log of the probability sigmoid(+-logit) of what is the case; logits float [...], target bool [...]."""
    return _masked_sums(jax.nn.softplus(jnp.where(target, -1.0, 1.0) * logits.astype(jnp.float32)), None)


def _masked_sums(error: types.Array, mask: types.Array | None) -> MeanSums:
    if mask is None:
        return MeanSums(error.sum(), jnp.float32(error.size))
    return MeanSums(jnp.where(mask, error, 0.0).sum(), mask.sum().astype(jnp.float32))


def range_view_sums(prediction: types.Array, target: types.Array, *, scale_m: float,
                    mask_holes: bool) -> tuple[MeanSums, MeanSums]:
    """The two terms of a range view in units of `scale_m`: L2 of x, y, z and L1 of the range.

    The range is learned everywhere (-1 m where nothing returned), so that the model knows where nothing returns. The
    points are learned where the target has a return; the reference also pulls the points of holes to the origin.

    Args:
      prediction, target: float32 [..., Hr, Wr, 4], metres.
      scale_m: metres per unit.
      mask_holes: whether x, y, z count only where the target range is positive.
    """
    prediction = prediction.astype(jnp.float32) / scale_m
    target = target / scale_m
    returned = target[..., 3] > 0.0 if mask_holes else None
    return (l2_sums(prediction[..., :3], target[..., :3], returned), l1_sums(prediction[..., 3:], target[..., 3:]))
