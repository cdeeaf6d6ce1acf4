"""What a pickle builds instead of the objects of NumPy and pandas: small classes that hold checked data.

Whatever a file passes is not to be trusted: sizes are checked before memory is taken, nothing that can be nested is
printed, hashed or compared, and no work grows faster than the file.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from muvo_jax.data import schema

HOW_TO_GO_ON = "Write the file again, or leave its run out."
_DEPTH = 4  # of lists in lists
_DTYPE = re.compile(r"[?biufcSUO]\d{0,6}")


class Refused(schema.DataError):
    """A pickle that asks for more than data, or that is damaged. Nothing of it was executed."""


class StandIn:
    """What a file builds instead of an object of NumPy or pandas."""

    def setstate(self, state: Any) -> None:
        raise Refused(f"gives a state to {type(self).__name__}.")


class Repeats(StandIn):
    """Items of a list that were read together (pickle_repeats.py): arrays [items, ...], or a list."""

    def __init__(self, values: np.ndarray | list):
        self.values = values

    def __len__(self) -> int:
        return len(self.values)

    def singles(self) -> list:
        """The items one by one, as they would be on the stack."""
        return [Array.of(row) for row in self.values] if isinstance(self.values, np.ndarray) else self.values


class _DType(StandIn):
    def __init__(self, code: Any, *_):
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise Refused(f"holds an array of dtype {code if isinstance(code, str) else kind(code)}.")
        self.code, self.order = code, "="

    def setstate(self, state: Any) -> None:
        _version, order, subarray, names, fields, *_ = state
        if order not in ("<", ">", "=", "|") or (subarray, names, fields) != (None, None, None):
            raise Refused("holds an array of structured dtype.")
        self.order = order

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.code if self.order == "|" or self.code == "?" else self.order + self.code)


class Array(StandIn):
    """Of numbers: `values` is an ndarray. Of objects: a list in the order of `is_fortran`."""

    def __init__(self, *_):
        self.values: np.ndarray | list = np.zeros(0)
        self.shape: tuple[int, ...] = (0,)
        self.is_fortran = False

    @classmethod
    def of(cls, values: np.ndarray) -> Array:
        array = cls()
        array.values, array.shape = values, values.shape
        return array

    def setstate(self, state: Any) -> None:
        _version, self.shape, dtype, is_fortran, data = state
        self.is_fortran = bool(is_fortran)
        if dtype.code[0] != "O":
            self.values = filled(data, dtype.dtype, self.shape, self.is_fortran, "array")
        elif isinstance(data, list) and _count(data) == _size(self.shape):
            self.values = data
        else:
            raise Refused(f"holds {kind(data)} for an array of objects of another size.")

    @property
    def size(self) -> int:
        """Bytes of the file that it must have taken, at least."""
        return _count(self.values) if isinstance(self.values, list) else self.values.size

    def listed(self) -> list:
        return list(_items(self.values))

    def row(self, index: int) -> np.ndarray | list:
        """Row `index` of an array with two axes."""
        if isinstance(self.values, np.ndarray):
            return self.values[index]
        rows, columns = self.shape
        if self.is_fortran:
            return self.listed()[index::rows]
        return _part(self.values, index * columns, (index + 1) * columns)


class _Strings(StandIn):
    """pandas.arrays.StringArray (its state holds an array of objects) or ArrowStringArray (one of pyarrow's)."""

    def __init__(self, *_):
        self.array = Array()

    def setstate(self, state: Any) -> None:
        parts = state.values() if isinstance(state, dict) else state
        (self.array,) = (part for part in parts if isinstance(part, Array))


class _Buffer(StandIn):
    """pyarrow.lib.py_buffer."""

    def __init__(self, content: Any):
        self.content = content


class _ArrowType(StandIn):
    """pyarrow.lib.type_for_alias."""

    def __init__(self, name: Any):
        if name not in ("string", "large_string"):
            raise Refused("holds a column of pyarrow that is not of strings.")
        self.offset = np.dtype("<i4" if name == "string" else "<i8")


class _Text(Array):
    """Strings of pyarrow, decoded only once the frame has been found not to be larger than its file.

    An array is (type, length, nulls, first, [validity bits, ends of the strings, their bytes], ...); several make one
    that is chunked.
    """

    def __init__(self, *arrays: Any):
        super().__init__()
        self.arrays = arrays
        self.shape = (sum(array[1] for array in arrays),)

    @classmethod
    def chunked(cls, chunks: Any, *_) -> _Text:
        return cls(*(chunk.arrays[0] for chunk in chunks))

    @property
    def size(self) -> int:
        return sum(len(buffer.content) for array in self.arrays for buffer in array[4] if buffer is not None)

    def listed(self) -> list:
        return [value for array in self.arrays for value in _decoded(*array)]


def _decoded(kind_: _ArrowType, length: int, _nulls: Any, first: int, buffers: Any, *_) -> list[str | None]:
    validity, ends, text = buffers
    bounds = np.frombuffer(ends.content, kind_.offset)[first:first + length + 1]
    content = text.content if text is not None else b""
    if len(bounds) != length + 1 or (np.diff(bounds) < 0).any() or bounds[0] < 0 or bounds[-1] > len(content):
        raise Refused("holds strings of pyarrow whose bounds do not fit.")
    pairs = itertools.pairwise(bounds.tolist())
    values: list[str | None] = [bytes(content[start:end]).decode() for start, end in pairs]
    if validity is None:
        return values
    bits = np.unpackbits(np.frombuffer(validity.content, np.uint8), bitorder="little")[first:first + length]
    return [value if bit else None for value, bit in zip(values, bits, strict=True)]


class _Ignored(StandIn):
    """A description that says nothing we need (pandas.StringDtype)."""

    def __init__(self, *_):
        pass


class _Index(StandIn):
    """Row or column labels; those of a RangeIndex are not kept, since nothing needs them."""

    def __init__(self, _class: Any = None, values: Any = None, *_):
        data = values.get("data") if isinstance(values, dict) else None
        if isinstance(data, _Strings):
            data = data.array
        self.labels = data if isinstance(data, Array) else Array()


class _Block(StandIn):
    """Some columns of one dtype: values [columns, rows] and which columns they are."""

    def __init__(self, values: Any, placement: Any, *_):
        self.values, self.placement = values, placement

    @property
    def size(self) -> int:
        return (self.values.array if isinstance(self.values, _Strings) else self.values).size

    def rows(self) -> list[tuple[int, np.ndarray | list]]:
        """(number of the column, its cells)."""
        placement = self.placement
        if isinstance(placement, slice):
            numbers = range(placement.start, placement.stop, placement.step or 1)
        else:
            numbers = placement.values
        if isinstance(self.values, _Strings) and len(numbers) == 1:
            return [(int(numbers[0]), self.values.array.listed())]
        if not isinstance(self.values, Array) or len(self.values.shape) != 2 or self.values.shape[0] != len(numbers):
            raise Refused(f"holds a block of {kind(self.values)}, which is not supported.")
        return [(int(number), self.values.row(row)) for row, number in enumerate(numbers)]


class _Manager(StandIn):
    def __init__(self, blocks: Any = (), axes: Any = (), *_):
        self.blocks, self.axes = blocks, axes

    def setstate(self, state: Any) -> None:
        """pandas before 1.3: the fourth part of the state is what later versions pass as arguments."""
        newest = state[3]["0.14.1"]
        self.axes = newest["axes"]
        self.blocks = [_Block(block["values"], block["mgr_locs"]) for block in newest["blocks"]]


class Frame(StandIn):
    def __init__(self, *_):
        self.manager = _Manager()

    def setstate(self, state: Any) -> None:
        self.manager = state["_mgr"] if "_mgr" in state else state["_data"]

    def columns(self, limit: int, where: str) -> dict[str, Sequence]:
        """By name; `limit` is the size of the file: a cell takes at least a byte of it."""
        try:
            labels = self.manager.axes[0].labels
            if labels.size + sum(block.size for block in self.manager.blocks) > limit:
                raise Refused(f"{where}: more cells than the file has bytes. {HOW_TO_GO_ON}")
            names = labels.listed()
            by_number = dict(row for block in self.manager.blocks for row in block.rows())
            table = {str(name): _cells(by_number[number], where) for number, name in enumerate(names)}
        except (AttributeError, TypeError, ValueError, KeyError, IndexError) as error:
            raise Refused(f"{where}: not a whole data frame ({type(error).__name__}: {error}). "
                          f"{HOW_TO_GO_ON}") from error
        if len(table) != len(names) or len({len(values) for values in table.values()}) > 1:
            raise Refused(f"{where}: columns of one name or of unequal length. {HOW_TO_GO_ON}")
        return table


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any, axis_order: Any = None, *_) -> Array:
    array = Array()
    if not isinstance(dtype, _DType) or dtype.code[0] == "O" or order not in ("C", "F", "K"):
        raise Refused(f"holds an array with {kind(dtype)} for its dtype.")
    values = filled(buffer, dtype.dtype, shape, order == "F", "array")
    array.values = values if axis_order is None else values.transpose(axis_order)
    array.shape = array.values.shape
    return array


