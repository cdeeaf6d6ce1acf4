"""Items of a pickled list that differ in nothing but one payload, read all at once.

A column of a data frame holds thousands of arrays or strings, one a frame. Each is some twenty opcodes, and the same
ones as of the item before: where the bytes around the payload are equal, so is what they would do, and NumPy takes the
payloads out of the file together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from muvo_jax.data.muvo import pickle_standins as standins

LONGEST_BYTES = 1 << 14  # of an item
_BINGET, _LONG_BINGET = b"hj"  # opcodes
_FIRST_LOOK = 16  # items; what fits is looked at eight times as far


class Payload(NamedTuple):
    """The content of one opcode: `start` to `stop` in the file, of text or of bytes."""

    start: int
    stop: int
    is_text: bool


class Template(NamedTuple):
    """An item, of which others may be copies.

    Attributes:
      size: its bytes.
      head, tail: those before and behind the payload; all of them are the head where there is none.
      value: what it made.
      is_text: whether its payload is one.
      memos: how many entries of the memo it made.
    """

    size: int
    head: bytes
    tail: bytes
    value: Any
    is_text: bool
    memos: int

    @classmethod
    def of(cls, content: bytes, start: int, stop: int, value: Any, payloads: Iterable[Payload],
           memos: int) -> Template | None:
        """Of the item that the bytes from `start` to `stop` made; None where copies of it are not understood."""
        size = stop - start
        if (content[start] == _BINGET and size == 2) or (content[start] == _LONG_BINGET and size == 5):  # made before
            return cls(size, content[start:stop], b"", value, False, 0)
        if isinstance(value, str):
            is_text, made_of = True, value.encode("utf-8", "surrogatepass")
        elif isinstance(value, standins.Array) and isinstance(value.values, np.ndarray) and value.values.ndim:
            is_text, made_of = False, value.values.tobytes()
        else:
            return None
        places = [one for one in payloads
                  if one.start >= start and one.is_text == is_text and content[one.start:one.stop] == made_of]
        if not places or not made_of:  # its content was made before; a copy is one to the last byte
            return cls(size, content[start:stop], b"", value, is_text, memos)
        payload = places[-1]
        return cls(size, content[start:payload.start], content[payload.stop:stop], value, is_text, memos)

    def copies(self, content: bytes, start: int) -> standins.Repeats | None:
        """Those that stand in the file from `start` on; None where there is none."""
        if not content.startswith(self.head, start):
            return None
        rows = np.frombuffer(content, np.uint8, (len(content) - start) // self.size * self.size, start)
        rows = rows.reshape(-1, self.size)
        first, last = len(self.head), self.size - len(self.tail)
        head, tail = (np.frombuffer(part, np.uint8) for part in (self.head, self.tail))
        count, look = 0, _FIRST_LOOK
        while True:
            part = rows[count:count + look]
            fits = (part[:, :first] == head).all(1) & (part[:, last:] == tail).all(1)
            if not fits.all() or not len(part):
                count += int(fits.argmin()) if len(part) else 0
                break
            count, look = count + len(part), 8 * look
        if not count:
            return None
        if first == self.size:
            return standins.Repeats([self.value] * count)
        payloads = np.ascontiguousarray(rows[:count, first:last])
        if self.is_text:
            return standins.Repeats([str(payload, "utf-8", "surrogatepass") for payload in payloads])
        array = self.value.values
        return standins.Repeats(payloads.view(array.dtype).reshape(count, *array.shape))


class Items:
    """A list whose items are being read: the stack that they gather on, and for each value on it where it began: its
    offset in the file and the number of its first entry of the memo."""

    def __init__(self, stack: list):
        self.stack = stack
        self.begins: list[tuple[int, int]] = []

    def take_apart(self, operands: int) -> None:
        """Makes single values of items that were read together and turn out to be operands, not items."""
        for place in range(len(self.stack) - 1, max(len(self.stack) - operands, 0) - 1, -1):
            if isinstance(self.stack[place], standins.Repeats):
                singles = self.stack[place].singles()
                self.stack[place:place + 1] = singles
                self.begins[place:place + 1] = self.begins[place:place + 1] * len(singles)

    def note(self, offset: int, memo: int) -> None:
        """After the opcode at `offset`, before which the memo had so many entries."""
        del self.begins[len(self.stack):]
        if len(self.stack) > len(self.begins):
            self.begins.append((offset, memo))


class Skipped(NamedTuple):
    """Items that were read together: their first entry of the memo, how many each would have made, how many items
    there are, and where they lie."""

    memo: int
    memos: int
    items: int
    offset: int
    size: int


class Memo(dict):
    """What opcodes refer to by number; entries of items that were read together are made when they are asked for."""

    def __init__(self, entry: Callable[[int], Any], first: int):
        """Args:
          entry: makes the entry of a number that is missing.
          first: the number of the first one.
        """
        super().__init__()
        self._entry, self._first = entry, first
        self.skipped: list[Skipped] = []
        self._of_skipped = 0

    @property
    def next(self) -> int:
        """The number of the next entry."""
        return self._first + len(self) + self._of_skipped

    def skip(self, skipped: Skipped) -> None:
        if skipped.memos:
            self.skipped.append(skipped)
            self._of_skipped += skipped.memos * skipped.items

    def __missing__(self, number: int) -> Any:
        return self._entry(number)
