"""Arrays inside jax.shard_map that vary from device to device where others do."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax


def zeros(left, right, dtype):
    """Zeros [A, B], to which a loop adds products of left [..., A] and right [..., B] over all their pixels.

    A carry must vary over a mesh's axes before the first step as it does after it, where jax.shard_map checks that (its
    default), and the product over no pixel at all varies as its factors do.
    """
    left, right = (value.reshape(-1, value.shape[-1])[:0] for value in (left, right))
    return lax.dot_general(left, right, (((0,), (0,)), ((), ())), preferred_element_type=jnp.dtype(dtype))