def _scalar(dtype: Any, content: Any = b"", *_) -> np.generic:
    if not isinstance(dtype, _DType) or dtype.code[0] == "O":
        raise Refused("holds a scalar of object type.")
    return filled(content, dtype.dtype, (1,), False, "scalar")[0]


def _slice(*bounds: Any) -> slice:
    if not 1 <= len(bounds) <= 3 or not all(isinstance(bound, int) for bound in bounds):
        raise Refused("holds a slice of something else than whole numbers.")
    return slice(*bounds)


def _names() -> dict[tuple[str, str], Callable]:
    known: dict[tuple[str, str], Callable] = {
        ("numpy", "dtype"): _DType, ("numpy", "ndarray"): Array,
        ("builtins", "slice"): _slice,
        ("pandas._libs.internals", "_unpickle_block"): _Block,
        ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): _Strings,
        ("pandas.core.internals.managers", "BlockManager"): _Manager,
        ("pandas.core.indexes.base", "_new_Index"): _Index,
        ("pandas.core.indexes.numeric", "Int64Index"): _Ignored,
    }
    for core in ("numpy.core", "numpy._core"):
        known |= {(f"{core}.multiarray", "_reconstruct"): Array, (f"{core}.multiarray", "scalar"): _scalar,
                  (f"{core}.numeric", "_frombuffer"): _from_buffer}
    known |= {("pyarrow.lib", "_restore_array"): _Text, ("pyarrow.lib", "chunked_array"): _Text.chunked,
              ("pyarrow.lib", "type_for_alias"): _ArrowType, ("pyarrow.lib", "py_buffer"): _Buffer}
    for name, old, made in (("DataFrame", "pandas.core.frame", Frame), ("Index", "pandas.core.indexes.base", _Index),
                            ("RangeIndex", "pandas.core.indexes.range", _Index),
                            ("StringArray", "pandas.core.arrays.string_", _Strings),
                            ("ArrowStringArray", "pandas.core.arrays.string_arrow", _Strings),
                            ("StringDtype", "pandas.core.arrays.string_", _Ignored)):
        known |= {(module, name): made for module in ("pandas", "pandas.arrays", old)}
    return known


