"""Channels-last convolutions, transposed convolutions and max pooling in one, two or three dimensions.

The numbers are those of torch.nn.Conv*, ConvTranspose* and MaxPool* with channels last; the form of the computation is
chosen by the platform that a program is lowered for, here and nowhere else (not by the default backend: a program for
the CPU of a machine with a GPU takes the CPU's form, and one that is exported for both has both):

  "auto"  "gemm" on a CPU, elsewhere XLA's convolutions, with transposed ones split into phases; reverse-mode
          differentiation only.
  "xla"   plain XLA, which also supports forward-mode differentiation (jvp, hessian).
  "gemm"  the forms of muvo_jax.ops.conv_cpu, transposed ones split into phases; reverse-mode differentiation only.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
from jax import lax

from muvo_jax.ops import conv_cpu, precision

Implementation = Literal["auto", "xla", "gemm"]
PerAxis = int | Sequence[int]


def conv(x, kernel, *, stride: PerAxis = 1, padding: PerAxis = 0, implementation: Implementation = "auto"):
    """Convolution (correlation, as torch has it): out[i] = sum over k of x[i * stride - padding + k] @ kernel[k].

    Args:
      x: float [N, *S, C].
      kernel: float [*K, C, O], of the dtype of x.
      stride, padding: one integer, or one for each spatial axis; zeros are padded on both sides.
      implementation: see the module.

    Returns:
      [N, *S', O] of the dtype of x, with S' = (S + 2 * padding - K) // stride + 1.

    Raises:
      ValueError: for ranks, channels, dtypes, strides or sizes that do not fit.
    """
    rank = check(x, kernel, implementation)
    strides, pads = _per_axis("stride", stride, rank, 1), _per_axis("padding", padding, rank, 0)
    taps = kernel.shape[:rank]
    if any(n + 2 * p < k for n, p, k in zip(x.shape[1:-1], pads, taps, strict=True)):
        raise ValueError(f"conv: the padded input {x.shape[1:-1]} + 2 * {pads} is smaller than the kernel {taps}.")
    pairs = tuple((p, p) for p in pads)
    if implementation == "xla":
        return conv_cpu.plain(x, kernel, strides, pairs)
    if math.prod(taps) == 1:
        return _pointwise(x, kernel, strides, pairs)
    return formed(implementation, *_conv_forms(strides, pairs), x, kernel)


def depthwise_conv(x, kernel, *, stride: int = 1, padding: int = 0, implementation: Implementation = "auto"):
    """Convolution of each channel c alone: out[i, c] = sum over k of x[i * stride - padding + k, c] * kernel[k, 0, c].

    On a CPU a sum of shifted products, whose gradients XLA fuses; its grouped convolution is slow there.

    Args:
      x: float [N, H, W, C].
      kernel: float [K, K, 1, C], of the dtype of x.
      stride, padding, implementation: as in `conv`, the same for both axes.

    Returns:
      [N, H', W', C] of the dtype of x.

    Raises:
      ValueError: for another rank, or other channels or dtypes than x has.
    """
    if x.ndim != 4 or kernel.ndim != 4 or kernel.shape[2:] != (1, x.shape[-1]) or kernel.dtype != x.dtype:
        raise ValueError(f"depthwise_conv: got x {x.dtype}{list(x.shape)} and kernel {kernel.dtype}"
                         f"{list(kernel.shape)}, expected [N, H, W, C] and [K, K, 1, C] of one dtype.")
    shifted, grouped = _depthwise_forms(stride, padding)
    return grouped(x, kernel) if implementation == "xla" else formed(implementation, shifted, grouped, x, kernel)


def conv_transpose(x, kernel, *, stride: PerAxis = 1, padding: PerAxis = 0, output_padding: PerAxis = 0,
                   implementation: Implementation = "auto"):
    """Transposed convolution as torch has it: out[i * stride - padding + k] += x[i] @ kernel[k].

    Except in "xla" it is split into phases: output position i * stride + r reads every stride-th tap of the kernel, so
    all phases together are one dense convolution to stride**rank * O channels, whose channels then move into space.

    Args:
      x: float [N, *S, C].
      kernel: float [*K, C, O], of the dtype of x.
      stride, padding, output_padding: one integer, or one for each spatial axis.
      implementation: see the module.

    Returns:
      [N, *S', O] of the dtype of x, with S' = (S - 1) * stride - 2 * padding + K + output_padding.

    Raises:
      ValueError: for ranks, channels, dtypes, strides or sizes that do not fit.
    """
    rank = check(x, kernel, implementation)
    strides, pads = _per_axis("stride", stride, rank, 1), _per_axis("padding", padding, rank, 0)
    extra = _per_axis("output_padding", output_padding, rank, 0)
    taps = kernel.shape[:rank]
    outs = tuple((n - 1) * s - 2 * p + k + e
                 for n, s, p, k, e in zip(x.shape[1:-1], strides, pads, taps, extra, strict=True))
    if any(e >= s and e > 0 for e, s in zip(extra, strides, strict=True)):
        raise ValueError(f"conv_transpose: output_padding {extra} must be smaller than the stride {strides}.")
    if min(outs) < 1:
        raise ValueError(f"conv_transpose: input {x.shape[1:-1]}, kernel {taps}, stride {strides} and padding {pads} "
                         f"give an output of size {outs}; reduce the padding.")
    if implementation == "xla":
        return conv_cpu.dilated(x, kernel, strides, pads, outs)
    if math.prod(x.shape[1:-1]) == 1:
        return _from_one_pixel(x, kernel, pads, outs)
    if rank == 1:
        return _phases(x[:, None], kernel[None], (1, *strides), (0, *pads), (1, *outs), implementation)[:, 0]
    return _phases(x, kernel, strides, pads, outs, implementation)


def max_pool(x, *, window: PerAxis, stride: PerAxis, padding: PerAxis = 0):
    """Maximum over windows, padded with -inf; the gradient goes to the first maximum of a window, as in torch.

    Args:
      x: float [N, *S, C].
      window, stride, padding: one integer, or one for each spatial axis; padding at most half of the window.

    Returns:
      [N, *S', C], with S' = (S + 2 * padding - window) // stride + 1; NaN where a window holds one.

    Raises:
      ValueError: for sizes that do not fit.
    """
    rank = x.ndim - 2
    windows, strides = _per_axis("window", window, rank, 1), _per_axis("stride", stride, rank, 1)
    pads = _per_axis("padding", padding, rank, 0)
    if any(2 * p > w or n + 2 * p < w for n, w, p in zip(x.shape[1:-1], windows, pads, strict=True)):
        raise ValueError(f"max_pool: padding {pads} must be at most half of the window {windows}, and the padded input "
                         f"{x.shape[1:-1]} at least as large as the window.")
    lowest = jnp.array(-jnp.inf, x.dtype)
    x = lax.pad(x, lowest, ((0, 0, 0), *((p, p, 0) for p in pads), (0, 0, 0)))
    # Axis by axis, the last first: the first maximum in row-major order wins ties, at k + k instead of k * k slices.
    for axis in range(rank, 0, -1):
        size, step = windows[axis - 1], strides[axis - 1]
        span = (x.shape[axis] - size) // step * step + 1
        best = lax.slice_in_dim(x, 0, span, step, axis)
        for offset in range(1, size):
            candidate = lax.slice_in_dim(x, offset, offset + span, step, axis)
            best = jnp.where((candidate > best) | (candidate != candidate), candidate, best)
        x = best
    return x


def check(x, kernel, implementation) -> int:
    """The number of spatial axes of x [N, *S, C] and kernel [*K, C, O].

    Raises:
      ValueError: where they do not fit each other, or for an unknown implementation.
    """
    rank = kernel.ndim - 2
    if implementation not in ("auto", "xla", "gemm"):
        raise ValueError(f"implementation: got {implementation!r}, expected 'auto', 'xla' or 'gemm'.")
    if rank not in (1, 2, 3) or x.ndim != kernel.ndim:
        raise ValueError(f"got x {x.shape} and kernel {kernel.shape}, expected x [N, *S, C] and kernel [*K, C, O] with "
                         f"one, two or three spatial axes each.")
    if x.shape[-1] != kernel.shape[-2]:
        raise ValueError(f"x has {x.shape[-1]} channels, the kernel {kernel.shape} expects {kernel.shape[-2]}.")
    if x.dtype != kernel.dtype:
        raise ValueError(f"x is {x.dtype.name} and the kernel {kernel.dtype.name}; cast one of them.")
    return rank


def _per_axis(name: str, value: PerAxis, rank: int, lowest: int) -> tuple[int, ...]:
    values = (value,) * rank if isinstance(value, int) else tuple(value)
    if len(values) != rank or min(values) < lowest:
        raise ValueError(f"{name}: got {value}, expected an integer or {rank} of them, each at least {lowest}.")
    return values


def reverse_only(implementation: str) -> bool:
    """Whether convolutions of this implementation have reverse-mode derivatives alone."""
    return implementation != "xla"


Form = Callable[[jax.Array, jax.Array], jax.Array]  # (x, kernel) -> result


def formed(implementation: str, cpu: Form, other: Form, x, kernel):
    """One form of a computation on a CPU, or wherever "gemm" is asked for, and another elsewhere."""
    return cpu(x, kernel) if implementation == "gemm" else _by_platform(cpu, other, x, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _by_platform(cpu: Form, other: Form, x, kernel):
    """One form on a CPU, another elsewhere, each with its own gradient.

    Differentiating the choice itself would keep what both forms need for their gradients.
    """
    return lax.platform_dependent(x, kernel, cpu=cpu, default=other)


def _by_platform_forward(cpu, other, x, kernel):
    return _by_platform(cpu, other, x, kernel), (x, kernel)


def _by_platform_backward(cpu, other, residuals, gradient):
    return lax.platform_dependent(*residuals, gradient, cpu=_pull_back(cpu), default=_pull_back(other))


_by_platform.defvjp(_by_platform_forward, _by_platform_backward)


# The functions below are made once for each setting: where programs are not jitted, a new function would compile anew.
@functools.cache
def _pull_back(form: Form):
    return lambda x, kernel, gradient: jax.vjp(form, x, kernel)[1](gradient)


@functools.cache
def _conv_forms(strides: tuple[int, ...], pairs: conv_cpu.Pairs) -> tuple[Form, Form]:
    """The CPU's form of a convolution, and XLA's."""
    if len(strides) == 1:
        cpu = lambda x, kernel: _cpu_conv(x[:, None], kernel[None], (1, *strides), ((0, 0), *pairs))[:, 0]
    else:
        cpu = functools.partial(_cpu_conv, strides=strides, pairs=pairs)
    return cpu, functools.partial(conv_cpu.plain, stride=strides, padding=pairs)


@functools.cache
def _depthwise_forms(stride: int, padding: int) -> tuple[Form, Form]:
    """A sum of shifted products, and XLA's grouped convolution."""
    def shifted(x, kernel):
        rows, columns = ((side + 2 * padding - taps) // stride + 1
                         for side, taps in zip(x.shape[1:3], kernel.shape[:2], strict=True))
        padded = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
        total = jnp.zeros((x.shape[0], rows, columns, x.shape[-1]), x.dtype)
        for row in range(kernel.shape[0]):
            for column in range(kernel.shape[1]):
                part = lax.slice(padded, (0, row, column, 0), (x.shape[0], row + (rows - 1) * stride + 1,
                                 column + (columns - 1) * stride + 1, x.shape[-1]), (1, stride, stride, 1))
                total = total + part * kernel[row, column].reshape(1, 1, 1, -1)
        return total

    def grouped(x, kernel):
        return lax.conv_general_dilated(x, kernel, (stride, stride), [(padding, padding)] * 2,
                                        dimension_numbers=("NHWC", "HWIO", "NHWC"), feature_group_count=x.shape[-1],
                                        precision=precision.PRODUCTS)

    return shifted, grouped


def _pointwise(x, kernel, strides, pairs):
    """A kernel of one tap is a matrix product."""
    x = jnp.pad(x, ((0, 0), *pairs, (0, 0)))
    x = x[(slice(None), *(slice(None, None, step) for step in strides))]
    return jnp.dot(x, kernel.reshape(kernel.shape[-2:]), precision=precision.PRODUCTS)


def _cpu_conv(x, kernel, strides, pairs):
    if max(strides) == 1:
        return conv_cpu.dense(x, kernel, pairs)
    return conv_cpu.strided(x, kernel, strides, pairs)


def _from_one_pixel(x, kernel, pads, outs):
    """An input of one pixel paints the kernel: one matrix product."""
    *taps, channels_in, channels_out = kernel.shape
    rank = len(taps)
    pixel = x.reshape(x.shape[0], channels_in)
    weights = jnp.moveaxis(kernel, -2, 0).reshape(channels_in, -1)
    painted = jnp.dot(pixel, weights, precision=precision.PRODUCTS).reshape(x.shape[0], *taps, channels_out)
    edges = [(-p, o + p - k, 0) for p, o, k in zip(pads, outs, taps, strict=True)]
    return lax.pad(painted, jnp.zeros((), painted.dtype), ((0, 0, 0), *edges[:rank], (0, 0, 0)))


def _phases(x, kernel, strides, pads, outs, implementation):
    """Position u = i * stride + k of the uncropped output is u = j * stride + r, with tap k = (j - i) * stride + r."""
    *taps, channels_in, channels_out = kernel.shape
    rank = len(taps)
    reads = [-(-k // s) for k, s in zip(taps, strides, strict=True)]
    first = [p // s for p, s in zip(pads, strides, strict=True)]
    last = [(p + o - 1) // s for p, o, s in zip(pads, outs, strides, strict=True)]
    kernel = jnp.pad(kernel, (*((0, q * s - k) for q, s, k in zip(reads, strides, taps, strict=True)), (0, 0), (0, 0)))
    split = [side for pair in zip(reads, strides, strict=True) for side in pair]
    order = (*range(0, 2 * rank, 2), 2 * rank, *range(1, 2 * rank, 2), 2 * rank + 1)
    kernel = jnp.flip(kernel.reshape(*split, channels_in, channels_out).transpose(order), tuple(range(rank)))
    kernel = kernel.reshape(*reads, channels_in, math.prod(strides) * channels_out)
    pairs = tuple((q - 1 - f, e - (n - 1))
                  for q, f, e, n in zip(reads, first, last, x.shape[1:-1], strict=True))
    dense = formed(implementation, *_conv_forms((1,) * rank, pairs), x, kernel)
    full = conv_cpu.depth_to_space(dense, strides)
    starts = [p - f * s for p, f, s in zip(pads, first, strides, strict=True)]
    return lax.slice(full, (0, *starts, 0), (full.shape[0], *(a + o for a, o in zip(starts, outs, strict=True)),
                                             channels_out))
