"""Writes the two file formats of torch.save as their documentation describes them; torch itself is not installed."""

import collections
import io
import pickle
import struct
import zipfile

import ml_dtypes
import numpy as np

_STORAGES = {np.dtype(np.float32): "FloatStorage", np.dtype(np.float16): "HalfStorage",
             np.dtype(ml_dtypes.bfloat16): "BFloat16Storage", np.dtype(np.int64): "LongStorage"}


class _Global:
    """Pickles as a reference to MODULE.NAME."""

    def __init__(self, module, name):
        self.module, self.name = module, name

    def __call__(self):
        """What unpickling makes of it; pickle asks that the first part of a reduction be callable."""
        return ForeignObject(self.module, self.name, None)


class _Storage:
    def __init__(self, array, key):
        self.array, self.key = array, key


class Tensor:
    """An array to be pickled as a torch tensor."""

    def __init__(self, array, offset=0, shape=None, strides=None):
        self.array, self.offset = np.asarray(array), offset
        self.shape = tuple(self.array.shape if shape is None else shape)
        steps = [stride // self.array.itemsize for stride in np.empty(self.shape, self.array.dtype).strides]
        self.strides = tuple(steps if strides is None else strides)


class _Pickler(pickle._Pickler):  # the Python form calls save_global by dispatch, which is how names are faked
    def __init__(self, file, legacy):
        super().__init__(file, protocol=2)
        self.storages, self.legacy = [], legacy

    def persistent_id(self, value):
        if not isinstance(value, _Storage):
            return None
        kind = _Global("torch", _STORAGES[value.array.dtype])
        reference = ("storage", kind, value.key, "cpu", value.array.size)
        return (*reference, None) if self.legacy else reference

    def reducer_override(self, value):
        return NotImplemented

    def save(self, value, save_persistent_id=True):
        if isinstance(value, _Global):
            self.write(pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode())
        elif isinstance(value, Tensor):
            flat = np.ascontiguousarray(value.array).reshape(-1)
            storage = _Storage(flat, str(len(self.storages)))
            self.storages.append(storage)
            self.save(_Global("torch._utils", "_rebuild_tensor_v2"))
            self.save((storage, value.offset, value.shape, value.strides, False, collections.OrderedDict()))
            self.write(pickle.REDUCE)
        else:
            super().save(value, save_persistent_id)


class ForeignObject:
    """Pickles as an instance of MODULE.NAME with a state."""

    def __init__(self, module, name, state):
        self.module, self.name, self.state = module, name, state

    def __reduce__(self):
        return _Global(self.module, self.name), (), self.state


def _pickled(value, legacy):
    file = io.BytesIO()
    pickler = _Pickler(file, legacy)
    pickler.dump(value)
    return file.getvalue(), pickler.storages


def write_zip(path, value, compression=zipfile.ZIP_STORED):
    content, storages = _pickled(value, legacy=False)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/byteorder", "little")
        for storage in storages:
            archive.writestr(f"archive/data/{storage.key}", storage.array.tobytes())
        archive.writestr("archive/version", "3\n")


def write_legacy(path, value):
    content, storages = _pickled(value, legacy=True)
    with open(path, "wb") as file:
        for header in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}):
            file.write(pickle.dumps(header, protocol=2))
        file.write(content)
        file.write(pickle.dumps([storage.key for storage in storages], protocol=2))
        for storage in storages:
            file.write(struct.pack("<q", storage.array.size) + storage.array.tobytes())


def tensors(arrays):
    return collections.OrderedDict((name, Tensor(array)) for name, array in arrays.items())
