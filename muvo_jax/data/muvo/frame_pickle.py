"""Writes a pandas data frame and a dict of arrays as pickles, without pandas: the counterpart of safe_pickle.py.

The names are those of pandas 1.5 and NumPy 1.23, which the authors' requirements pin; every later version up to pandas
3.1 and NumPy 2.4 reads them too (older ones could not read what the later write).
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

_PROTOCOL = 4


class _Name(NamedTuple):
    module: str
    name: str


class _Call(NamedTuple):
    """What unpickling does: calls a name, then gives the result a state (None: none)."""

    function: _Name
    arguments: tuple
    state: Any = None
    is_new: bool = False  # NEWOBJ instead of REDUCE


_NDARRAY, _DTYPE = _Name("numpy", "ndarray"), _Name("numpy", "dtype")
_RECONSTRUCT = _Name("numpy.core.multiarray", "_reconstruct")
_NEW_INDEX = _Name("pandas.core.indexes.base", "_new_Index")


def frame(columns: Mapping[str, Sequence]) -> bytes:
    """A pickled pandas.DataFrame.

    Args:
      columns: name -> array [F], or list of F strings, lists or arrays (a column of objects).

    Raises:
      ValueError: for no columns or columns of unequal length.
    """
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1:
        raise ValueError(f"a frame needs columns of one length, got {sorted(lengths)}.")
    blocks: dict[Any, list[int]] = {}
    arrays = []
    for number, values in enumerate(columns.values()):
        array = values if isinstance(values, np.ndarray) and values.ndim == 1 else _objects(values)
        arrays.append(array)
        blocks.setdefault(array.dtype, []).append(number)
    unpickle_block = _Name("pandas._libs.internals", "_unpickle_block")
    made = tuple(_Call(unpickle_block, (_array(np.stack([arrays[number] for number in numbers])),
                                        _array(np.array(numbers, np.int64)), 2)) for numbers in blocks.values())
    names = _Call(_NEW_INDEX, (_Name("pandas.core.indexes.base", "Index"),
                               {"data": _array(_objects(list(columns))), "name": None}))
    rows = _Call(_NEW_INDEX, (_Name("pandas.core.indexes.range", "RangeIndex"),
                              {"name": None, "start": 0, "stop": lengths.pop(), "step": 1}))
    manager = _Call(_Name("pandas.core.internals.managers", "BlockManager"), (made, [names, rows]))
    return _dumps(_Call(_Name("pandas.core.frame", "DataFrame"), (), {
        "_mgr": manager, "_typ": "dataframe", "_metadata": [], "attrs": {},
        "_flags": {"allows_duplicate_labels": True}}, is_new=True))


def npy_of_dict(values: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of an .npy file that holds a dict of arrays, as numpy.save(file, {...}) writes it."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    holder = np.empty((), object)
    holder[()] = dict(values)
    return file.getvalue() + _dumps(_array(holder))


def _objects(values: Sequence) -> np.ndarray:
    array = np.empty(len(values), object)
    for index, value in enumerate(values):  # one by one: NumPy would make a table of arrays of one size
        array[index] = value
    return array


def _array(array: np.ndarray) -> _Call:
    code, order, flags = ("O8", "|", 63) if array.dtype == object else (array.dtype.str[1:], array.dtype.str[0], 0)
    dtype = _Call(_DTYPE, (code, False, True), (3, order, None, None, None, -1, -1, flags))
    is_fortran = array.ndim > 1 and array.flags.f_contiguous and not array.flags.c_contiguous
    content: Any = array.tobytes("F" if is_fortran else "C")
    if array.dtype == object:
        content = list(array.reshape(-1, order="C")) if array.ndim else [array[()]]
        is_fortran = False
    return _Call(_RECONSTRUCT, (_NDARRAY, (0,), b"b"), (1, array.shape, dtype, is_fortran, content))


def _dumps(value: Any) -> bytes:
    file = io.BytesIO()
    _Pickler(file, _PROTOCOL).dump(value)
    return file.getvalue()


_Python: Any = pickle._Pickler  # only the Python form can write names of modules that are not installed


class _Pickler(_Python):
    dispatch: ClassVar[dict[type, Callable]] = dict(_Python.dispatch)

    def save_name(self, value: _Name) -> None:
        self.save(value.module)
        self.save(value.name)
        self.write(pickle.STACK_GLOBAL)

    def save_call(self, value: _Call) -> None:
        self.save_name(value.function)
        self.save(value.arguments)
        self.write(pickle.NEWOBJ if value.is_new else pickle.REDUCE)
        if value.state is not None:
            self.save(value.state)
            self.write(pickle.BUILD)

    def save_ndarray(self, value: np.ndarray) -> None:
        self.save_call(_array(value))

    dispatch |= {_Name: save_name, _Call: save_call, np.ndarray: save_ndarray}
