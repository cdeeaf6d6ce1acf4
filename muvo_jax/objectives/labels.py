"""Targets at the decoders' scales (paper section III-D): full size, half and quarter.

Images are averaged over 2x2 pixels. Range views are subsampled (index 2i), because the mean of a return and of a hole
means nothing. Occupancy is pooled: a coarse voxel is occupied if any that it covers is. Each scale comes from the one
before, as in the reference.
"""

from __future__ import annotations

import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.head import SCALES
from muvo_jax.ops import resample


def image_labels(image: types.ArrayLike) -> dict[int, types.Array]:
    """uint8 [..., H, W, 3] to {scale: float32 [..., H/scale, W/scale, 3]} in [0, 1]."""
    labels = {1: jnp.asarray(image).astype(jnp.float32) / 255.0}
    for scale in SCALES[1:]:
        labels[scale] = resample.mean_pool2(labels[scale // 2])
    return labels


def range_view_labels(range_view: types.ArrayLike) -> dict[int, types.Array]:
    """float32 [..., Hr, Wr, 4] in metres to {scale: float32 [..., Hr/scale, Wr/scale, 4]}, holes stay 0, 0, 0, -1."""
    return {scale: jnp.asarray(range_view)[..., ::scale, ::scale, :] for scale in SCALES}


def occupancy_labels(occupancy: types.ArrayLike, *, pooled: bool = True) -> dict[int, types.Array]:
    """uint8 [..., X, Y, Z] to {scale: uint8 [..., X/scale, Y/scale, Z/scale]}.

    A coarse voxel is occupied if any of its voxels is, and unknown (255) only if all are. Unless `pooled` it is its
    first voxel alone, as in the reference: at scale 4 of the paper's grid an obstacle at 0 to 2 m is then the road.
    """
    labels = {1: jnp.asarray(occupancy)}
    for scale in SCALES[1:]:
        finer = labels[scale // 2]
        labels[scale] = resample.pool_occupancy(finer) if pooled else finer[..., ::2, ::2, ::2]
    return labels


def map_labels(array: types.ArrayLike) -> dict[int, types.Array]:
    """A map of classes, distances or numbers [..., H, W] to {scale: [..., H/scale, W/scale]}."""
    return {scale: jnp.asarray(array)[..., ::scale, ::scale] for scale in SCALES}
