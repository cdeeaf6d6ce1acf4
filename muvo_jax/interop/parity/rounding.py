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
    random, scale = np.random.default_rng(seed), np.float32(size)

    def move(leaf):
        leaf = np.asarray(leaf, np.float32)
        return leaf + leaf * (scale * random.standard_normal(leaf.shape, np.float32))

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


def error_beyond(file: golden.File, entry: str, got: Any, noise: np.ndarray) -> float:
    """The error of an entry, of which each value counts only as far as it is off by more than its noise."""
    stored, ours = file.stored(entry, got)
    _, known = file.stored(entry, noise)
    beyond = np.maximum(np.abs(np.asarray(ours, np.float64) - stored) - known, 0.0)
    return float(beyond.max(initial=0.0) / max(np.abs(stored).max(initial=0.0), 1e-6))


def chamfer_gradient_noise(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """How far the reference's gradient of a Chamfer distance may be off, [F, P, 3] of clouds [F, P, 3] and [F, Q, 3].

    It takes |a|^2 + |b|^2 - 2 ab for |a - b|^2, in float32: the deviation of that is 2^-24 (|a|^2 + |b|^2) (measured on
    seed 0: 0.95 and 0.98 of it), and a unit vector from b to a is off by it over 2 |a - b|^2. Where two targets are
    equally near within that, either may be the one.
    """
    noise = np.zeros(points.shape[:2])
    for total, cloud, target in zip(noise, points.astype(np.float64), targets.astype(np.float64), strict=True):
        for own, other in ((cloud, target), (target, cloud)):
            squares = np.square(own[:, None] - other[None]).sum(axis=-1)
            nearest, second = np.argsort(squares, axis=1)[:, :2].T
            least, next_least = np.sort(squares, axis=1)[:, :2].T
            off = _DEVIATIONS * 2.0**-24 * (np.square(own).sum(axis=1) + np.square(other[nearest]).sum(axis=1))
            tied = next_least - least < np.sqrt(2.0) * off
            vectors = np.where(tied, 2.0, off / (2.0 * np.maximum(least, 1e-12))) / (len(points) * len(own))
            if own is cloud:
                total += vectors
            else:
                np.add.at(total, nearest, vectors)
                np.add.at(total, second[tied], vectors[tied])
    return np.broadcast_to(noise[..., None], points.shape)
