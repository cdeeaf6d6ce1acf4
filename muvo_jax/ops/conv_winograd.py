"""3x3 convolutions with 16 products of channels for four pixels, where the definition has 36: Winograd's F(2x2, 3x3).

A tile of 2x2 outputs is the correlation of a patch of 4x4 inputs with the kernel. Both are transformed by sums of a few
of their pixels, multiplied pixel by pixel (16 matrix products over channels, for many tiles at once), and transformed
back (A. Lavin, S. Gray, "Fast Algorithms for Convolutional Neural Networks", 2016). The input gradient is such a
convolution itself; the kernel gradient goes the same way backwards. What the transforms cost in passes over memory
stays small where channels are many and a chunk of tiles stays in the cache. Errors are about those of the definition
in float32 (tests/ops/test_conv_winograd.py).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax

from muvo_jax.ops import chunks, precision

Pairs = tuple[tuple[int, int], ...]

_CHUNK_TILES = 512  # of one product: fewer read the kernel too often, more leave the cache
# Channels of input and output each, from which products outweigh the transforms: more with XLA's fusion emitters (its
# default, which commands switch off: training/host.py), whose code for the transforms is five times slower.
_FEWEST_CHANNELS, _FEWEST_WITH_EMITTERS = 128, 256
_WITHOUT_EMITTERS = "xla_cpu_use_fusion_emitters=false"
_LITTLE_WORK = 5e9  # floating-point operations below which a layer is not worth a second more of compiling


def pays(x, kernel, padding: Pairs) -> bool:
    """Whether a stride-1 convolution of x [N, H, W, C] with kernel [*K, C, O] is faster in this form (measured:
    experiments/speed/paper.md)."""
    without_emitters = _WITHOUT_EMITTERS in os.environ.get("XLA_FLAGS", "")
    fewest = _FEWEST_CHANNELS if without_emitters else _FEWEST_WITH_EMITTERS
    if kernel.shape[:-2] != (3, 3) or min(kernel.shape[-2:]) < fewest:
        return False
    rows, columns = _outputs(x, padding)
    work = 2.0 * x.shape[0] * rows * columns * kernel.size
    return jnp.dtype(x.dtype).itemsize >= 4 and work >= _LITTLE_WORK and min(rows, columns) > 1


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def dense(x, kernel, padding: Pairs):
    """Stride-1 convolution: x [N, H, W, C], kernel [3, 3, C, O] -> [N, H', W', O]. Reverse-mode derivatives only."""
    return _convolved(x, _kernel_tiles(kernel), padding, contracted=0)


def _forward(x, kernel, padding):
    return dense(x, kernel, padding), (x, kernel)


def _backward(padding, residuals, gradient):
    x, kernel = residuals
    tiles = _kernel_tiles(kernel)
    # A flipped kernel has the same tiles in another order.
    flipped = jnp.stack([jnp.stack([tiles[row, column] for column in _FLIPPED]) for row in _FLIPPED])
    back = tuple((2 - low, 2 - high) for low, high in padding)
    return _convolved(gradient, flipped, back, contracted=1), _kernel_gradient(x, gradient, padding)


dense.defvjp(_forward, _backward)

_FLIPPED = (3, 1, 2, 0)


def _outputs(x, padding: Pairs) -> list[int]:
    return [size + low + high - 2 for size, (low, high) in zip(x.shape[1:3], padding, strict=True)]


def _convolved(x, kernel_tiles, padding: Pairs, contracted: int):
    """Convolution with the tiles [4, 4, C, O] of a kernel, whose C (contracted = 0) or O (1) x's channels meet."""
    rows, columns = _outputs(x, padding)
    tiled = _Tiled(x, rows, columns, padding)

    def chunk(_, index):
        tiles = _on_both(_input_axis, tiled.inputs(index))
        products = lax.dot_general(tiles, kernel_tiles, (((5,), (2 + contracted,)), ((0, 1), (0, 1))),
                                   precision=precision.PRODUCTS)
        return None, _outputs_of(products)

    _, found = lax.scan(chunk, None, jnp.arange(tiled.count))
    found = found.reshape(x.shape[0], -1, *found.shape[-2:])
    return found[:, :rows, :columns]