NAMES = _names()


def _size(shape: Any) -> int:
    if not isinstance(shape, tuple) or not all(isinstance(side, int) and 0 <= side < 1 << 40 for side in shape):
        raise Refused("holds an array whose shape is not a few whole numbers.")
    return math.prod(shape)


def _count(values: list) -> int:
    return sum(len(value) if isinstance(value, Repeats) else 1 for value in values)


def _items(values: Iterable) -> Iterator:
    """Of a list, those that were read together one by one."""
    return itertools.chain.from_iterable(value.values if isinstance(value, Repeats) else (value,) for value in values)


def _shorter(values: list) -> Iterator:
    """Of a list, all but the arrays that were read together one by one."""
    for value in values:
        if isinstance(value, Repeats) and isinstance(value.values, list):
            yield from value.values
        else:
            yield value


def _part(values: list, start: int, stop: int) -> list:
    """Items `start` to `stop` of a list."""
    part, first = [], 0
    for value in values:
        length = len(value) if isinstance(value, Repeats) else 1
        begin, end = max(start - first, 0), min(stop - first, length)
        if begin < end:
            part.append(Repeats(value.values[begin:end]) if isinstance(value, Repeats) else value)
        first += length
    return part


def _cells(values: Any, where: str) -> Any:
    """A column: an array, of rows where each cell is an array of one size and type, else a list."""
    if not isinstance(values, list):
        return plain(values, where)
    whole = list(_shorter(values))
    parts = [value.values if isinstance(value, Repeats) else value.values[None] for value in whole
             if isinstance(value, (Repeats, Array)) and isinstance(value.values, np.ndarray)]
    if parts and len(parts) == len(whole) and parts[0].ndim > 1 and (
            len({(part.shape[1:], part.dtype) for part in parts}) == 1):
        return np.concatenate(parts)
    items = list(_items(values))
    return items if set(map(type, items)) == {str} else plain(items, where)  # strings hold nothing to be looked at


def filled(content: Any, dtype: np.dtype, shape: Any, is_fortran: bool, where: str) -> np.ndarray:
    """An array from its bytes, after checking that there are as many as shape and dtype say."""
    size = _size(shape)
    if not isinstance(content, (bytes, bytearray)) or len(content) != size * dtype.itemsize:
        found = f"{len(content)} bytes" if isinstance(content, (bytes, bytearray)) else kind(content)
        raise Refused(f"{where}: {found} for an array of {dtype} {list(shape)}, expected {size * dtype.itemsize}.")
    try:
        values = np.frombuffer(content, dtype) if size else np.zeros(0, dtype)
        return values.reshape(shape, order="F" if is_fortran else "C")
    except ValueError as error:
        raise Refused(f"{where}: no array of {dtype} {list(shape)} ({error}).") from error


def plain(value: Any, where: str, done: dict[int, Any] | None = None, depth: int = 0) -> Any:
    """Stand-ins inside lists and dicts become arrays (of objects: lists); what occurs twice is made once."""
    done = {} if done is None else done
    if isinstance(value, Array):
        value = value.values
    if isinstance(value, np.ndarray):
        return value
    if id(value) in done:
        return done[id(value)]
    if depth > _DEPTH:
        raise Refused(f"{where}: nested too deeply. {HOW_TO_GO_ON}")
    if isinstance(value, (list, tuple)):
        done[id(value)] = made = [plain(item, where, done, depth + 1) for item in _items(value)]
        return made
    if isinstance(value, dict):
        done[id(value)] = by_key = {key: plain(item, where, done, depth + 1) for key, item in value.items()}
        return by_key
    if isinstance(value, StandIn) or callable(value):
        raise Refused(f"{where}: holds {kind(value)} among its values. {HOW_TO_GO_ON}")
    return value


def kind(value: Any) -> str:
    return f"a {type(value).__name__}" if not callable(value) else f"the name {getattr(value, '__name__', value)!r}"
