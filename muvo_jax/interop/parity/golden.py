"""Golden files, the reference's numbers: npz files, and pack.json, which holds the seed and the sizes of a folder.

An entry is stored whole under its name, or, where it is large, as `name::sub` (every n-th value of the flattened
array), `name::meta` ([n, *shape]) and `name::stats` (mean, std, minimum, maximum, L2 norm of all values). Nothing in a
folder is ever executed: arrays are read without pickle, sizes are JSON.
"""

from __future__ import annotations

import functools
import json
import math
import os
import pathlib
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from muvo_jax.interop import weights_rule

FORMAT = 1


class GoldenError(ValueError):
    """A golden file or its pack.json cannot be read; the message names the file and what is wrong."""


class File:
    """One file of reference numbers.

    Raises:
      GoldenError: where the file is no npz file of plain arrays.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = pathlib.Path(path)
        try:
            with np.load(self.path, allow_pickle=False) as stored:
                self.arrays = {name: stored[name] for name in stored.files}
        except (OSError, ValueError, EOFError, zlib.error, zipfile.BadZipFile) as error:
            raise GoldenError(f"{self.path}: expected an npz file of plain arrays ({error}).") from error
        self.names = sorted({name.split("::")[0] for name in self.arrays})

    def __contains__(self, name: str) -> bool:
        return name in self.arrays or name + "::meta" in self.arrays

    def __getitem__(self, name: str) -> np.ndarray:
        """An entry that is stored whole."""
        return self.arrays[name]

    def shape(self, name: str) -> tuple[int, ...]:
        return self.arrays[name].shape if name in self.arrays else tuple(self.arrays[name + "::meta"][1:].tolist())

    def stride(self, name: str) -> int:
        """Every how many values of the flattened array one is stored."""
        return 1 if name in self.arrays else int(self.arrays[name + "::meta"][0])

    def values(self, name: str) -> np.ndarray:
        """The stored values: the whole array, or every `stride`-th of the flattened one."""
        return self.arrays[name if name in self.arrays else name + "::sub"]

    def error(self, name: str, got: Any) -> float:
        """Largest difference over the stored values, divided by the largest magnitude among them (at least 1e-6).

        Of sub-sampled entries also the relative differences of standard deviation and L2 norm; the largest counts.

        Raises:
          ValueError: where the shapes differ.
        """
        got = np.asarray(got)
        want, have, extra = self._compare(name, got)
        if want.size == 0:
            return _not_nan(extra)
        want, have = want.astype(np.float64), have.astype(np.float64)
        difference = np.where(np.isnan(want) & np.isnan(have), 0.0, np.abs(want - have))
        largest = np.nanmax(np.abs(want)) if np.isfinite(want).any() else 1.0
        return _not_nan(np.max([difference.max() / max(largest, 1e-6), extra]))

    def share_different(self, name: str, got: Any, ignore: np.ndarray | None = None) -> float:
        """Share of the stored values that are not equal, for integers; `ignore` masks entries that are stored whole.

        Raises:
          ValueError: where the shapes differ.
        """
        want, have, _ = self._compare(name, np.asarray(got))
        different = want != have
        if ignore is not None:
            different = different[~ignore.reshape(different.shape)]
        return float(different.mean()) if different.size else 0.0

    def stored(self, name: str, got: Any) -> tuple[np.ndarray, np.ndarray]:
        """The stored values of an entry, and the same ones of `got`, which has the shape of the whole entry."""
        return self._compare(name, np.asarray(got))[:2]

    def _compare(self, name: str, got: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Stored values, the same of `got`, and the error of the statistics of a sub-sampled entry."""
        if got.shape != self.shape(name):
            raise ValueError(f"{name}: got shape {list(got.shape)}, expected {list(self.shape(name))}.")
        if name in self.arrays:
            return self.arrays[name], got, 0.0
        _, std, _, _, norm = self.arrays[name + "::stats"]
        wide = got.astype(np.float64)
        extra = np.max([abs(wide.std() - std) / max(std, 1e-6),  # NaN where one of them is
                        abs(np.sqrt(np.square(wide).sum()) - norm) / max(norm, 1e-6)])
        return self.values(name), got.reshape(-1)[::self.stride(name)], float(extra)


def _not_nan(error: Any) -> float:
    """An error that is NaN compares as none: infinite, it fails."""
    return math.inf if math.isnan(error) else float(error)


class Settings:
    """The seed and the sizes of a folder of golden files; what pack.json leaves out is as with seed 0.

    Raises:
      GoldenError: where pack.json is unreadable or of another format.
    """

    def __init__(self, folder: str | os.PathLike | None = None):
        """Reads folder/pack.json; without a folder all sizes are the usual ones, with seed 0."""
        stored = {"format": FORMAT} if folder is None else self._read(pathlib.Path(folder) / "pack.json")
        self._stored: Mapping[str, Any] = stored
        self.seed = int(stored.get("seed", 0))
        self.gps_offset = float(stored.get("gps_offset", 0.0))

    @staticmethod
    def _read(path: pathlib.Path) -> dict[str, Any]:
        try:
            stored = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise GoldenError(f"{path}: expected the JSON description of golden files ({error}).") from error
        if not isinstance(stored, dict) or stored.get("format") != FORMAT:
            found = stored.get("format") if isinstance(stored, dict) else stored
            raise GoldenError(f"{path}: expected format {FORMAT}, found {found!r}.")
        return stored

    def size(self, *path: str) -> Any:
        """A size by its place in pack.json, lists as tuples: size("p3_1d", "rssm", "batch").

        Raises:
          KeyError: where neither pack.json nor the defaults have it.
        """
        for source in (self._stored, _default_sizes()):
            node: Any = source
            for name in path:
                node = node.get(name) if isinstance(node, Mapping) else None
            if node is not None:
                return _as_tuple(node)
        raise KeyError("/".join(path))

    def draw(self, name: str, shape: tuple[int, ...], kind: str) -> np.ndarray:
        """An input of these golden files, see weights_rule.make_input."""
        return weights_rule.make_input(name, shape, kind, self.seed)


def manifest(name: str) -> dict[str, tuple[int, ...]]:
    """The state_dict keys of a reference model and their torch shapes, in order.

    Args:
      name: of the model, such as "1d_RV_WOB_TR_voxel"; see `manifest_names`.
    """
    path = _data() / "manifests" / f"{name}.json"
    return {key: tuple(shape) for key, shape in json.loads(path.read_text()).items()}


def manifest_names() -> list[str]:
    return sorted(path.stem for path in (_data() / "manifests").glob("*.json"))


def _data() -> pathlib.Path:
    return pathlib.Path(__file__).parent


@functools.cache
def _default_sizes() -> dict[str, Any]:
    return json.loads((_data() / "default_sizes.json").read_text())


def _as_tuple(node: Any) -> Any:
    return tuple(_as_tuple(item) for item in node) if isinstance(node, list) else node