def _kernel_gradient(x, gradient, padding: Pairs):
    """sum over n, i of x[n, i + tap]^T gradient[n, i] [3, 3, C, O]."""
    rows, columns = gradient.shape[1:3]
    tiled = _Tiled(x, rows, columns, padding)
    gradient = jnp.pad(gradient, ((0, 0), (0, tiled.rows_in_all - rows), (0, tiled.columns - columns), (0, 0)))

    def add_chunk(total, index):
        tiles = _on_both(_input_axis, tiled.inputs(index))
        gradients = _on_both(_gradient_axis, tiled.of(gradient, index, 0))
        return total + lax.dot_general(tiles, gradients, (((2, 3, 4), (2, 3, 4)), ((0, 1), (0, 1))),
                                       precision=precision.PRODUCTS), None

    zeros = jnp.broadcast_to(chunks.zeros(x, gradient, x.dtype), (4, 4, x.shape[-1], gradient.shape[-1]))
    total, _ = lax.scan(add_chunk, zeros, jnp.arange(tiled.count))
    return _taps(_taps(total).swapaxes(0, 1))


class _Tiled:
    """x, padded so that its outputs are whole chunks of tiles: some whole samples, or some rows of tiles of one."""

    def __init__(self, x, rows: int, columns: int, padding: Pairs):
        tile_rows, tile_columns = -(-rows // 2), -(-columns // 2)
        self.samples, self.tile_rows = chunks.size(x.shape[0], tile_rows, tile_columns, _CHUNK_TILES)
        self.row_chunks = -(-tile_rows // self.tile_rows)
        self.count = x.shape[0] // self.samples * self.row_chunks
        self.rows_in_all, self.columns = 2 * self.tile_rows * self.row_chunks, 2 * tile_columns
        edges = [(low, needed + 2 - low - size, 0) for needed, size, (low, _) in zip(
            (self.rows_in_all, self.columns), x.shape[1:3], padding, strict=True)]
        self.x = lax.pad(x, jnp.zeros((), x.dtype), ((0, 0, 0), *edges, (0, 0, 0)))

    def of(self, values, index, overlap: int):
        """A chunk of values [N, rows_in_all + overlap, ...], and so many rows of the next one."""
        start = (index // self.row_chunks) * self.samples, (index % self.row_chunks) * 2 * self.tile_rows, 0, 0
        return lax.dynamic_slice(values, start, (self.samples, 2 * self.tile_rows + overlap, *values.shape[2:]))

    def inputs(self, index):
        """What a chunk of outputs reads."""
        return self.of(self.x, index, 2)


def _on_both(along: Callable[[jax.Array, int], Sequence[jax.Array]], image):
    """The pixels [4, 4, N, rows, columns, C] of all transformed tiles of an image, along columns first."""
    return jnp.stack(along(jnp.stack(along(image, 1)), 3))


def _input_axis(image, axis: int) -> tuple[jax.Array, ...]:
    """B of F(2, 3): tile i reads pixels 2i to 2i + 3."""
    reach = image.shape[axis] - 3
    first, second, third, fourth = (lax.slice_in_dim(image, place, place + reach, 2, axis) for place in range(4))
    return first - third, second + third, third - second, second - fourth


def _gradient_axis(image, axis: int) -> tuple[jax.Array, ...]:
    """A of F(2, 3): tile i has pixels 2i and 2i + 1."""
    even, odd = (lax.slice_in_dim(image, place, image.shape[axis], 2, axis) for place in range(2))
    return even, even + odd, even - odd, -odd


def _kernel_tiles(kernel):
    """G of F(2, 3) along both axes: [3, 3, C, O] -> [4, 4, C, O], the first axis that of columns."""
    def along(taps):
        outer, middle = 0.5 * (taps[0] + taps[2]), 0.5 * taps[1]
        return jnp.stack([taps[0], outer + middle, outer - middle, taps[2]])

    return along(along(kernel).swapaxes(0, 1))


def _taps(tiles):
    """G backwards along the first axis: the gradients of three taps of those of four tiles."""
    both, apart = 0.5 * (tiles[1] + tiles[2]), 0.5 * (tiles[1] - tiles[2])
    return jnp.stack([tiles[0] + both, apart, both + tiles[3]])


def _outputs_of(products):
    """A backwards along both axes: [4, 4, N, rows, columns, O] -> [N, 2 * rows, 2 * columns, O]."""
    def along(tiles) -> tuple[jax.Array, jax.Array]:
        return tiles[0] + tiles[1] + tiles[2], tiles[1] - tiles[2] - tiles[3]

    samples, rows, columns, channels = products.shape[2:]
    by_column = along(products)
    by_row = zip(*(along(part) for part in by_column), strict=True)  # of each row its even and its odd columns
    lines = [jnp.concatenate(halves, axis=-1).reshape(samples, rows, 1, columns * 2 * channels) for halves in by_row]
    return jnp.concatenate(lines, axis=2).reshape(samples, 2 * rows, 2 * columns, channels)
