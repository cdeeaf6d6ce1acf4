"""Reads files of torch.save without torch: the zip format and the older one of consecutive pickles.

Such a file is a pickle that names classes and functions, which `pickle` would import and call. Here a name is looked up
in a list: what builds tensors becomes functions of this module; classes of the libraries that training scripts use
become inert `Foreign` objects, which are never imported; every other name (os.system, say) is refused before anything
was called. Tensors are views of the memory-mapped file, whose checksums are compared first where the format has them.
"""

from __future__ import annotations

import collections
import functools
import io
import math
import os
import pathlib
import pickle
import struct
import types
import zipfile
from typing import Any

import ml_dtypes
import numpy as np

_STORAGE_DTYPES: dict[str, Any] = {
    "FloatStorage": np.float32, "HalfStorage": np.float16, "BFloat16Storage": ml_dtypes.bfloat16,
    "DoubleStorage": np.float64, "LongStorage": np.int64, "IntStorage": np.int32, "ShortStorage": np.int16,
    "CharStorage": np.int8, "ByteStorage": np.uint8, "BoolStorage": np.bool_, "UntypedStorage": np.uint8,
}
_DTYPES: dict[str, Any] = {
    "float32": np.float32, "float": np.float32, "float16": np.float16, "half": np.float16, "float64": np.float64,
    "double": np.float64, "bfloat16": ml_dtypes.bfloat16, "int64": np.int64, "long": np.int64, "int32": np.int32,
    "int16": np.int16, "int8": np.int8, "uint8": np.uint8, "bool": np.bool_,
}
# First parts of the module names whose classes may occur beside the tensors (callbacks, configurations, optimisers).
_FOREIGN_PACKAGES = frozenset((
    "torch", "torchvision", "pytorch_lightning", "lightning", "lightning_fabric", "lightning_utilities", "torchmetrics",
    "timm", "numpy", "fvcore", "yacs", "omegaconf", "argparse", "pathlib", "datetime", "muvo", "mile"))
_PLAIN_BUILTINS = {kind.__name__: kind
                   for kind in (set, frozenset, dict, list, tuple, int, float, complex, bool, slice)}
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
# torch.save does not compress; who zips a checkpoint anew gains little. More than this is a bomb.
MOST_INFLATION, _INFLATION_SLACK_BYTES = 64, 2**20
_EXPECTED = "expected a checkpoint of torch.save (a Lightning .ckpt, or a state_dict in a .pth file)"


class TorchFileError(ValueError):
    """The file cannot be read, or asks for something that must not be executed; the message names it."""


