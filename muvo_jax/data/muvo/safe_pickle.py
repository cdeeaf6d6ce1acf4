"""Reads pickled data frames and pickled NumPy arrays without executing anything that the file asks for.

`pickle` calls whatever a file names. Here every name stands for a small class of this module, whatever is not in that
list is refused, and so is every opcode that data does not need. The arrays are put together by NumPy from checked
bytes; neither pandas nor NumPy's own unpickling sees them. That also makes the reader independent of the versions that
wrote the file: frames of pandas 1.5 to 3.1 with NumPy 1.23 to 2.4 were tried.
"""

from __future__ import annotations

import io
import pathlib
import pickle
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from muvo_jax.data import files, schema
from muvo_jax.data.muvo import pickle_standins as standins

_OPCODES = frozenset((
    pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.POP, pickle.POP_MARK, pickle.NONE, pickle.NEWTRUE,
    pickle.NEWFALSE, pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT,
    pickle.SHORT_BINBYTES, pickle.BINBYTES, pickle.BINBYTES8, pickle.BYTEARRAY8, pickle.SHORT_BINUNICODE,
    pickle.BINUNICODE, pickle.BINUNICODE8, pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2,
    pickle.TUPLE3, pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS, pickle.EMPTY_DICT, pickle.SETITEM,
    pickle.SETITEMS, pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.REDUCE, pickle.NEWOBJ, pickle.BUILD, pickle.MEMOIZE,
    pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET,
))


def load_table(path: pathlib.Path) -> dict[str, Sequence]:
    """Returns the columns of a pickled pandas.DataFrame, by name: arrays, or lists where cells are objects.

    Raises:
      Refused: where the file is damaged, is no data frame or asks for anything else.
      DataError: where there is no file.
    """
    content = _content(path, "a pickled data frame")
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
    content = _content(path, "an NPY file")
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
    try:
        return _Unpickler(content).load()
    except standins.Refused as error:
        raise standins.Refused(f"{where}: {error} {standins.HOW_TO_GO_ON}") from None
    except Exception as error:  # a malformed stream may raise anything, says the documentation of pickle
        raise standins.Refused(f"{where}: not a readable pickle ({type(error).__name__}: {error}). "
                               f"{standins.HOW_TO_GO_ON}") from error


def _content(path: pathlib.Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise files.missing(path, what) from error
    except OSError as error:
        raise schema.DataError(f"{path}: cannot be read ({error}).") from error


_Python: Any = pickle._Unpickler  # only in the Python form can opcodes be taken away


class _Unpickler(_Python):
    dispatch: ClassVar[dict[int, Callable]] = {code: work for code, work in _Python.dispatch.items()
                                               if bytes([code]) in _OPCODES}

    def __init__(self, content: bytes):
        super().__init__(io.BytesIO(content))
        self._limit = len(content)

    def load(self) -> Any:
        try:
            return super().load()
        except KeyError as error:
            code = error.args[0] if error.args else None
            if isinstance(code, int) and code not in self.dispatch:
                raise standins.Refused(f"uses opcode {bytes([code])!r}, which data does not need.") from error
            raise

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
        if size > self._limit:
            raise standins.Refused(f"says that it holds {size} bytes, more than the file has.")
        self.append(self.read(size))

    dispatch |= {pickle.REDUCE[0]: load_reduce, pickle.NEWOBJ[0]: load_newobj, pickle.BUILD[0]: load_build,
                 pickle.BYTEARRAY8[0]: load_bytearray8, pickle.SETITEM[0]: load_setitem,
                 pickle.SETITEMS[0]: load_setitems}


def _call(function: Any, arguments: Any) -> Any:
    # Names are classes and functions of this module: nothing that hashes by its contents gets as far as the set.
    if not callable(function) or function not in _CALLABLE or not isinstance(arguments, tuple):
        raise standins.Refused(f"calls {standins.kind(function)}.")
    return function(*arguments)


_CALLABLE = frozenset(standins.NAMES.values())


