"""Reads pickled data frames and pickled NumPy arrays without executing anything that the file asks for.

`pickle` calls whatever a file names. Here every name stands for a small class of this module, whatever is not in that
list is refused, and so is every opcode that data does not need. The arrays are put together by NumPy from checked
bytes; neither pandas nor NumPy's own unpickling sees them. That also makes the reader independent of the versions that
wrote the file: frames of pandas 1.5 to 3.1 with NumPy 1.23 to 2.4 were tried.
"""

from __future__ import annotations

import collections
import io
import pathlib
import pickle
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from muvo_jax.data import files, schema
from muvo_jax.data.muvo import pickle_repeats as repeats
from muvo_jax.data.muvo import pickle_standins as standins

_PAYLOADS = 64  # of an item at most, for its copies to be looked for
_OPCODES = frozenset((
    pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.POP, pickle.POP_MARK, pickle.NONE, pickle.NEWTRUE,
    pickle.NEWFALSE, pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT,
    pickle.SHORT_BINBYTES, pickle.BINBYTES, pickle.BINBYTES8, pickle.BYTEARRAY8, pickle.SHORT_BINUNICODE,
    pickle.BINUNICODE, pickle.BINUNICODE8, pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2,
    pickle.TUPLE3, pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS, pickle.EMPTY_DICT, pickle.SETITEM,
    pickle.SETITEMS, pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.REDUCE, pickle.NEWOBJ, pickle.BUILD, pickle.MEMOIZE,
    pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET,
))

# How many values below the top of the stack an opcode looks at; all down to the mark where it is a very large number.
_ALL = 1 << 60
_OPERANDS = {code[0]: operands for operands, codes in (
    (1, (pickle.POP, pickle.TUPLE1, pickle.MEMOIZE, pickle.BINPUT, pickle.LONG_BINPUT)),
    (2, (pickle.TUPLE2, pickle.REDUCE, pickle.NEWOBJ, pickle.BUILD, pickle.STACK_GLOBAL, pickle.APPEND)),
    (3, (pickle.TUPLE3, pickle.SETITEM)), (_ALL, (pickle.TUPLE, pickle.SETITEMS, pickle.POP_MARK))) for code in codes}


def load_table(path: pathlib.Path) -> dict[str, Sequence]:
    """Returns the columns of a pickled pandas.DataFrame, by name: arrays, or lists where cells are objects.

    Raises:
      Refused: where the file is damaged, is no data frame or asks for anything else.
      DataError: where there is no file.
    """
    content = files.read_bytes(path, "a pickled data frame")
    value = loads(content, str(path))
    if not isinstance(value, standins.Frame):
        raise standins.Refused(f"{path}: holds {standins.kind(value)}, expected a pickled pandas.DataFrame. "
                               f"{standins.HOW_TO_GO_ON}")
    return value.columns(len(content), str(path))


def load_npy(path: pathlib.Path) -> Any:
    """Returns what an .npy file holds: an array, or the Python object of a pickled one of shape () (a dict of arrays).

    Raises:
      Refused: where a pickled file asks for more than arrays, dicts, lists, strings and numbers.
      DataError: where the file is missing or damaged.
    """
    content = files.read_bytes(path, "an NPY file")
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read(file)
    except Exception as error:  # NumPy reads the header with Python's parser, which has many ways to object
        raise schema.DataError(f"{path}: not a readable NPY file ({error}). Copy it again.") from error
    rest = content[file.tell():]
    if not dtype.hasobject:
        return standins.filled(rest, dtype, shape, is_fortran, str(path))
    value = standins.plain(loads(rest, str(path)), str(path))
    return value[0] if shape == () and isinstance(value, list) and len(value) == 1 else value


def loads(content: bytes, where: str) -> Any:
    """Unpickles to plain values and the stand-ins of this module; `where` names the source in messages.

    Raises:
      Refused: see load_table.
    """
    unpickler = _Unpickler(content)
    try:
        return unpickler.load()
    except standins.Refused as error:
        raise standins.Refused(f"{where}: {error} {standins.HOW_TO_GO_ON}") from None
    except Exception as error:  # a malformed stream may raise anything, says the documentation of pickle
        raise standins.Refused(f"{where}: not a readable pickle ({type(error).__name__}: {error}). "
                               f"{standins.HOW_TO_GO_ON}") from error
    finally:
        del unpickler.memo  # which refers to it in turn: all that was read would wait for the garbage collector


