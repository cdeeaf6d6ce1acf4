"""Convolutions whose gradients are fast on a CPU, exact to float32 rounding.

XLA's CPU backend runs a 2D convolution at the speed of a matrix product, but the gradient with respect to the kernel is
a convolution whose window is the whole image, and 3D convolutions with few channels are about ten times slower than
need be. Here the kernel gradient is a matrix product with the shifted copies of all taps, accumulated over chunks of a
few megabytes (or XLA's own, where there is little to do); the input gradient is an ordinary convolution with the
flipped kernel; and a 3D convolution folds blocks of voxels along its last axis into channels, so that a banded kernel
and a 2D convolution do the work. A layer of a few pixels and many channels is one matrix product, 3x3 kernels of many
channels have fewer products (conv_winograd.py).

`muvo_jax.ops.conv` is the public face; nothing here checks its arguments. Reverse-mode differentiation only.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from muvo_jax.ops import chunks, conv_winograd, precision

Pairs = tuple[tuple[int, int], ...]

_CHUNK_BYTES = 1 << 22  # what one product reads, the shifted copies included: the best of 1 to 8 MiB for most layers
_LITTLE_WORK = 5e8  # floating-point operations of a kernel gradient below which XLA's own one is at least as fast
# A layer of so few pixels a sample and so many weights a tap is faster as a matrix product: 17 times at one pixel of
# 512 channels, with gradients (experiments/speed/convolutions.md); at 64 pixels of 128 channels it no longer is.
_FEW_PIXELS = 8
_MANY_WEIGHTS = 1 << 14
_FOLDED_WIDTH = 16  # output channels of a folded block below which the matrix product starves
# Output channels that need no block: what a band multiplies by zero is saved, for a copy of x of three times its size
# instead of twice.
_WIDE_ENOUGH = 64


def plain(x, kernel, stride: tuple[int, ...], padding: Pairs, kernel_dilation: tuple[int, ...] | None = None):
    """XLA's convolution of channels-last `x` [N, *S, C] with `kernel` [*K, C, O]."""
    space = "XYZ"[: kernel.ndim - 2]
    return lax.conv_general_dilated(x, kernel, stride, padding, rhs_dilation=kernel_dilation,
                                    dimension_numbers=(f"N{space}C", f"{space}IO", f"N{space}C"),
                                    precision=precision.PRODUCTS)


def dilated(x, kernel, stride: Sequence[int], padding: Sequence[int], outs: Sequence[int]):
    """A transposed convolution to `outs` pixels by definition: zeros between the inputs, then the flipped kernel."""
    rank = len(stride)
    edges = [(k - 1 - p, o - ((n - 1) * s + 1) + p)
             for n, k, s, p, o in zip(x.shape[1:-1], kernel.shape[:rank], stride, padding, outs, strict=True)]
    space = "XYZ"[:rank]
    return lax.conv_general_dilated(x, jnp.flip(kernel, tuple(range(rank))), (1,) * rank, edges, lhs_dilation=stride,
                                    dimension_numbers=(f"N{space}C", f"{space}IO", f"N{space}C"),
                                    precision=precision.PRODUCTS)


def _xla_gradient_is_fast(kernel, gradient) -> bool:
    """Whether XLA's own kernel gradient beats ours (measured: where there is little to do)."""
    return 2 * gradient.size // kernel.shape[-1] * kernel.size < _LITTLE_WORK


def dense(x, kernel, padding: Pairs):
    """Stride-1 convolution in two or three dimensions: x [N, *S, C], kernel [*K, C, O] -> [N, *S', O]."""
    if kernel.ndim == 5:
        return _folded(x, kernel, padding)
    if _is_small(x, kernel, (1, 1), padding):
        return _of_patches(x, kernel, (1, 1), padding)
    if conv_winograd.pays(x, kernel, padding):
        return conv_winograd.dense(x, kernel, padding)
    return all_products(x, kernel, padding)


def all_products(x, kernel, padding: Pairs):
    """Stride-1 convolution in two dimensions with every product that its definition has."""
    return _dense_2d(x, kernel, padding, (1, 1))


def strided(x, kernel, stride: tuple[int, ...], padding: Pairs):
    """Convolution with a stride, in two or three dimensions."""
    if kernel.ndim == 5:
        return _strided_by_phases(x, kernel, stride, padding)
    if _is_small(x, kernel, stride, padding):
        return _of_patches(x, kernel, stride, padding)
    return _strided_2d(x, kernel, stride, padding)


def _outputs(x, kernel, stride: tuple[int, ...], padding: Pairs) -> list[int]:
    """The spatial sizes of what a convolution returns."""
    return [(n + low + high - taps) // step + 1 for n, (low, high), taps, step in zip(
        x.shape[1:-1], padding, kernel.shape[:-2], stride, strict=True)]


