"""Numbers that the rounding of float32 decides: what a kink makes of it, and what is left of a number near zero.

Which numbers these are follows from their magnitude and from the noise of our own float32, never from their names.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from muvo_jax.interop.parity import golden

NETWORK_NOISE = 1e-6  # what a deep network makes of its own rounding, where its numbers are of size 1
_DEVIATIONS = 4.0  # of the noise that two roundings of one number may lie apart


def anew(values: Any, tries: int = 32, size: float = 1e-7) -> Iterator[Any]:
    """A tree of arrays as rounding could have left them: times 1 + size N(0, 1).

    The noise of the golden files was measured with 1e-7.
    """
    return (_moved(values, seed, size) for seed in range(tries))


def in_pairs(values: Any, pairs: int = 8, size: float = 1e-5) -> Iterator[Any]:
    """A tree of arrays moved by 1 + size N(0, 1) and by 1 - size N(0, 1), in turns.

    In the mean of what a smooth function makes of a pair the move itself is gone, to 1e-10; what is left are two
    roundings that know nothing of each other, because the move is much larger than they are.
    """
    return (_moved(values, seed, signed) for seed in range(pairs) for signed in (size, -size))


def _moved(values: Any, seed: int, size: float) -> Any:
    normal = np.random.default_rng(seed).standard_normal
    move = lambda leaf: np.asarray(np.asarray(leaf) * (1.0 + size * normal(leaf.shape)), np.float32)
    return jax.tree.map(move, values)


def is_near_zero(file: golden.File, entry: str, tolerance: float) -> bool:
    """Whether the noise of a network is more than the tolerance of the largest number of an entry stored whole."""
    return entry in file.arrays and tolerance * np.abs(file[entry]).max(initial=0.0) < NETWORK_NOISE


def error_near_zero(file: golden.File, entry: str, values: Iterator[Any], tolerance: float) -> tuple[float, str]:
    """The error of an entry near zero in the mean of its roundings, and how it came about in words.

    The difference is measured against the stored magnitude, as everywhere, or against that number of which the noise of
    a rounding is the tolerance, if that is larger: the reference is one rounding too, and no nearer to the truth.

    Args:
      values: of `in_pairs`, from which the noise is measured; at most NETWORK_NOISE of it counts.
      tolerance: of the entry.
    """
    every = np.stack([np.asarray(value, np.float64) for value in values])
    pairs = every.reshape(-1, 2, *every.shape[1:]).mean(axis=1)
    noise = min(float(np.sqrt(2.0) * pairs.std(axis=0, ddof=1).max()), NETWORK_NOISE)
    stored, mean = file.stored(entry, pairs.mean(axis=0))
    apart = float(np.abs(mean - stored).max())
    magnitude = max(float(np.abs(stored).max()), _DEVIATIONS * noise / tolerance)
    return apart / magnitude, f"near zero: {apart:.1e} from the mean of {len(every)} roundings, noise {noise:.1e}"
