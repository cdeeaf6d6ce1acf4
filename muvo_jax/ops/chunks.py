"""Products over all pixels of images, some samples or rows at a time: how many, and what their sum starts from."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax


def size(batch: int, rows: int, row: int, most: int) -> tuple[int, int]:
    """Samples and rows of a chunk of about `most`, a row being `row`: the samples divide the batch, and either all rows
    or one sample; at least one row."""
    if rows * row > most:
        return 1, -(-rows // min(rows, -(-rows * row // most)))
    samples = min(batch, most // max(rows * row, 1))
    while batch % samples:
        samples -= 1
    return samples, rows


def zeros(left, right, dtype):
    """Zeros [A, B], to which a loop adds products of left [..., A] and right [..., B] over all their pixels.

    A carry must vary over a mesh's axes before the first step as it does after it, where jax.shard_map checks that (its
    default), and the product over no pixel at all varies as its factors do.
    """
    left, right = (value.reshape(-1, value.shape[-1])[:0] for value in (left, right))
    return lax.dot_general(left, right, (((0,), (0,)), ((), ())), preferred_element_type=jnp.dtype(dtype))