def _is_small(x, kernel, stride: tuple[int, ...], padding: Pairs) -> bool:
    few = math.prod(_outputs(x, kernel, stride, padding)) <= _FEW_PIXELS
    return few and math.prod(kernel.shape[-2:]) >= _MANY_WEIGHTS


def _of_patches(x, kernel, stride: tuple[int, ...], padding: Pairs):
    """A 2D convolution as one product of all outputs' patches with the taps that see more than padding."""
    outs = _outputs(x, kernel, stride, padding)
    used = []
    for n, taps, out, step, (low, _) in zip(x.shape[1:-1], kernel.shape[:2], outs, stride, padding, strict=True):
        seen = [tap for tap in range(taps) if any(0 <= place * step + tap - low < n for place in range(out))]
        used.append(range(min(seen, default=0), max(seen, default=0) + 1))
    x = lax.pad(x, jnp.zeros((), x.dtype), ((0, 0, 0), *((low, high, 0) for low, high in padding), (0, 0, 0)))
    cut = lambda row, column: lax.slice(
        x, (0, row, column, 0), (x.shape[0], row + (outs[0] - 1) * stride[0] + 1,
                                 column + (outs[1] - 1) * stride[1] + 1, x.shape[-1]), (1, *stride, 1))
    patches = jnp.concatenate([cut(row, column) for row in used[0] for column in used[1]], axis=-1)
    rows, columns = (slice(taps.start, taps.stop) for taps in used)
    taps = kernel[rows, columns].reshape(patches.shape[-1], kernel.shape[-1])
    return jnp.einsum("nhwi,io->nhwo", patches, taps, precision=precision.PRODUCTS)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _dense_2d(x, kernel, padding: Pairs, dilation: tuple[int, int]):
    return plain(x, kernel, (1, 1), padding, dilation)


def _dense_2d_forward(x, kernel, padding, dilation):
    return plain(x, kernel, (1, 1), padding, dilation), (x, kernel)


def _dense_2d_backward(padding, dilation, residuals, gradient):
    x, kernel = residuals
    flipped = kernel[::-1, ::-1].swapaxes(2, 3)
    reach = [(taps - 1) * step for taps, step in zip(kernel.shape[:2], dilation, strict=True)]
    x_padding = tuple((r - low, r - high) for r, (low, high) in zip(reach, padding, strict=True))
    x_gradient = plain(gradient, flipped, (1, 1), x_padding, dilation)
    if _xla_gradient_is_fast(kernel, gradient):
        return x_gradient, _whole_kernel_gradient(x, gradient, kernel.shape[:2], (1, 1), padding, dilation)
    edges = ((0, 0, 0), *((low, high, 0) for low, high in padding), (0, 0, 0))
    padded = lax.pad(x, jnp.zeros((), x.dtype), edges)
    return x_gradient, _kernel_gradient(padded, gradient, kernel.shape[:2], dilation).astype(kernel.dtype)


_dense_2d.defvjp(_dense_2d_forward, _dense_2d_backward)


def _whole_kernel_gradient(x, gradient, taps: tuple[int, ...], stride: tuple[int, ...], padding: Pairs,
                           dilation: tuple[int, int]):
    """XLA's own kernel gradient [*taps, C, O]: a convolution over all of the image, channels its samples.

    Written with the axes in the order that XLA's CPU backend has fast code for. It brings others into this order in the
    outermost computation of a program alone: what differentiation gives runs ten times slower inside a loop, such as
    accumulation or the scan over frames of train.remat (docs/performance.md, "Kernel gradients in loops").
    """
    reach = [(k - 1) * d + (n - 1) * s + 1
             for k, d, n, s in zip(taps, dilation, gradient.shape[1:3], stride, strict=True)]
    pairs = [(low, r - n - low) for r, n, (low, _) in zip(reach, x.shape[1:3], padding, strict=True)]
    found = lax.conv_general_dilated(x.transpose(3, 1, 2, 0), gradient.transpose(1, 2, 0, 3), dilation, pairs,
                                     rhs_dilation=stride, dimension_numbers=("NHWC", "HWIO", "NHWC"),
                                     precision=precision.PRODUCTS)
    return found.transpose(1, 2, 0, 3)


def _kernel_gradient(x, gradient, taps: tuple[int, int], dilation: tuple[int, int]):
    """sum over n, i of x[n, i + tap * dilation]^T gradient[n, i], float32 [*taps, C, O]; x is already padded.

    The side with fewer channels is what is shifted: its copies for all taps, side by side, make a wide product of what
    would be narrow ones (twice as fast for 8 to 16 channels).
    """
    if x.shape[-1] <= gradient.shape[-1]:
        return _correlation(gradient, x, taps, dilation).swapaxes(2, 3)
    edges = [((k - 1) * d, (k - 1) * d, 0) for k, d in zip(taps, dilation, strict=True)]
    gradient = lax.pad(gradient, jnp.zeros((), gradient.dtype), ((0, 0, 0), *edges, (0, 0, 0)))
    return _correlation(x, gradient, taps, dilation)[::-1, ::-1]


