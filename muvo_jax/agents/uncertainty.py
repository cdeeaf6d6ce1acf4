"""How far imagined futures can be trusted: scores of N branches against what happened, and a discount for agents.

All are pure functions of arrays; N is the axis of branches.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import limits
from muvo_jax.limits import COUNT, SHARE
from muvo_jax.types import OCCUPANCY_OCCUPIED, OCCUPANCY_UNKNOWN, Array

_TINY = 1e-12


@dataclasses.dataclass(frozen=True)
class Caution:
    """How an agent takes what is imagined for it; by default as it comes.

    Attributes:
      trust: what a reward earned after 1, 2, ... imagined steps counts, each in [0, 1], such as `trust` says; later
        ones count as the last. Where it is empty all count in full.
      branches: latents drawn in each step. The car goes on in the first; obstacles are sought in all of them.
      quantile: of the branches' probabilities that a voxel is occupied, which then is taken as its probability; 1 is
        the most pessimistic branch, 0.5 their median.
    """

    trust: tuple[float, ...] = ()
    branches: Annotated[int, COUNT] = 1
    quantile: Annotated[float, SHARE] = 1.0

    def __post_init__(self):
        limits.check(self)
        object.__setattr__(self, "trust", tuple(float(share) for share in self.trust))
        if not all(0.0 <= share <= 1.0 for share in self.trust):
            raise ValueError(f"Caution: trust is {list(self.trust)}; expected a share in [0, 1] for each step, as "
                             f"python -m muvo_jax.evaluate RUN --uncertainty=8 measures.")

    def believed(self, reward: Array, step: Array) -> Array:
        """What rewards [..., *L] earned by the step-th imagined step count, step int32 [*L] from 1 on."""
        if not self.trust:
            return reward
        share = jnp.asarray(np.array(self.trust, np.float32))
        return reward * jnp.broadcast_to(share[jnp.clip(step - 1, 0, share.size - 1)], reward.shape)

    def feared(self, logits: Array) -> Array:
        """Occupancy logits [..., 2] whose log-odds are the quantile of those of the branches [N, ..., 2]."""
        if logits.shape[0] == 1:
            return logits[0]
        occupied = jnp.quantile((logits[..., 1] - logits[..., 0]).astype(jnp.float32), self.quantile, axis=0)
        return jnp.stack([jnp.zeros_like(occupied), occupied], axis=-1)


@flax.struct.dataclass
class Reliability:
    """A reliability curve over K bins of equal width.

    Attributes:
      confidence: float32 [K], mean predicted probability in a bin; NaN where it is empty.
      frequency: float32 [K], share of its voxels that were occupied; NaN where it is empty.
      count: int32 [K], voxels.
    """

    confidence: Array
    frequency: Array
    count: Array

    @property
    def calibration_error(self) -> Array:
        """Expected calibration error: the mean of |confidence - frequency|, weighted by count."""
        gap = jnp.where(self.count > 0, jnp.abs(self.confidence - self.frequency), 0.0)
        weight = self.count.astype(jnp.float32)
        return (gap * weight).sum() / jnp.maximum(weight.sum(), 1.0)


def branch_probability(logits: Array, axis: int = 1) -> Array:
    """Probability of being occupied from logits [B, N, ..., 2]: the mean over branches of each one's softmax."""
    return jax.nn.sigmoid(logits[..., 1] - logits[..., 0]).mean(axis=axis)


def brier_score(probability: Array, occupancy: Array) -> Array:
    """Mean of (p - occupied)^2 over the voxels that are known; NaN where none is. Shapes agree."""
    known = occupancy != OCCUPANCY_UNKNOWN
    square = (probability - (occupancy == OCCUPANCY_OCCUPIED)) ** 2
    return jnp.where(known, square, 0.0).sum() / known.sum()


