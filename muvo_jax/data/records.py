"""Recordings packed into ArrayRecord shards: what pack.py writes, and its reader behind schema.Recording.

    ROOT/manifest.json                 what there is, written last: without it the folder is no recording yet
    ROOT/shard-00000.arrayrecord       frames_per_shard frames, in the order of the sequences; the last has fewer
    ROOT/shard-00000.json              frames, bytes and checksum of a complete shard

A record is a frame: its length-prefixed JSON header names the fields (dtype, shape, encoding, size), their bytes follow
and a CRC-32 of all of it closes it. Nothing is pickled.
"""

from __future__ import annotations

import collections
import dataclasses
import io
import json
import math
import pathlib
import struct
import threading
import warnings
import zlib
from collections.abc import Collection, Iterator
from typing import Any, Literal

import numpy as np
from array_record.python import array_record_module
from PIL import Image

from muvo_jax.data import manifest as manifest_lib
from muvo_jax.data import schema

_READER_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # random access
_READER_BUFFER_BYTES = 1 << 16
_LENGTH = struct.Struct("<I")
_ENCODINGS = ("raw", "zlib", "png", "jpeg", "float16")
_OPEN_READERS = 32  # each holds a file open, of which a process may have 256 or 1024
_LARGEST_ARRAY_BYTES = 1 << 30  # what a field of a frame may claim before memory is taken for it
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


def encode_frame(frame: schema.RawFrame, encoding: Encoding) -> bytes:
    """One frame as one record."""
    header, parts = [], []
    for name, value in frame.items():
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise ValueError(f"{name}: arrays of objects are not stored.")
        kind, content = _encode(name, array, encoding)
        header.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "encoding": kind,
                       "bytes": len(content)})
        parts.append(content)
    text = json.dumps(header).encode()
    body = b"".join((_LENGTH.pack(len(text)), text, *parts))
    return body + _LENGTH.pack(zlib.crc32(body))


def decode_frame(record: bytes, where: str, only: Collection[str] | None = None) -> schema.RawFrame:
    """The inverse of `encode_frame`.

    Args:
      record: the bytes.
      where: they lie, for messages.
      only: the fields that are wanted; None is all.

    Raises:
      DataError: for a damaged record.
    """
    if len(record) < 2 * _LENGTH.size or zlib.crc32(record[:-4]) != _LENGTH.unpack(record[-4:])[0]:
        raise _damaged(where, "its checksum does not fit")
    (size,) = _LENGTH.unpack_from(record)
    frame: dict[str, Any] = {}
    position = _LENGTH.size + size
    try:
        for field in json.loads(record[_LENGTH.size:position]):
            content = record[position:position + field["bytes"]]
            position += field["bytes"]
            if only is not None and field["name"] not in only:
                continue
            array = _decode(content, field["encoding"], np.dtype(field["dtype"]), tuple(field["shape"]))
            frame[field["name"]] = array if array.ndim else array[()]
    except _MALFORMED as error:
        raise _damaged(where, str(error)) from error
    return frame  # type: ignore[return-value]


