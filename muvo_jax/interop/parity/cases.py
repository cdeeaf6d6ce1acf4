"""What a parity check is made of: checks of entries, groups of them, and the golden files that groups belong to."""

from __future__ import annotations

import dataclasses
import pathlib
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from muvo_jax.interop.parity import golden


@dataclasses.dataclass(frozen=True)
class Check:
    """One entry, computed anew.

    Attributes:
      entry: its name in the file; one that the file lacks is passed over.
      got: our value, in torch's layout.
      tolerance: the largest error that passes.
      measure: (file, entry, got) -> error; by default that of golden.File.error.
      stands_alone: whether the expected value lies elsewhere than in the file (in `measure`).
      again: the same value on weights or inputs that differ by rounding (rounding.anew), asked for only where `got`
        misses the tolerance. At a kink of the function it is chance on which side float32 comes out, in the reference
        too, so one of these may be its value.
      roundings: the same value on weights moved back and forth (rounding.in_pairs), asked for only where `got` misses
        the tolerance and the stored value is near zero; see rounding.error_near_zero.
      noise: how far each value of the reference itself may be off, an array as `got`, where its formula rounds more
        than ours; asked for only where `got` misses the tolerance.
      note: what the line of the entry says in the end.
    """

    entry: str
    got: Any
    tolerance: float
    measure: Callable[[golden.File, str, Any], float] = golden.File.error
    stands_alone: bool = False
    again: Callable[[], Iterator[Any]] | None = None
    roundings: Callable[[], Iterator[Any]] | None = None
    noise: Callable[[], Any] | None = None
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Context:
    """What a group of checks may read.

    Attributes:
      file: the file under test.
      settings: seed and sizes of its folder.
      recordings: folder of recordings, for the golden files that need some.
    """

    file: golden.File
    settings: golden.Settings
    recordings: pathlib.Path | None = None

    def draw(self, name: str, shape: tuple[int, ...], kind: str):
        """An input by the rule, with the seed of the folder."""
        return self.settings.draw(name, shape, kind)

    def size(self, *path: str) -> Any:
        """A size by its place in pack.json, see golden.Settings.size."""
        return self.settings.size(*path)

    def shape(self, *entries: str) -> tuple[int, ...] | None:
        """The shape of the first of some entries that the file holds; what an array shows goes before pack.json."""
        return next((self.file.shape(entry) for entry in entries if entry in self.file), None)


Group = Callable[[Context], Iterator[Check]]


@dataclasses.dataclass(frozen=True)
class FileChecks:
    """How the entries of one kind of file are computed.

    Attributes:
      name: what --only selects.
      files: names of the files, regular expressions that match the whole name.
      groups: each yields checks of some entries; one that raises does not stop the others.
      left_out: entry (regular expression, whole name) -> why it is not checked.
      needs_recordings: whether the groups run only where recordings are given; else all is left out, and said.
    """

    name: str
    files: tuple[str, ...]
    groups: tuple[Group, ...]
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)
    needs_recordings: bool = False

    def reads(self, file: str) -> bool:
        return any(re.fullmatch(pattern, file) for pattern in self.files)

    def reason(self, entry: str) -> str | None:
        """Why an entry is not checked, None where it ought to be."""
        return next((why for pattern, why in self.left_out.items() if re.fullmatch(pattern, entry)), None)