class Foreign:
    """Stands for an object of a foreign class: keeps what the file says and does nothing."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Foreign:
        made = super().__new__(cls)
        made.args, made.kwargs, made.items, made.state = args, kwargs, {}, None
        return made

    def __init__(self, *args: Any, **kwargs: Any):
        """A pickle may make an object without this call; __new__ keeps the arguments."""

    args: tuple
    kwargs: dict
    items: dict
    state: Any

    def __setitem__(self, key: Any, value: Any) -> None:
        self.items[key] = value

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def append(self, value: Any) -> None:
        self.items[len(self.items)] = value

    def extend(self, values: Any) -> None:
        for value in values:
            self.append(value)


def _known(dtype: Any) -> np.dtype:
    """NumPy's of a type of numbers that torch names; a class that stands for another one would become "object".

    Raises:
      TorchFileError: for complex numbers, 8-bit floats and the like.
    """
    if not any(dtype is known for known in (*_STORAGE_DTYPES.values(), *_DTYPES.values())):
        raise TorchFileError(f"it holds tensors of {getattr(dtype, '__name__', dtype)}, which are not supported: "
                             f"convert them to float32 with PyTorch first")
    return np.dtype(dtype)


class _Storage:
    """A typed stretch of the file; `array` is filled in when its place is known."""

    def __init__(self, dtype: Any, count: int):
        self.dtype, self.count = _known(dtype), count
        self.array: np.ndarray | None = None


class _Tensor:
    """A view of a storage, made into an array once every storage has its place."""

    def __init__(self, storage: Any, offset: Any, shape: Any, strides: Any, dtype: Any = None):
        if not isinstance(storage, _Storage):
            raise pickle.UnpicklingError("a tensor without a storage")
        self.storage, self.offset, self.shape, self.strides = storage, offset, tuple(shape), tuple(strides)
        self.dtype = storage.dtype if dtype is None else _known(dtype)

    def __setstate__(self, state: Any) -> None:
        """Attributes that Python code gave to a tensor; not data."""

    def array(self) -> np.ndarray:
        assert self.storage.array is not None
        flat = self.storage.array.view(self.dtype)
        numbers = (self.offset, *self.shape, *self.strides)
        if not all(isinstance(number, int) and number >= 0 for number in numbers) or len(self.shape) != len(
                self.strides):
            raise pickle.UnpicklingError(f"a tensor of shape {self.shape} with strides {self.strides}")
        last = self.offset + sum((size - 1) * step for size, step in zip(self.shape, self.strides, strict=True))
        if math.prod(self.shape) == 0:
            return np.zeros(self.shape, self.dtype)
        if last >= flat.size:
            raise pickle.UnpicklingError(f"a tensor of shape {self.shape} that reaches beyond its storage")
        item = self.dtype.itemsize
        return np.lib.stride_tricks.as_strided(flat[self.offset:], self.shape,
                                               [step * item for step in self.strides], writeable=False)


def _rebuild_tensor(storage, offset, shape, strides, *unused):
    return _Tensor(storage, offset, shape, strides)


def _rebuild_tensor_v3(storage, offset, shape, strides, requires_grad, hooks, dtype, *unused):
    return _Tensor(storage, offset, shape, strides, dtype)


def _rebuild_parameter(data, *unused):
    return data


def _reconstructor(cls, base, state):
    return cls() if isinstance(cls, type) and issubclass(cls, Foreign) else Foreign(cls, base, state)


def _attribute(owner, name):
    """A method of a foreign object or class: before torch 2.4 a OneCycleLR names its own (anneal_func)."""
    if isinstance(owner, Foreign) or (isinstance(owner, type) and issubclass(owner, Foreign)):
        return Foreign(owner, name)
    raise TorchFileError(f"it asks for builtins.getattr of {type(owner).__name__[:60]}, which is no data of a "
                         f"checkpoint; refused, nothing was executed")


_NAMES: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("collections", "defaultdict"): lambda *args: {},
    ("_codecs", "encode"): lambda text, encoding: str(text).encode("latin1"),  # how old protocols write bytes
    **{(module, "_reconstructor"): _reconstructor for module in ("copyreg", "copy_reg")},
    **{(module, "getattr"): _attribute for module in ("builtins", "__builtin__")},
    ("torch._utils", "_rebuild_tensor"): _rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v3"): _rebuild_tensor_v3,
    ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
    ("torch._utils", "_rebuild_parameter_with_state"): _rebuild_parameter,
    **{("torch", name): dtype for name, dtype in _DTYPES.items()},
    **{(module, name): value for module in ("builtins", "__builtin__") for name, value in _PLAIN_BUILTINS.items()},
}


class _StorageType:
    """What a storage class of torch stands for."""

    def __init__(self, dtype: Any):
        self.dtype = dtype


_Python: Any = pickle._Unpickler  # the C form allocates as many memo entries as a damaged index says


class _Unpickler(_Python):
    """Names become what the lists of this module say; `storage` answers a reference to a storage."""

    def __init__(self, file: Any, storage: Any):
        super().__init__(file, encoding="utf-8")
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _NAMES:
            found = _NAMES[module, name]
            # a pickle may set attributes of what it names; of a new object, it changes nothing that lasts
            return functools.partial(found) if isinstance(found, types.FunctionType) else found
        if module.split(".")[0] == "torch" and name in _STORAGE_DTYPES:
            return _StorageType(_STORAGE_DTYPES[name])
        if module.split(".")[0] in _FOREIGN_PACKAGES:
            return type(str(name), (Foreign,), {"__module__": f"foreign.{module}"})
        raise TorchFileError(f"it asks for {module[:60]}.{name[:60]}, which is no data of a checkpoint; refused, "
                             f"nothing was executed")

    def persistent_load(self, reference: Any) -> Any:
        return self._storage(reference)


def load(path: str | os.PathLike) -> Any:
    """The object in a file of torch.save; tensors are read-only NumPy arrays (bfloat16 by ml_dtypes).

    Raises:
      TorchFileError: where the file is missing, damaged, no file of torch.save, or asks for foreign code.
    """
    path = pathlib.Path(path).expanduser()
    try:
        with path.open("rb") as file:
            head = file.read(4)
        if head == b"PK\x03\x04":
            return _resolve(_load_zip(path))
        if head[:1] != pickle.PROTO:
            raise TorchFileError("it is damaged or something else")
        return _resolve(_load_legacy(path))
    except TorchFileError as error:
        raise TorchFileError(f"{path}: {_EXPECTED}; {error}.") from None
    except OSError as error:
        raise TorchFileError(f"{path}: {_EXPECTED}; it cannot be opened ({error.strerror or error}).") from error
    except Exception as error:  # a malformed pickle may raise anything, says the documentation of pickle
        raise TorchFileError(f"{path}: {_EXPECTED}; it is damaged or something else ({type(error).__name__}: "
                             f"{str(error).splitlines()[0] if str(error) else 'no details'}).") from error


def _load_zip(path: pathlib.Path) -> Any:
    try:
        archive = zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise TorchFileError(f"it begins like a zip file but is cut short or damaged ({error})") from error
    with archive:
        members = _Members(archive, path)
        pickles = [name for name in members.names if name.endswith("/data.pkl") or name == "data.pkl"]
        if len(pickles) != 1:
            raise TorchFileError(f"it is a zip file without data.pkl (it holds {', '.join(list(members.names)[:4])})")
        root = pickles[0][:-len("data.pkl")]
        if root + "byteorder" in members.names and members.read(root + "byteorder") != b"little":
            raise TorchFileError("it was written on a big-endian machine, which is not supported")
        storages: dict[str, _Storage] = {}

        def storage(reference: Any) -> _Storage:
            dtype, key, count = _parts(reference)
            if key not in storages:
                storages[key] = made = _Storage(dtype, count)
                made.array = members.data(f"{root}data/{key}", count * made.dtype.itemsize).view(made.dtype)
            return storages[key]

        return _Unpickler(io.BytesIO(members.read(pickles[0])), storage).load()


class _Members:
    """The files in a zip archive: their checksums are compared, and what they unpack to is limited."""

    def __init__(self, archive: zipfile.ZipFile, path: pathlib.Path):
        self.names = {info.filename: info for info in archive.infolist()}
        self._archive, self._mapped = archive, np.memmap(path, np.uint8, mode="r")
        self._bytes_left = MOST_INFLATION * self._mapped.size + _INFLATION_SLACK_BYTES

    def read(self, name: str) -> bytes:
        self._bytes_left -= self.names[name].file_size
        if self._bytes_left < 0:
            raise TorchFileError(f"it would unpack to more than {MOST_INFLATION} times its {self._mapped.size} bytes")
        return self._archive.read(name)

    def data(self, name: str, size: int) -> np.ndarray:
        """The first bytes of a member: a view of the mapped file, or a copy where it is compressed."""
        if name not in self.names:
            raise TorchFileError(f"the tensor data {name} is missing")
        info = self.names[name]
        if info.file_size < size:
            raise TorchFileError(f"{name} has {info.file_size} bytes, expected {size}")
        if info.compress_type != zipfile.ZIP_STORED:
            return np.frombuffer(self.read(name), np.uint8)[:size]
        with self._archive.open(info) as file:
            while file.read(2**22):  # compares names, sizes and checksum
                pass
        header = self._mapped[info.header_offset:info.header_offset + 30].tobytes()
        start = info.header_offset + 30 + sum(struct.unpack("<HH", header[26:]))  # name and extra field come first
        return self._mapped[start:start + size]


def _load_legacy(path: pathlib.Path) -> Any:
    storages: dict[str, _Storage] = {}

    def storage(reference: Any) -> _Storage:
        dtype, key, count = _parts(reference)
        if len(reference) > 5 and reference[5] is not None:
            raise TorchFileError("it holds storages that are views of others, which is not supported")
        return storages.setdefault(key, _Storage(dtype, count))

    with path.open("rb") as file:
        magic = _Unpickler(file, storage).load()
        if magic != _LEGACY_MAGIC or _Unpickler(file, storage).load() != _LEGACY_PROTOCOL:
            raise TorchFileError("it is a pickle of something else")
        machine = _Unpickler(file, storage).load()
        if isinstance(machine, dict) and not machine.get("little_endian", True):
            raise TorchFileError("it was written on a big-endian machine, which is not supported")
        value = _Unpickler(file, storage).load()
        keys = _Unpickler(file, storage).load()
        if not isinstance(keys, list) or storages.keys() != set(keys):
            raise TorchFileError("its list of tensor data is not that of its tensors")
        mapped = np.memmap(path, np.uint8, mode="r")
        position = file.tell()
    for key in keys:
        (count,) = struct.unpack("<q", mapped[position:position + 8].tobytes())
        made = storages[key]
        size = made.count * made.dtype.itemsize
        data = mapped[position + 8:position + 8 + size]
        if count != made.count or data.size != size:
            raise TorchFileError(f"the tensor data {key} is cut short")
        made.array = data.view(made.dtype)
        position += 8 + size
    return value


def _parts(reference: Any) -> tuple[Any, str, int]:
    """dtype, key and number of elements of a reference ("storage", type, key, device, elements)."""
    if not isinstance(reference, tuple) or len(reference) < 5 or reference[0] != "storage":
        raise TorchFileError(f"it refers to a {type(reference).__name__}, expected a storage")
    _, kind, key, _, count = reference[:5]
    if not isinstance(kind, _StorageType) or not isinstance(key, str) or not isinstance(count, int) or count < 0:
        raise TorchFileError("it holds a storage of an unknown type, name or size")
    return kind.dtype, key, count


def _resolve(value: Any, done: dict[int, Any] | None = None) -> Any:
    """The same nest of dicts, lists and tuples with arrays for tensors; foreign objects stay as they are.

    `done` keeps what was made of an object: one that occurs often, or in itself, is resolved once.
    """
    done = {} if done is None else done
    if id(value) in done:
        return done[id(value)]
    if isinstance(value, _Tensor):
        made: Any = value.array()
    elif isinstance(value, dict):
        made = done[id(value)] = {}
        made.update((key, _resolve(item, done)) for key, item in value.items())
    elif type(value) is list:
        made = done[id(value)] = []
        made.extend(_resolve(item, done) for item in value)
    elif type(value) is tuple:
        made = tuple(_resolve(item, done) for item in value)
    else:
        return value
    done[id(value)] = made
    return made