def _correlation(still, shifted, taps: tuple[int, int], dilation: tuple[int, int]):
    """sum over n, i of still[n, i]^T shifted[n, i + tap * dilation], at least float32 [*taps, A, B].

    A chunk is some whole samples or some rows of one sample, at least one row.
    """
    batch, rows, columns, channels = still.shape
    width = math.prod(taps) * shifted.shape[-1]
    samples, chunk_rows = chunks.size(batch, rows, columns * (channels + width) * still.dtype.itemsize,
                                      _CHUNK_BYTES)
    row_chunks = -(-rows // chunk_rows)
    missing = ((0, 0), (0, row_chunks * chunk_rows - rows), (0, 0), (0, 0))
    still, shifted = (jnp.pad(a, missing) for a in (still, shifted))
    reach = [(k - 1) * d for k, d in zip(taps, dilation, strict=True)]

    def add_chunk(total, chunk):
        start = (chunk // row_chunks) * samples, (chunk % row_chunks) * chunk_rows, 0, 0
        inner = lax.dynamic_slice(still, start, (samples, chunk_rows, columns, channels))
        outer = lax.dynamic_slice(shifted, start, (samples, chunk_rows + reach[0], *shifted.shape[2:]))
        copies = [outer[:, row:row + chunk_rows, column:column + columns]
                  for row in range(0, reach[0] + 1, dilation[0]) for column in range(0, reach[1] + 1, dilation[1])]
        return total + lax.dot_general(inner, jnp.concatenate(copies, axis=-1), (((0, 1, 2), (0, 1, 2)), ((), ())),
                                       precision=precision.PRODUCTS, preferred_element_type=total.dtype), None

    summed = still.dtype if still.dtype.itemsize > 4 else jnp.float32
    zeros = jnp.tile(chunks.zeros(still, shifted, summed), (1, math.prod(taps)))
    total, _ = lax.scan(add_chunk, zeros, jnp.arange(batch // samples * row_chunks))
    return total.reshape(channels, *taps, -1).transpose(1, 2, 0, 3)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _folded(x, kernel, padding: Pairs):
    return _folded_by_2d(x, kernel, padding)


def _folded_forward(x, kernel, padding):
    return _folded_by_2d(x, kernel, padding), (x, kernel)


def _folded_backward(padding, residuals, gradient):
    # Folding again costs little; keeping the folded volume would cost up to three times the memory of x.
    _, pull_back = jax.vjp(functools.partial(_folded_by_2d, padding=padding), *residuals)
    return pull_back(gradient)


_folded.defvjp(_folded_forward, _folded_backward)


def _folded_by_2d(x, kernel, padding: Pairs):
    """3D convolution as a 2D one over (X, Y * blocks), a block being a few voxels along Z.

    The second spatial axis of the 2D convolution holds y and the block index, so a step in y is a dilation of `blocks`.
    """
    batch, x_size, y_size, z_size, _ = x.shape
    *_, z_taps, _, channels_out = kernel.shape
    z_low, z_high = padding[2]
    z_out = z_size + z_low + z_high - z_taps + 1
    block = _block(z_out, channels_out)
    blocks = -(-z_out // block)
    if blocks == 1:
        windows, band = x, _band(kernel, z_size, block, z_low)
    else:
        windows = _overlapping(x, block, blocks, block + z_taps - 1, z_low)
        band = _band(kernel, block + z_taps - 1, block, 0)
    flat = windows.reshape(batch, x_size, y_size * blocks, band.shape[2])
    y_low, y_high = padding[1]
    out = _dense_2d(flat, band, (padding[0], (y_low * blocks, y_high * blocks)), (1, blocks))
    out = out.reshape(batch, out.shape[1], out.shape[2] // blocks, blocks * block, channels_out)
    return out[:, :, :, :z_out]


def _block(z_out: int, channels_out: int) -> int:
    """Voxels per block: enough output channels for a matrix product, all of a short axis (then nothing is copied)."""
    block = 1 if channels_out >= _WIDE_ENOUGH else max(2, _FOLDED_WIDTH // channels_out)
    return z_out if z_out <= max(4, block) else block


def _band(kernel, inputs: int, outputs: int, offset: int):
    """Kernel [X, Y, T, C, O] -> [X, Y, inputs * C, outputs * O]: output o reads inputs o - offset ... + T - 1."""
    x_taps, y_taps, z_taps, channels_in, channels_out = kernel.shape
    tap = np.arange(inputs)[:, None] - np.arange(outputs)[None] + offset
    placement = (tap[None] == np.arange(z_taps)[:, None, None]).astype(np.float32)
    band = jnp.einsum("xytco,tij->xyicjo", kernel, jnp.asarray(placement, kernel.dtype),
                      precision=precision.PRODUCTS)
    return band.reshape(x_taps, y_taps, inputs * channels_in, outputs * channels_out)


def _overlapping(x, block: int, blocks: int, window: int, low: int):
    """[N, X, Y, Z, C] -> [N, X, Y, blocks, window * C]: window b covers z from b * block - low."""
    *outer, z_size, channels = x.shape
    pieces = -(-window // block)
    high = (blocks + pieces - 1) * block - z_size - low
    edges = ((0, 0, 0),) * 3 + ((low, high, 0), (0, 0, 0))
    rows = lax.pad(x, jnp.zeros((), x.dtype), edges).reshape(*outer, blocks + pieces - 1, block * channels)
    widths = [min(block, window - piece * block) * channels for piece in range(pieces)]
    return jnp.concatenate([rows[:, :, :, piece:piece + blocks, :width] for piece, width in enumerate(widths)], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _strided_2d(x, kernel, stride: tuple[int, ...], padding: Pairs):
    return plain(x, kernel, stride, padding)


def _strided_2d_forward(x, kernel, stride, padding):
    return plain(x, kernel, stride, padding), (x, kernel)


def _strided_2d_backward(stride, padding, residuals, gradient):
    x, kernel = residuals
    if not _xla_gradient_is_fast(kernel, gradient):
        _, pull_back = jax.vjp(functools.partial(_strided_by_phases, stride=stride, padding=padding), x, kernel)
        return pull_back(gradient)
    x_gradient = dilated(gradient, kernel.swapaxes(2, 3), stride, [low for low, _ in padding], x.shape[1:3])
    return x_gradient, _whole_kernel_gradient(x, gradient, kernel.shape[:2], stride, padding, (1, 1))


_strided_2d.defvjp(_strided_2d_forward, _strided_2d_backward)


def _strided_by_phases(x, kernel, stride: tuple[int, ...], padding: Pairs):
    """The same numbers as a stride-1 convolution of space-to-depth blocks, `stride` pixels a block."""
    *taps, channels_in, channels_out = kernel.shape
    rank = len(taps)
    sizes = x.shape[1:-1]
    blocks = [-(-k // s) for k, s in zip(taps, stride, strict=True)]
    outs = _outputs(x, kernel, stride, padding)
    # Rows and columns that no output reads are cut off by the negative padding.
    edges = [(low, (o + b - 1) * s - n - low, 0)
             for n, (low, _), o, b, s in zip(sizes, padding, outs, blocks, stride, strict=True)]
    x = lax.pad(x, jnp.zeros((), x.dtype), ((0, 0, 0), *edges, (0, 0, 0)))
    kernel_edges = [(0, b * s - k) for b, s, k in zip(blocks, stride, taps, strict=True)]
    kernel = jnp.pad(kernel, (*kernel_edges, (0, 0), (0, 0)))
    split = [side for pair in zip(blocks, stride, strict=True) for side in pair]
    order = (*range(0, 2 * rank, 2), *range(1, 2 * rank, 2), 2 * rank, 2 * rank + 1)
    kernel = kernel.reshape(*split, channels_in, channels_out).transpose(order)
    kernel = kernel.reshape(*blocks, math.prod(stride) * channels_in, channels_out)
    return dense(space_to_depth(x, stride), kernel, ((0, 0),) * rank)


def space_to_depth(x, block: tuple[int, ...]):
    """[N, s0 * b0, ..., C] -> [N, s0, ..., b0 * ... * C]."""
    batch, *sizes, channels = x.shape
    rank = len(block)
    split = [side for n, b in zip(sizes, block, strict=True) for side in (n // b, b)]
    order = (0, *range(1, 2 * rank, 2), *range(2, 2 * rank + 1, 2), 2 * rank + 1)
    return x.reshape(batch, *split, channels).transpose(order).reshape(batch, *split[::2], math.prod(block) * channels)


def depth_to_space(x, block: tuple[int, ...]):
    """[N, s0, ..., b0 * ... * C] -> [N, s0 * b0, ..., C], the inverse of `space_to_depth`."""
    batch, *sizes, channels = x.shape
    rank = len(block)
    order = (0, *(axis for i in range(rank) for axis in (1 + i, 1 + rank + i)), 2 * rank + 1)
    x = x.reshape(batch, *sizes, *block, channels // math.prod(block)).transpose(order)
    return x.reshape(batch, *(n * b for n, b in zip(sizes, block, strict=True)), x.shape[-1])