_Python: Any = pickle._Unpickler  # only in the Python form can opcodes be taken away


class _Unpickler(_Python):
    dispatch: ClassVar[dict[int, Callable]] = {code: work for code, work in _Python.dispatch.items()
                                               if bytes([code]) in _OPCODES}

    def __init__(self, content: bytes, first: int = 0, outer: _Unpickler | None = None):
        """Args:
          content: the pickle, or an item of a list in it.
          first, outer: of an item: the number of its first entry of the memo, and who reads the whole.
        """
        file = io.BytesIO(content)
        super().__init__(file)
        self._content, self._tell, self._seek = content, file.tell, file.seek
        self.read, self.readinto, self.readline = file.read, file.readinto, file.readline
        self.metastack: list[list] = []
        self.stack: list = []
        self.proto = 0
        self.append = self.stack.append
        self.memo = repeats.Memo(self.entry, first)
        self._outer = outer
        self._lists: list[repeats.Items] = []
        self._template: repeats.Template | None = None
        self._payloads: collections.deque[repeats.Payload] = collections.deque(maxlen=_PAYLOADS)
        self._made_anew: dict[int, Any] = {}

    def load(self) -> Any:
        """The value of the whole pickle; of an item that `entry` needs: None, when it has been read to its end."""
        try:
            while self._outer is None or self._tell() < len(self._content):
                offset = self._tell()
                if self._lists and self._lists[-1].stack is self.stack and self._read_copies(offset):
                    continue
                code, memo = self._opcode(), self.memo.next
                if code in _OPERANDS and self._lists and self._lists[-1].stack is self.stack:
                    self._lists[-1].take_apart(_OPERANDS[code])
                self.dispatch[code](self)
                self._watch(code, offset, memo)
        except pickle._Stop as stop:  # type: ignore[attr-defined]
            return stop.value

    def _opcode(self) -> int:
        code = self.read(1)
        if not code:
            raise EOFError
        if code[0] not in self.dispatch:
            raise standins.Refused(f"uses opcode {code!r}, which data does not need.")
        return code[0]

    def _watch(self, code: int, offset: int, memo: int) -> None:
        """Keeps track of which bytes made which item of a list."""
        if code == pickle.MARK[0] and self.metastack[-1] and isinstance(self.metastack[-1][-1], list):
            self._lists.append(repeats.Items(self.stack))
            self._payloads.clear()
            return
        while len(self._lists) > 1 and self._lists[-2].stack is self.stack:
            self._lists.pop()
        if self._lists and self._lists[-1].stack is self.stack:
            self._lists[-1].note(offset, memo)

    def _read_copies(self, offset: int) -> bool:
        """Reads the items at `offset` that are copies of the one before, or of the last that had copies, if any are."""
        begins, value = self._lists[-1].begins, self.stack[-1] if self.stack else None
        copies = self._template.copies(self._content, offset) if self._template else None
        if copies is None and begins and not isinstance(value, standins.Repeats):
            template = self._template_before(offset, *begins[-1], value)
            copies = template.copies(self._content, offset) if template else None
            self._template = template if copies else self._template
        if copies is None or self._template is None:
            return False
        size = self._template.size
        self.memo.skip(repeats.Skipped(self.memo.next, self._template.memos, len(copies), offset, size))
        self._seek(offset + len(copies) * size)
        self.append(copies)
        begins.append((offset, self.memo.next))
        self._payloads.clear()
        return True

    def _template_before(self, offset: int, start: int, memo: int, value: Any) -> repeats.Template | None:
        size, content = offset - start, self._content
        if size > repeats.LONGEST_BYTES or content[start:start + 2] != content[offset:offset + 2] or (
                content[offset - 1:offset] != content[offset + size - 1:offset + size]):
            return None
        return repeats.Template.of(content, start, offset, value, self._payloads, self.memo.next - memo)

    def entry(self, number: int) -> Any:
        """An entry of the memo that reading an item by itself makes.

        Raises:
          KeyError: where there is none.
        """
        if self._outer is not None:
            return self._outer.memo[number]
        if number not in self._made_anew:
            skipped = next((skipped for skipped in self.memo.skipped
                            if skipped.memo <= number < skipped.memo + skipped.memos * skipped.items), None)
            if skipped is None:
                raise KeyError(number)
            item = (number - skipped.memo) // skipped.memos
            first, offset = skipped.memo + item * skipped.memos, skipped.offset + item * skipped.size
            inner = _Unpickler(self._content[offset:offset + skipped.size], first, self)
            inner.load()
            self._made_anew |= inner.memo
        return self._made_anew[number]

    def note_payload(self, is_text: bool) -> None:
        """Keeps where the payload lies that is last on the stack."""
        value, stop = self.stack[-1], self._tell()
        size = len(value.encode("utf-8", "surrogatepass") if is_text else value)
        self._payloads.append(repeats.Payload(stop - size, stop, is_text))

    def load_frame(self) -> None:
        self.read(8)  # how much to read ahead, which is all in memory

    def load_memoize(self) -> None:
        self._remember(self.memo.next)

    def load_binput(self) -> None:
        self._remember(self.read(1)[0])

    def load_long_binput(self) -> None:
        self._remember(int.from_bytes(self.read(4), "little"))

    def _remember(self, number: int) -> None:
        if isinstance(self.stack[-1], standins.Repeats):
            raise standins.Refused("refers to items of a list that are not the last.")
        self.memo[number] = self.stack[-1]

    def find_class(self, module: str, name: str) -> Callable:
        made = standins.NAMES.get((module, name))
        if made is None:
            raise standins.Refused(f"asks for {module[:60]}.{name[:60]}, which is not data; refused without executing "
                                   f"it.")
        return made

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.stack[-1] = _call(self.stack[-1], arguments)

    def load_newobj(self) -> None:
        self.load_reduce()

    def load_build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], standins.StandIn):
            raise standins.Refused(f"gives a state to {standins.kind(self.stack[-1])}.")
        self.stack[-1].setstate(state)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set(key, value)

    def load_setitems(self) -> None:
        items = self.pop_mark()
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._set(key, value)

    def _set(self, key: Any, value: Any) -> None:
        # A nested tuple for a key takes for ever to hash.
        if not isinstance(self.stack[-1], dict) or not isinstance(key, str):
            raise standins.Refused(f"sets an item of {standins.kind(self.stack[-1])} by {standins.kind(key)}.")
        self.stack[-1][key] = value

    def load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        if size > len(self._content):
            raise standins.Refused(f"says that it holds {size} bytes, more than the file has.")
        self.append(self.read(size))

    dispatch |= {pickle.REDUCE[0]: load_reduce, pickle.NEWOBJ[0]: load_newobj, pickle.BUILD[0]: load_build,
                 pickle.BYTEARRAY8[0]: load_bytearray8, pickle.SETITEM[0]: load_setitem,
                 pickle.SETITEMS[0]: load_setitems, pickle.FRAME[0]: load_frame, pickle.MEMOIZE[0]: load_memoize,
                 pickle.BINPUT[0]: load_binput, pickle.LONG_BINPUT[0]: load_long_binput}


def _noting(work: Callable[[_Unpickler], None], is_text: bool) -> Callable[[_Unpickler], None]:
    """An opcode that pushes a payload, which also keeps where it lies."""

    def load(unpickler: _Unpickler) -> None:
        work(unpickler)
        unpickler.note_payload(is_text)

    return load


for _code, _is_text in ((pickle.SHORT_BINBYTES, False), (pickle.BINBYTES, False), (pickle.BYTEARRAY8, False),
                        (pickle.SHORT_BINUNICODE, True), (pickle.BINUNICODE, True)):
    _Unpickler.dispatch[_code[0]] = _noting(_Unpickler.dispatch[_code[0]], _is_text)


def _call(function: Any, arguments: Any) -> Any:
    # Names are classes and functions of this module: nothing that hashes by its contents gets as far as the set.
    if not callable(function) or function not in _CALLABLE or not isinstance(arguments, tuple):
        raise standins.Refused(f"calls {standins.kind(function)}.")
    return function(*arguments)


_CALLABLE = frozenset(standins.NAMES.values())