class PackedRecording:
    """A folder of shards."""

    def __init__(self, path: pathlib.Path | str, *, corrupt: Literal["raise", "skip"] = "raise",
                 labels: Collection[str] = schema.LABELS):
        """Reads the manifest and looks at every shard.

        Args:
          labels: which of schema.LABELS the frames should have, where they are packed.
          corrupt: "raise" compares sizes now and checksums of frames as they are read, and stops at the first that is
            wrong; "skip" compares the checksums of all shards now (one pass over the data) and leaves the frames of
            damaged ones out, with a warning that names and counts them.

        Raises:
          DataError: for an incomplete or malformed manifest, or a shard that is missing or damaged.
        """
        self._root = pathlib.Path(path)
        manifest = manifest_lib.read_manifest(self._root)
        self._shards: list[dict] = manifest["shards"]
        self._frames_per_shard = int(manifest["frames_per_shard"])
        self._unwanted = schema.LABELS - set(labels)
        self._readers: collections.OrderedDict[int, Any] = collections.OrderedDict()  # the one used last is last
        self._lock = threading.Lock()
        damaged = {number: fault for number, shard in enumerate(self._shards)
                   if (fault := manifest_lib.shard_fault(self._root, shard, checksum=corrupt == "skip"))}
        if damaged and corrupt == "raise":
            number, fault = next(iter(damaged.items()))
            raise _damaged(str(self._root / self._shards[number]["file"]),
                           f"{fault}; {len(damaged)} of {len(self._shards)} shards are damaged")
        whole = [schema.Sequence(**sequence) for sequence in manifest["sequences"]]
        self._first: dict[tuple[str, int], int] = {}  # (run, frame of the run) -> number of the record
        kept: list[schema.Sequence] = []
        record = 0
        for sequence in whole:
            for start, stop in self._present(record, record + sequence.length, damaged):
                begin = sequence.start + start - record
                kept.append(dataclasses.replace(sequence, start=begin, length=stop - start,
                                                lacks=tuple(sorted(set(sequence.lacks) - self._unwanted))))
                self._first[(sequence.name, begin)] = start
            record += sequence.length
        self.sequences = tuple(kept)
        if damaged:
            lost = record - sum(sequence.length for sequence in kept)
            names = ", ".join(f"{self._shards[number]['file']} ({fault})" for number, fault in damaged.items())
            warnings.warn(f"{self._root}: {len(damaged)} of {len(self._shards)} shards are damaged and skipped, "
                          f"{lost} of {record} frames are lost: {names}.", schema.DataWarning, stacklevel=2)
        described = manifest_lib.read_description(manifest, self._root / manifest_lib.MANIFEST_FILE)
        is_asked = not self._unwanted >= {"image_classes", "point_classes"}
        self.description = dataclasses.replace(described, modalities=described.modalities - self._unwanted,
                                               classes=described.classes if is_asked else ())

    def _present(self, first: int, end: int, damaged: Collection[int]) -> Iterator[tuple[int, int]]:
        """(start, stop) of the records from `first` to `end` that lie in whole shards, without a gap each."""
        begin = first
        for shard in range(first // self._frames_per_shard, -(-end // self._frames_per_shard)):
            if shard not in damaged:
                continue
            stop = max(first, shard * self._frames_per_shard)
            if stop > begin:
                yield begin, stop
            begin = (shard + 1) * self._frames_per_shard
        if end > begin:
            yield begin, end

    def __getstate__(self) -> dict[str, Any]:
        """For another process: without what is open here."""
        return self.__dict__ | {"_readers": collections.OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def close(self) -> None:
        """Closes the files that are open; reading opens them again."""
        with self._lock:
            while self._readers:
                self._readers.popitem()[1].close()

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        return self._read(sequence, index)

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        return self._read(sequence, index, ("action",))["action"]

    def _read(self, sequence: schema.Sequence, index: int, only: Collection[str] | None = None) -> schema.RawFrame:
        shard, position = divmod(self._first[(sequence.name, sequence.start)] + index, self._frames_per_shard)
        where = f"{self._root / self._shards[shard]['file']}, record {position}"
        try:
            with self._lock:
                (record,) = self._reader(shard).read([position])
        except (RuntimeError, IndexError, ValueError) as error:
            raise _damaged(where, str(error)) from error
        frame = decode_frame(record, where, only)
        for name in self._unwanted & frame.keys():
            del frame[name]  # type: ignore[misc]
        return frame

    def _reader(self, shard: int) -> Any:
        if shard not in self._readers:
            while len(self._readers) >= _OPEN_READERS:
                self._readers.popitem(last=False)[1].close()
            self._readers[shard] = array_record_module.ArrayRecordReader(
                str(self._root / self._shards[shard]["file"]), _READER_OPTIONS,
                file_reader_buffer_size=_READER_BUFFER_BYTES)
        self._readers.move_to_end(shard)
        return self._readers[shard]


def _encode(name: str, array: np.ndarray, encoding: Encoding) -> tuple[str, bytes]:
    if name == "points_m" and encoding.half_points:
        return "float16", zlib.compress(np.ascontiguousarray(array, np.float16).tobytes(), 1)
    if array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        content = io.BytesIO()
        if name == "image" and encoding.jpeg_quality is not None:
            Image.fromarray(array).save(content, "JPEG", quality=encoding.jpeg_quality, subsampling=0)
            return "jpeg", content.getvalue()
        Image.fromarray(array).save(content, "PNG", compress_level=1)
        return "png", content.getvalue()
    content_bytes = np.ascontiguousarray(array).tobytes()
    return ("raw", content_bytes) if len(content_bytes) < 256 else ("zlib", zlib.compress(content_bytes, 1))


def _decode(content: bytes, encoding: str, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    if dtype.hasobject or encoding not in _ENCODINGS:
        raise ValueError(f"encoding {encoding!r} of {dtype} is unknown")
    size = math.prod(shape)
    if not all(manifest_lib.is_count(side) for side in shape) or size * dtype.itemsize > _LARGEST_ARRAY_BYTES:
        raise ValueError(f"{dtype}{list(shape)} is larger than {_LARGEST_ARRAY_BYTES} bytes")
    if encoding in ("png", "jpeg"):
        with Image.open(io.BytesIO(content)) as image:
            if (image.height, image.width) != shape[:2]:
                raise ValueError(f"a picture of {image.width}x{image.height} pixels, expected {list(shape)}")
            array = np.asarray(image)
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


def _damaged(where: str, why: str) -> schema.DataError:
    return schema.DataError(f"{where}: damaged ({why}). Remove the shard and its .json and pack again, or leave it out "
                            f"with data.skip_corrupt_shards (records.PackedRecording(corrupt=\"skip\")).")
