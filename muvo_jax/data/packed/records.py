"""A frame as the bytes of one record of a packed recording, and back.

A length-prefixed JSON header says which frame it is and names the fields (dtype, shape, encoding, size), their bytes
follow and a CRC-32 of all of it closes the record. Nothing is pickled.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import struct
import zlib
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from PIL import Image

from muvo_jax.data import files, pictures, schema
from muvo_jax.data.packed import manifest

_LENGTH = struct.Struct("<I")
_ENCODINGS = ("raw", "zlib", "png", "jpeg", "float16")
_RECORDED = {f"recorded {mode}": mode for mode in pictures.MODES}  # the bytes of a file, and how they are read
# What headers, arrays and pictures that are anything at all can lead to.
_MALFORMED = (ValueError, KeyError, TypeError, AttributeError, OSError, OverflowError, RecursionError, MemoryError,
              SyntaxError, struct.error, zlib.error, Image.DecompressionBombError)


@dataclasses.dataclass(frozen=True)
class Encoding:
    """How frames are stored; the default loses nothing.

    Attributes:
      jpeg_quality: of images, 1 to 95; None stores them as PNG.
      half_points: points as float16: 1 cm of error at 20 m, 6 cm beyond 64 m.
    """

    jpeg_quality: int | None = None
    half_points: bool = False

    def __post_init__(self):
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 95:
            raise ValueError(f"jpeg_quality is {self.jpeg_quality}, expected 1 to 95, or None for PNG.")


def place_of(run: str, row: int) -> str:
    """Which frame a record is: that of a row of a run."""
    return f"row {row} of run {run}"


def encode_frame(frame: schema.RawFrame, encoding: Encoding, recorded: Sequence[pictures.Picture] = (),
                 place: str = "") -> bytes:
    """One frame as one record.

    Args:
      recorded: pictures that were read for it: a field that is the pixels of one of them is kept as its bytes.
      place: see `place_of`; kept in the record.
    """
    contents = {id(picture.pixels): picture for picture in recorded}
    described, parts = [], []
    for name, value in frame.items():
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise ValueError(f"{name}: arrays of objects are not stored.")
        kind, content = _encode(name, array, encoding, contents.get(id(array)))
        described.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "encoding": kind,
                          "bytes": len(content)})
        parts.append(content)
    text = json.dumps({"place": place, "fields": described}).encode()
    body = b"".join((_LENGTH.pack(len(text)), text, *parts))
    return body + _LENGTH.pack(zlib.crc32(body))


def decode_frame(record: bytes, where: str, only: Collection[str] | None = None, place: str = "") -> schema.RawFrame:
    """The inverse of `encode_frame`.

    Args:
      record: the bytes.
      where: they lie, for messages.
      only: the fields that are wanted; None is all.
      place: of the frame that is wanted; records from before SCHEMA_VERSION 3 do not say theirs.

    Raises:
      DataError: for a damaged record, or one of another frame.
    """
    if len(record) < 2 * _LENGTH.size or zlib.crc32(record[:-4]) != _LENGTH.unpack(record[-4:])[0]:
        raise damaged(where, "its checksum does not fit")
    (size,) = _LENGTH.unpack_from(record)
    frame: dict[str, Any] = {}
    position = _LENGTH.size + size
    try:
        header = json.loads(record[_LENGTH.size:position])
        if isinstance(header, dict):
            if header["place"] != place:
                raise ValueError(f"it is {str(header['place'])[:80]}, not {place}: were shards exchanged?")
            header = header["fields"]
        for field in header:
            content = record[position:position + field["bytes"]]
            position += field["bytes"]
            if only is not None and field["name"] not in only:
                continue
            array = _decode(content, field["encoding"], np.dtype(field["dtype"]), tuple(field["shape"]))
            frame[field["name"]] = array if array.ndim else array[()]
    except _MALFORMED as error:
        raise damaged(where, str(error)) from error
    return frame  # type: ignore[return-value]


def damaged(where: str, why: str) -> schema.DataError:
    """The error for a record or shard that is not what was written; `where` it lies."""
    return schema.DataError(f"{where}: damaged ({why}). Remove the shard and its .json and pack again, or leave it out "
                            f"with data.skip_corrupt_shards (records.PackedRecording(corrupt=\"skip\")).")


def _encode(name: str, array: np.ndarray, encoding: Encoding, recorded: pictures.Picture | None) -> tuple[str, bytes]:
    as_jpeg = name == "image" and encoding.jpeg_quality is not None
    if recorded is not None and not as_jpeg:
        return f"recorded {recorded.mode}", recorded.content
    if name == "points_m" and encoding.half_points:
        if array.size and np.abs(array).max() > np.finfo(np.float16).max:
            raise ValueError(f"points_m has a coordinate of {np.abs(array).max():g} m; float16 ends at "
                             f"{np.finfo(np.float16).max:g} m. Pack without --half-points, or leave such points out.")
        return "float16", zlib.compress(np.ascontiguousarray(array, np.float16).tobytes(), 1)
    if array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        content = io.BytesIO()
        if as_jpeg:
            Image.fromarray(array).save(content, "JPEG", quality=encoding.jpeg_quality, subsampling=0)
            return "jpeg", content.getvalue()
        Image.fromarray(array).save(content, "PNG", compress_level=1)
        return "png", content.getvalue()
    content_bytes = np.ascontiguousarray(array).tobytes()
    return ("raw", content_bytes) if len(content_bytes) < 256 else ("zlib", zlib.compress(content_bytes, 1))


def _decode(content: bytes, encoding: str, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    if dtype.hasobject or encoding not in (*_ENCODINGS, *_RECORDED):
        raise ValueError(f"encoding {encoding!r} of {dtype} is unknown")
    size = math.prod(shape)
    if not all(manifest.is_count(side) for side in shape) or size * dtype.itemsize > files.LARGEST_ARRAY_BYTES:
        raise ValueError(f"{dtype}{list(shape)} is larger than {files.LARGEST_ARRAY_BYTES} bytes")
    if encoding in ("png", "jpeg") or encoding in _RECORDED:
        array = pictures.decode(content, _RECORDED.get(encoding), "its picture", shape)
    elif encoding == "float16":
        array = np.frombuffer(_inflated(content, 2 * size), np.float16).astype(dtype).reshape(shape)
    elif encoding == "zlib":
        array = np.frombuffer(_inflated(content, size * dtype.itemsize), dtype).reshape(shape)
    else:
        array = np.frombuffer(content, dtype).reshape(shape)
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(f"found {array.dtype}{list(array.shape)}, expected {dtype}{list(shape)}")
    return array


def _inflated(content: bytes, size: int) -> bytes:
    """Exactly `size` bytes; nothing that claims to be more is unpacked."""
    inflater = zlib.decompressobj()
    inflated = inflater.decompress(content, size or 1)
    if len(inflated) != size or inflater.decompress(inflater.unconsumed_tail, 1) or not inflater.eof:
        raise ValueError(f"its compressed bytes are not the {size} that its shape takes")
    return inflated