def reliability(probability: Array, occupancy: Array, bins: int = 10) -> Reliability:
    """How often voxels were occupied that were said to be so with a probability; unknown voxels are left out."""
    known, occupied = occupancy != OCCUPANCY_UNKNOWN, occupancy == OCCUPANCY_OCCUPIED
    index = jnp.clip((probability * bins).astype(jnp.int32), 0, bins - 1)

    def sums(number):  # one reduction for each bin: float32 bins that are added to one by one stop at 2^24
        here = known & (index == number)
        return jnp.where(here, probability, 0.0).sum(), (here & occupied).sum(), here.sum()

    confidence, frequency, count = jax.lax.map(sums, jnp.arange(bins))
    return Reliability(confidence / count, frequency / count, count)


def crps(samples: Array, truth: Array, axis: int = 0) -> Array:
    """Continuous ranked probability score, in the unit of the values: E|X - y| - E|X - X'| / 2, the fair estimate.

    Args:
      samples: [N, ...] with at least two branches on `axis`.
      truth: [...].

    Returns:
      [...]; 0 is perfect. Of pairs, X and X' are different branches (Ferro 2014), so that N does not matter.

    Raises:
      ValueError: for fewer than two branches.
    """
    samples = jnp.moveaxis(samples, axis, 0)
    branches = samples.shape[0]
    if branches < 2:
        raise ValueError(f"crps: got {branches} branch, expected at least 2.")
    ordered = jnp.sort(samples, axis=0)
    # The sum over pairs of |x_i - x_j| is 2 sum_i (2 i - N + 1) x_(i), i counted from 0.
    rank = (2.0 * jnp.arange(branches) - branches + 1.0).reshape(-1, *(1,) * truth.ndim)
    spread = (rank * ordered).sum(axis=0) / (branches * (branches - 1))
    return jnp.abs(samples - truth[None]).mean(axis=0) - spread


def best_of(errors: Array, axis: int = 1) -> tuple[Array, Array]:
    """(error of the best branch, mean error of all): their gap says what the choice among N futures is worth."""
    return errors.min(axis=axis), errors.mean(axis=axis)


def trust(features: Array) -> Array:
    """How much of what is imagined still follows from the start: 1 - variance among branches / variance of everything.

    By the law of total variance 1 where all branches of a start agree, 0 where they differ as much as the futures of
    different starts do. Summed over channels, never rising along the horizon.

    Args:
      features: [B, N, H, F] of B > 1 starts and N > 1 branches.

    Returns:
      float32 [B, H] in [0, 1].

    Raises:
      ValueError: for one start or one branch.
    """
    if features.shape[0] < 2 or features.shape[1] < 2:
        raise ValueError(f"trust: got features {list(features.shape)}, expected at least 2 starts and 2 branches.")
    among = features.var(axis=1, ddof=1).sum(axis=-1)
    total = features.var(axis=(0, 1)).sum(axis=-1)
    share = jnp.clip(1.0 - among / jnp.maximum(total, _TINY)[None], 0.0, 1.0)
    return jax.lax.cummin(share, axis=1)


def trust_discount(trusted: Array) -> Array:
    """The discount of each step [..., H] whose running product is `trusted`: multiply an agent's discount by it."""
    before = jnp.concatenate([jnp.ones_like(trusted[..., :1]), trusted[..., :-1]], axis=-1)
    return jnp.where(before > 0, trusted / jnp.maximum(before, _TINY), 0.0)


def trust_horizon(trusted: Array, threshold: float = 0.5) -> Array:
    """Steps [...] that stay at or above `threshold`."""
    return (trusted >= threshold).sum(axis=-1)


def action_sensitivity(predicted: tuple[Array, Array], true: tuple[Array, Array]) -> dict[str, Array]:
    """Whether other actions change the prediction as they change the world.

    Args:
      predicted: what the model imagined under two plans, with the same noise (`imagine(..., same_noise=True)`).
      true: what the simulator showed under the same two plans.

    Returns:
      "gain": regression of the predicted on the true response, 1 is right, 0 means that actions are ignored;
      "correlation" of the two responses (NaN where one of them is 0).
    """
    response, truth = predicted[1] - predicted[0], true[1] - true[0]
    product = (response * truth).sum()
    energy, true_energy = (response**2).sum(), (truth**2).sum()
    return {"gain": product / true_energy, "correlation": product / jnp.sqrt(energy * true_energy)}
