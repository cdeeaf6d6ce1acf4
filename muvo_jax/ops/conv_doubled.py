"""A convolution of what was doubled linearly; of volumes to few channels, on a CPU, without the doubled volume.

Of the eight voxels that a coarse one becomes, each reads a blend of the coarse one and its neighbours, so the doubling
and the convolution together are one convolution of the coarse volume to eight times the channels: wide products, and
no gradient of a doubling. At the border doubling repeats the outermost voxels where convolving pads zeros; what that
adds to the outermost voxels is taken off again, side by side.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from muvo_jax.ops import conv, conv_cpu, precision, resample

# Output channels up to which it pays (measured from 8 at 192x192x64 voxels, 16 at half the sides, to 64 at 24x24x8):
# with more, the kernel to eight times as many becomes the larger part of the work.
_FEW_CHANNELS = 16
# [phase, tap, neighbour]: fine voxel 2 j + phase sees, under each tap, so much of coarse voxels j - 1, j and j + 1.
_BLEND = np.array([[[0.75, 0.25, 0.0], [0.25, 0.75, 0.0], [0.0, 0.75, 0.25]],
                   [[0.25, 0.75, 0.0], [0.0, 0.75, 0.25], [0.0, 0.25, 0.75]]], np.float32)


def conv_doubled(x, kernel, *, implementation: conv.Implementation = "auto"):
    """conv(upsample_linear(x), kernel, padding=1), up to rounding.

    Args:
      x: float [N, *S, C], two or three spatial axes.
      kernel: float [3, 3, C, O] or [3, 3, 3, C, O], of the dtype of x.
      implementation: as in `conv.conv`.

    Returns:
      [N, *2S, O] of the dtype of x.

    Raises:
      ValueError: for ranks, channels, dtypes or kernels that do not fit.
    """
    rank = conv.check(x, kernel, implementation)
    if rank == 1 or kernel.shape[:rank] != (3,) * rank:
        raise ValueError(f"conv_doubled: got a kernel {kernel.shape}, expected [3, 3, C, O] or [3, 3, 3, C, O].")
    rounded = x.dtype.itemsize < 4  # a blended kernel would be rounded once more
    if rank == 2 or kernel.shape[-1] > _FEW_CHANNELS or rounded or implementation == "xla":
        return conv.conv(resample.upsample_linear(x), kernel, padding=1, implementation=implementation)
    return conv.formed(implementation, _coarse, _fine, x, kernel)


def _fine(x, kernel):
    return conv_cpu.plain(resample.upsample_linear(x), kernel, (1, 1, 1), ((1, 1),) * 3)


def _coarse(x, kernel):
    blend = jnp.asarray(_BLEND, kernel.dtype)
    wide = jnp.einsum("pia,qjb,rkc,ijkuv->abcupqrv", blend, blend, blend, kernel, precision=precision.PRODUCTS)
    wide = wide.reshape(3, 3, 3, kernel.shape[3], 8 * kernel.shape[4])
    repeated = jnp.pad(x, ((0, 0), *((1, 1),) * 3, (0, 0)), mode="edge")
    out = conv_cpu.depth_to_space(conv_cpu.dense(repeated, wide, ((0, 0),) * 3), (2, 2, 2))
    for axis in (1, 2, 3):
        for side, tap in ((0, 0), (-1, 2)):
            out = out.at[(slice(None),) * axis + (side,)].add(-_beyond(x, kernel, axis, side, tap))
    return out


def _beyond(x, kernel, axis: int, side: int, tap: int):
    """What the outermost voxels on one side read of those that repeat them beyond the border."""
    plane = resample.upsample_linear(lax.index_in_dim(x, side, axis, keepdims=False))
    for place, other in enumerate((other for other in (1, 2, 3) if other != axis), 1):
        # Axes before this one end in zeros by now, those after it still repeat themselves.
        edges = [(1, 1) if each == place else (0, 0) for each in range(4)]
        plane = jnp.pad(plane, edges, mode="constant" if other < axis else "edge")
    return conv_cpu.dense(plane, lax.index_in_dim(kernel, tap, axis - 1, keepdims=False), ((0, 0),) * 2)
