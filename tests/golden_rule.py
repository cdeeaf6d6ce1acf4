"""The deterministic inputs of the parity numbers in tests/golden, and a reader for these files.

The numbers were made by running the authors' PyTorch code on inputs that this rule draws: a NumPy PCG64 stream seeded
by the CRC-32 of "name|kind|seed", in float64, cast at the end. Arrays come in torch's layout (channels before pixels).
"""

from __future__ import annotations

import pathlib
import zlib

import numpy as np

_FOLDER = pathlib.Path(__file__).parent / "golden"


def _stream(name: str, kind: str, seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(zlib.crc32(f"{name}|{kind}|{seed}".encode())))


def _stretch(coarse: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Linear interpolation of one axis to `size` samples, end points kept."""
    count = coarse.shape[axis]
    if size == 1 or count == 1:
        return np.repeat(np.take(coarse, [0], axis), size, axis)
    position = np.arange(size, dtype=np.float64) * (count - 1) / (size - 1)
    lower = np.minimum(np.floor(position).astype(np.int64), count - 2)
    share = (position - lower).reshape([size if i == axis % coarse.ndim else 1 for i in range(coarse.ndim)])
    return np.take(coarse, lower, axis) * (1.0 - share) + np.take(coarse, lower + 1, axis) * share


def _smooth(stream: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    *leading, rows, columns = shape
    out = 0.0
    for knots, amplitude in ((3, 0.5), (7, 0.3), (15, 0.2)):
        coarse = stream.random((*leading, min(knots, rows), min(knots + 2, columns)))
        out = out + amplitude * _stretch(_stretch(coarse, rows, -2), columns, -1)
    return out


def _mask(stream: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    rows, columns = shape[-2:]
    out = np.zeros(shape, bool)
    for plane in out.reshape(-1, rows, columns):
        for _ in range(5):
            high, wide = (1 + int(stream.integers(max(1, side // 4))) for side in (rows, columns))
            top, left = int(stream.integers(rows - high + 1)), int(stream.integers(columns - wide + 1))
            plane[top : top + high, left : left + wide] = True
    return out


def _box(stream: np.random.Generator, sides: tuple[int, ...], divisor: int) -> tuple[slice, ...]:
    size = [1 + int(stream.integers(max(1, side // divisor))) for side in sides]
    start = [int(stream.integers(side - extent + 1)) for side, extent in zip(sides, size, strict=True)]
    return tuple(slice(a, a + n) for a, n in zip(start, size, strict=True))


def _voxels(stream: np.random.Generator, shape: tuple[int, ...], unknown: bool) -> np.ndarray:
    """Boxes of 1 in a grid of 0, with a ragged ground plane; three boxes of 255 where `unknown`."""
    sides = shape[-3:]
    out = np.zeros(shape, np.uint8)
    for grid in out.reshape(-1, *sides):
        grid[:, :, sides[2] // 5] = (stream.random(sides[:2]) < 0.5) * 1
        for _ in range(56):
            where = _box(stream, sides, 8)
            grid[where] = 1 + int(stream.integers(1))
        for _ in range(3 if unknown else 0):
            grid[_box(stream, sides, 6)] = 255
    return out


def make_input(name: str, shape: tuple[int, ...], kind: str, seed: int = 0) -> np.ndarray:
    """One named input: kinds normal, uniform, pm1, sigma, smooth (float32), mask (bool), voxel2, voxel2_ign (uint8)."""
    stream = _stream(name, kind, seed)
    plain = {
        "normal": lambda: stream.standard_normal(shape),
        "uniform": lambda: stream.random(shape),
        "pm1": lambda: 2 * stream.random(shape) - 1,
        "sigma": lambda: 0.15 + 1.7 * stream.random(shape),
        "smooth": lambda: _smooth(stream, shape),
    }
    if kind in plain:
        return plain[kind]().astype(np.float32)
    if kind == "mask":
        return _mask(stream, shape)
    if kind in ("voxel2", "voxel2_ign"):
        return _voxels(stream, shape, kind.endswith("_ign"))
    raise ValueError(f"kind {kind!r} is not part of this rule.")


class Golden:
    """One file of reference numbers.

    An entry is stored whole, or as `name::sub` (every n-th value), `name::meta` ([n, *shape]) and `name::stats` (mean,
    std, minimum, maximum, L2 norm of all values).
    """

    def __init__(self, file: str):
        with np.load(_FOLDER / file) as stored:
            self.entries = {name: stored[name] for name in stored.files}

    def __getitem__(self, name: str) -> np.ndarray:
        return self.entries[name]

    def error(self, name: str, got) -> float:
        """Largest difference over the largest stored magnitude; with it, where sub-sampled, that of the L2 norm."""
        got = np.asarray(got, np.float64)
        if name in self.entries:
            want, have, extra = self.entries[name], got, 0.0
            shape = want.shape
        else:
            stride, *shape = self.entries[name + "::meta"].tolist()
            want, have = self.entries[name + "::sub"], got.reshape(-1)[::stride]
            norm = self.entries[name + "::stats"][4]
            extra = abs(np.sqrt(np.square(got).sum()) - norm) / max(norm, 1e-6)
        if tuple(got.shape) != tuple(shape):
            raise ValueError(f"{name}: got shape {got.shape}, expected {tuple(shape)}.")
        return float(max(np.abs(want - have).max() / max(np.abs(want).max(), 1e-6), extra))
