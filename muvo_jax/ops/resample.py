"""Changing the resolution of grids: linear sampling, the mean of 2x2 pixels, pooled voxels.

upsample_linear is torch's interpolation with align_corners=False and no antialiasing: output pixel i reads input
position (i + 1/2) * (input size / output size) - 1/2, clamped to the grid. resize_corners is that with
align_corners=True: corners stay where they are, pixel i reads i * (input size - 1) / (output size - 1).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax

from muvo_jax.types import OCCUPANCY_OCCUPIED, OCCUPANCY_UNKNOWN


def upsample_linear(x, factor: int = 2):
    """Enlarges every spatial axis by `factor`, linearly (torch: bilinear or trilinear, align_corners=False).

    Args:
      x: float [N, *S, C], any number of spatial axes.
      factor: a positive integer.

    Returns:
      [N, *(factor * S), C] of the dtype of x.

    Raises:
      ValueError: for a factor below 1.
    """
    if factor < 1:
        raise ValueError(f"upsample_linear: factor is {factor}, expected a positive integer.")
    return x if factor == 1 else _upsample(x, factor)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _upsample(x, factor: int):
    for axis in range(x.ndim - 2, 0, -1):
        x = _upsample_axis(x, factor, axis)
    return x


@_upsample.defjvp
def _upsample_derivative(factor, primals, tangents):
    """The map is linear. Its transpose as matrix products is two to three times faster than that of shifts on a CPU."""
    (x,), (tangent,) = primals, tangents
    shape = (x.shape[0], *(factor * size for size in x.shape[1:-1]), x.shape[-1])
    return _upsample(x, factor), jax.image.resize(tangent, shape, "linear")


def _upsample_axis(x, factor: int, axis: int):
    """Every output phase is a fixed blend of a pixel and its lower or upper neighbour; edges repeat themselves."""
    size = x.shape[axis]
    first, last = lax.slice_in_dim(x, 0, 1, axis=axis), lax.slice_in_dim(x, size - 1, size, axis=axis)
    below = jnp.concatenate([first, lax.slice_in_dim(x, 0, size - 1, axis=axis)], axis)
    above = jnp.concatenate([lax.slice_in_dim(x, 1, size, axis=axis), last], axis)
    phases = []
    for phase in range(factor):
        offset = (phase + 0.5) / factor - 0.5
        neighbour = below if offset < 0 else above
        phases.append(x if offset == 0 else (1 - abs(offset)) * x + abs(offset) * neighbour)
    shape = (*x.shape[:axis], size * factor, *x.shape[axis + 1:])
    return jnp.stack(phases, axis + 1).reshape(shape)


def max_pool2(x):
    """Largest of 2x2x2 voxels, [N, X, Y, Z] -> [N, X/2, Y/2, Z/2]; all sides even."""
    count, *sides = x.shape
    halves = [part for side in sides for part in (side // 2, 2)]
    return x.reshape(count, *halves).max(axis=(2, 4, 6))


def pool_occupancy(occupancy):
    """Occupancy [..., X, Y, Z] (0, 1, 255 unknown) at half the size, NumPy or JAX, in its dtype; all sides even.

    A coarse voxel is occupied if any of its eight is, and unknown only if all are.
    """
    *lead, x, y, z = occupancy.shape
    blocks = occupancy.reshape(*lead, x // 2, 2, y // 2, 2, z // 2, 2)
    within = (-5, -3, -1)
    occupied = (blocks == OCCUPANCY_OCCUPIED).any(axis=within)
    unknown = (blocks == OCCUPANCY_UNKNOWN).all(axis=within)
    dtype = occupancy.dtype
    return occupied.astype(dtype) * OCCUPANCY_OCCUPIED + (unknown & ~occupied).astype(dtype) * OCCUPANCY_UNKNOWN


def resize_corners(x, size: tuple[int, int]):
    """Resizes rows and columns linearly between fixed corners (torch: bilinear, align_corners=True).

    An axis of one pixel, before or after, has no two corners: one pixel is repeated, and the middle becomes one pixel
    (torch takes the first).

    Args:
      x: float [N, H, W, C].
      size: rows and columns of the result.

    Returns:
      [N, *size, C] of the dtype of x.
    """
    if x.shape[1:3] == tuple(size):
        return x
    cornered = [min(old, new) > 1 for old, new in zip(x.shape[1:3], size, strict=True)]
    scale = jnp.array([(new - 1) / (old - 1) if corners else new / old
                       for old, new, corners in zip(x.shape[1:3], size, cornered, strict=True)])
    # The library's rule is that of pixel centres: the shift brings the corners' centres together.
    shift = jnp.where(jnp.array(cornered), (1 - scale) / 2, 0.0)
    return jax.image.scale_and_translate(x, (x.shape[0], *size, x.shape[-1]), (1, 2), scale, shift, "linear",
                                         antialias=False)


def mean_pool2(x):
    """Mean of 2x2 pixels, float [..., H, W, C] -> [..., H/2, W/2, C].

    Raises:
      ValueError: where rows or columns are odd.
    """
    *outer, rows, columns, channels = x.shape
    if rows % 2 or columns % 2:
        raise ValueError(f"mean_pool2: got {rows}x{columns} pixels, expected even numbers of rows and columns.")
    return x.reshape(*outer, rows // 2, 2, columns // 2, 2, channels).mean((-4, -2))
