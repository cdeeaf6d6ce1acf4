"""Reads and writes safetensors files: 8 bytes for the length of a header, the header in JSON, then little-endian data.

Written here rather than taken from the safetensors package: its NumPy interface knows no bfloat16 (0.8.0 raises
KeyError: 'BF16'), which checkpoints are stored in, and copies each tensor where a memory map is enough.
"""

from __future__ import annotations

import json
import math
import os
import pathlib
import struct
from collections.abc import Mapping

import ml_dtypes
import numpy as np

_DTYPES = {"F64": np.float64, "F32": np.float32, "F16": np.float16, "BF16": ml_dtypes.bfloat16, "I64": np.int64,
           "I32": np.int32, "I16": np.int16, "I8": np.int8, "U8": np.uint8, "BOOL": np.bool_}
_CODES = {np.dtype(dtype): code for code, dtype in _DTYPES.items()}
_LARGEST_HEADER = 100_000_000


class SafetensorsError(ValueError):
    """The file is damaged or no safetensors file; the message names it."""


def load(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Name -> read-only array on the memory-mapped file.

    Raises:
      SafetensorsError: where the file is missing, damaged or no safetensors file.
    """
    return load_with_metadata(path)[0]


def load_with_metadata(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """As `load`, and the text that the file says of itself, {name: text}.

    Raises:
      SafetensorsError: as `load`.
    """
    path = pathlib.Path(path).expanduser()
    try:
        mapped = np.memmap(path, np.uint8, mode="r")
        (size,) = struct.unpack("<Q", mapped[:8].tobytes())
        if size > min(_LARGEST_HEADER, mapped.size - 8):
            raise ValueError(f"its header would have {size} bytes, the file has {mapped.size}")
        header, data = json.loads(mapped[8:8 + size].tobytes()), mapped[8 + size:]
        entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
        tensors = {name: _view(name, entry, data) for name, entry in entries.items()}
        position = 0
        for name, entry in sorted(entries.items(), key=lambda item: item[1]["data_offsets"]):
            if entry["data_offsets"][0] != position:
                raise ValueError(f"{name} begins at byte {entry['data_offsets'][0]} of the data, expected {position}")
            position = entry["data_offsets"][1]
        if position != data.size:
            raise ValueError(f"its tensors have {position} bytes, the file has {data.size}")
        metadata = header.get("__metadata__", {})
        if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
            raise ValueError("its __metadata__ is no table of text")
        return tensors, metadata
    except Exception as error:  # a damaged header is any JSON, and its parser has limits of its own
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise SafetensorsError(f"{path}: expected a safetensors file; it cannot be read ({type(error).__name__}: "
                               f"{reason}).") from error


def _view(name: str, entry: Mapping, data: np.ndarray) -> np.ndarray:
    start, stop = entry["data_offsets"]
    dtype, shape = np.dtype(_DTYPES[entry["dtype"]]), tuple(entry["shape"])
    if not all(type(number) is int and number >= 0 for number in (*shape, start, stop)):
        raise ValueError(f"{name} has the shape {list(shape)} and the bytes {start} to {stop}")
    wanted = math.prod(shape) * dtype.itemsize
    if not start <= stop <= data.size or stop - start != wanted:
        raise ValueError(f"{name} has the bytes {start} to {stop} of {data.size}, expected {wanted} bytes")
    return data[start:stop].view(dtype).reshape(shape)


def save(path: str | os.PathLike, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str] | None = None) -> None:
    """Writes arrays by name; the file appears as a whole or not at all.

    Raises:
      ValueError: for a dtype that the format lacks.
    """
    path = pathlib.Path(path).expanduser()
    header: dict[str, dict] = {"__metadata__": dict(metadata)} if metadata else {}
    position = 0
    for name, tensor in tensors.items():
        if tensor.dtype not in _CODES:
            raise ValueError(f"{name}: safetensors has no dtype {tensor.dtype}.")
        header[name] = {"dtype": _CODES[tensor.dtype], "shape": list(tensor.shape),
                        "data_offsets": [position, position + tensor.nbytes]}
        position += tensor.nbytes
    encoded = json.dumps(header, separators=(",", ":")).encode()
    encoded += b" " * (-len(encoded) % 8)
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as file:
            file.write(struct.pack("<Q", len(encoded)) + encoded)
            for tensor in tensors.values():
                file.write(np.ascontiguousarray(tensor).reshape(-1).view(np.uint8).data)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
