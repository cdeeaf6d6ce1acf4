"""Recordings packed into ArrayRecord shards: what pack.py writes, and its reader behind schema.Recording.

    ROOT/manifest.json                 what there is, written last: without it the folder is no recording yet
    ROOT/shard-00000.arrayrecord       frames_per_shard frames, in the order of the sequences; the last has fewer
    ROOT/shard-00000.json              frames, bytes and checksum of a complete shard

A record is a frame: its length-prefixed JSON header names the fields (dtype, shape, encoding, size), their bytes follow
and a CRC-32 of all of it closes it. Nothing is pickled.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import pathlib
import struct
import threading
import warnings
import zlib
from collections.abc import Collection
from typing import Any, Literal

import numpy as np
from array_record.python import array_record_module
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.data import description as description_lib
from muvo_jax.data import files, schema

SCHEMA_VERSION = 1
MANIFEST_FILE = "manifest.json"
_READER_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # random access
_READER_BUFFER_BYTES = 1 << 16
_LENGTH = struct.Struct("<I")
_ENCODINGS = ("raw", "zlib", "png", "jpeg", "float16")


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
    except (ValueError, KeyError, TypeError, OSError, zlib.error) as error:
        raise _damaged(where, str(error)) from error
    return frame  # type: ignore[return-value]


class PackedRecording:
    """A folder of shards."""

    def __init__(self, path: pathlib.Path | str, *, corrupt: Literal["raise", "skip"] = "raise"):
        """Reads the manifest and looks at every shard.

        Args:
          corrupt: "raise" compares sizes now and checksums of frames as they are read, and stops at the first that is
            wrong; "skip" compares the checksums of all shards now (one pass over the data) and leaves the frames of
            damaged ones out, with a warning that names and counts them.

        Raises:
          DataError: for an incomplete or malformed manifest, or a shard that is missing or damaged.
        """
        self._root = pathlib.Path(path)
        manifest = read_manifest(self._root)
        self._shards: list[dict] = manifest["shards"]
        self._frames_per_shard = int(manifest["frames_per_shard"])
        self._readers: dict[int, Any] = {}
        self._lock = threading.Lock()
        damaged = {number: fault for number, shard in enumerate(self._shards)
                   if (fault := shard_fault(self._root, shard, checksum=corrupt == "skip"))}
        if damaged and corrupt == "raise":
            number, fault = next(iter(damaged.items()))
            raise _damaged(str(self._root / self._shards[number]["file"]),
                           f"{fault}; {len(damaged)} of {len(self._shards)} shards are damaged")
        whole = [schema.Sequence(**sequence) for sequence in manifest["sequences"]]
        self._first: dict[tuple[str, int], int] = {}  # (run, frame of the run) -> number of the record
        kept: list[schema.Sequence] = []
        record = 0
        for sequence in whole:
            numbers = np.arange(record, record + sequence.length)
            present = ~np.isin(numbers // self._frames_per_shard, list(damaged))
            for start, length in files.gap_free(present, np.zeros(sequence.length, bool)):
                kept.append(dataclasses.replace(sequence, start=sequence.start + start, length=length))
                self._first[(sequence.name, sequence.start + start)] = record + start
            record += sequence.length
        self.sequences = tuple(kept)
        if damaged:
            lost = record - sum(sequence.length for sequence in kept)
            names = ", ".join(f"{self._shards[number]['file']} ({fault})" for number, fault in damaged.items())
            warnings.warn(f"{self._root}: {len(damaged)} of {len(self._shards)} shards are damaged and skipped, "
                          f"{lost} of {record} frames are lost: {names}.", schema.DataWarning, stacklevel=2)
        self.description = _description(manifest, self._root / MANIFEST_FILE)

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
        return decode_frame(record, where, only)

    def _reader(self, shard: int) -> Any:
        if shard not in self._readers:
            self._readers[shard] = array_record_module.ArrayRecordReader(
                str(self._root / self._shards[shard]["file"]), _READER_OPTIONS,
                file_reader_buffer_size=_READER_BUFFER_BYTES)
        return self._readers[shard]


def read_manifest(root: pathlib.Path) -> dict:
    """The manifest of a packed recording.

    Raises:
      DataError: where it is missing, of another version or malformed.
    """
    path = root / MANIFEST_FILE
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise files.missing(path, "the manifest of a packed recording (pack it to the end)") from error
    except ValueError as error:
        raise schema.DataError(f"{path}: not valid JSON ({error}). Pack the recording again.") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise schema.DataError(f"{path}: schema_version is {version!r}, this reader knows {SCHEMA_VERSION}. Pack the "
                               f"recording again, or use the muvo_jax that wrote it.")
    lacking = [name for name in ("shards", "frames_per_shard", "sequences", "description") if name not in manifest]
    if lacking:
        raise schema.DataError(f"{path}: {', '.join(lacking)} missing. Pack the recording again.")
    return manifest


def shard_fault(root: pathlib.Path, shard: dict, *, checksum: bool) -> str | None:
    """What is wrong with a shard, given its entry in the manifest; None where nothing is."""
    path = root / shard["file"]
    if not path.is_file():
        return "it is missing"
    size = path.stat().st_size
    if size != shard["bytes"]:
        return f"it has {size} bytes, not {shard['bytes']}"
    if checksum and file_sha256(path) != shard["sha256"]:
        return "its checksum does not fit"
    return None


def file_sha256(path: pathlib.Path) -> str:
    """Hexadecimal SHA-256 of a file, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def describe(description: schema.RecordingDescription) -> dict:
    """The JSON form of a description, without its kind."""
    values = dataclasses.asdict(description)
    values["modalities"] = sorted(description.modalities)
    return values


def _description(manifest: dict, path: pathlib.Path) -> schema.RecordingDescription:
    values = dict(manifest["description"])
    try:
        sections = {name: description_lib.section({name: values[name]} if values.get(name) else {}, name, path,
                                                  required=False) for name in ("camera", "lidar", "voxels")}
        contract = config_lib.parse(config_lib.ActionContract, values["contract"], f"{path}: contract")
        return schema.RecordingDescription(
            name=values["name"], kind=f"packed {values['kind']}", rate_hz=values["rate_hz"], contract=contract,
            modalities=frozenset(values["modalities"]), splits=tuple(values["splits"]), notes=tuple(values["notes"]),
            **sections)
    except (KeyError, TypeError, ValueError) as error:
        raise schema.DataError(f"{path}: description is malformed ({error}). Pack the recording again.") from error


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
    if encoding in ("png", "jpeg"):
        with Image.open(io.BytesIO(content)) as image:
            array = np.asarray(image)
    elif encoding == "float16":
        array = np.frombuffer(zlib.decompress(content), np.float16).astype(dtype).reshape(shape)
    else:
        array = np.frombuffer(content if encoding == "raw" else zlib.decompress(content), dtype).reshape(shape)
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(f"found {array.dtype}{list(array.shape)}, expected {dtype}{list(shape)}")
    return array


def _damaged(where: str, why: str) -> schema.DataError:
    return schema.DataError(f"{where}: damaged ({why}). Remove the shard and its .json and pack again, or leave it out "
                            f"with data.skip_corrupt_shards (records.PackedRecording(corrupt=\"skip\")).")
