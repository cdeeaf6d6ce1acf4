"""Nearest-neighbour distances between point sets, and the Chamfer distance built on them.

Memory is bounded: points are taken a chunk at a time, so the full distance table never exists. Distances are computed
from coordinate differences, not from the expanded square, which loses centimetres at 50 m in float32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax


def nearest_distance(points, targets, target_mask=None, *, chunk: int = 64):
    """Euclidean distance from each point to the nearest valid target.

    The gradient is that of the distance to the chosen target, and zero where the two coincide.

    Args:
      points: float [P, D], any unit.
      targets: float [Q, D], of the dtype of points.
      target_mask: bool [Q], false for targets to ignore, which may hold anything; None takes all.
      chunk: points handled at once; a chunk needs memory for chunk * Q distances.

    Returns:
      [P] in the unit of the points; +inf where no target is valid (mask those before a mean; their gradient is zero).

    Raises:
      ValueError: for shapes that do not fit.
    """
    dimensions = points.shape[-1]
    if targets.ndim != 2 or targets.shape[1] != dimensions or not targets.shape[0]:
        raise ValueError(f"nearest_distance: got points {points.shape} and targets {targets.shape}, expected [P, D] "
                         f"and [Q, D] with Q at least 1.")
    if target_mask is None:
        target_mask = jnp.ones(targets.shape[:1], bool)
    if target_mask.shape != targets.shape[:1]:
        raise ValueError(f"nearest_distance: target_mask is {target_mask.shape}, expected {targets.shape[:1]}.")
    targets = _without_masked(targets, target_mask)
    index = nearest_index(points, targets, target_mask, chunk=chunk)
    difference = points - targets[index]
    squared = jnp.sum(difference * difference, axis=-1)
    apart = squared > 0
    # sqrt has an infinite slope at 0: the inner `where` keeps it out of the gradient.
    distance = jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, jnp.ones_like(squared))), jnp.zeros_like(squared))
    return jnp.where(jnp.any(target_mask), distance, jnp.full_like(distance, jnp.inf))


def nearest_index(points, targets, target_mask, *, chunk: int = 64):
    """int32 [P]: which valid target is nearest to each point (the first of equals, 0 where none is valid)."""
    points, targets = lax.stop_gradient(points), lax.stop_gradient(_without_masked(targets, target_mask))
    count, dimensions = points.shape
    chunk = min(chunk, max(count, 1))
    chunks = -(-count // chunk)
    padded = jnp.pad(points, ((0, chunks * chunk - count), (0, 0))).reshape(chunks, chunk, dimensions)
    far = jnp.where(target_mask, jnp.zeros((), points.dtype), jnp.array(jnp.inf, points.dtype))
    number = jnp.arange(targets.shape[0], dtype=jnp.int32)

    def nearest(block):
        # Points lie along the last axis, and the smallest distance is found before its place: loops that a CPU's
        # vector units run, as those of argmin over the last axis do not.
        squared = far[:, None]
        for axis in range(dimensions):
            difference = targets[:, axis, None] - block[None, :, axis]
            squared = squared + difference * difference
        at_least = squared == squared.min(axis=0)[None]
        return jnp.where(at_least, number[:, None], targets.shape[0]).min(axis=0)

    return lax.map(nearest, padded).reshape(-1)[:count]


def chamfer_sums(points, targets, point_mask, target_mask, *, chunk: int = 64) -> tuple[jax.Array, ...]:
    """Both directions of the Chamfer distance, as sums and counts, so that sets can be pooled before a mean.

    Args:
      points, targets: float [P, D] and [Q, D].
      point_mask, target_mask: bool [P] and [Q], the valid ones; the others may hold anything.

    Returns:
      forward sum, forward count, backward sum, backward count: scalars of the dtype of points. Forward goes from points
      to targets. All are zero where either set has no valid point, which is an undefined distance.
    """
    points, targets = _without_masked(points, point_mask), _without_masked(targets, target_mask)
    defined = jnp.any(point_mask) & jnp.any(target_mask)
    sums = []
    for source, mask, other, other_mask in ((points, point_mask, targets, target_mask),
                                            (targets, target_mask, points, point_mask)):
        distance = nearest_distance(source, other, other_mask, chunk=chunk)
        counted = mask & defined
        sums.append(jnp.sum(jnp.where(counted, distance, jnp.zeros_like(distance))))
        sums.append(jnp.sum(counted).astype(distance.dtype))
    return tuple(sums)


def _without_masked(rows, mask):
    """The same with 0 in masked rows: a NaN there would win every comparison, and 0 * NaN spoil the gradients."""
    return jnp.where(mask[:, None], rows, jnp.zeros((), rows.dtype))


def chamfer(points, targets, point_mask=None, target_mask=None, *, chunk: int = 64):
    """Half of the mean nearest distance from points to targets plus the same backwards; unsquared.

    Args:
      points, targets: float [P, D] and [Q, D].
      point_mask, target_mask: bool [P] and [Q]; None takes all.

    Returns:
      A scalar in the unit of the points; NaN where either set has no valid point (undefined: count it, do not average
      it). For a loss use `chamfer_sums`, whose gradient stays finite.
    """
    point_mask = jnp.ones(points.shape[:1], bool) if point_mask is None else point_mask
    target_mask = jnp.ones(targets.shape[:1], bool) if target_mask is None else target_mask
    forward, forward_count, backward, backward_count = chamfer_sums(points, targets, point_mask, target_mask,
                                                                    chunk=chunk)
    return 0.5 * (forward / forward_count + backward / backward_count)
