"""Recordings packed into ArrayRecord shards, behind schema.Recording; writer.py makes them.

    ROOT/manifest.json                 what there is, written last: without it the folder is no recording yet
    ROOT/shard-00000.arrayrecord       frames_per_shard frames (records.py), in the order of the sequences; the last has
                                       fewer
    ROOT/shard-00000.json              frames, bytes and checksum of a complete shard
"""

from __future__ import annotations

import collections
import dataclasses
import pathlib
import threading
import warnings
from collections.abc import Collection, Iterator
from typing import Any, Literal

import numpy as np
from array_record.python import array_record_module

from muvo_jax.data import fields, schema
from muvo_jax.data.packed import manifest as manifest_lib
from muvo_jax.data.packed import records

_READER_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # random access
_READER_BUFFER_BYTES = 1 << 16
_OPEN_READERS = 32  # each holds a file open, of which a process may have 256 or 1024


class PackedRecording:
    """A folder of shards."""

    def __init__(self, path: pathlib.Path | str, *, corrupt: Literal["raise", "skip"] = "raise",
                 labels: Collection[str] = schema.LABELS):
        """Reads the manifest and looks at every shard.

        Args:
          labels: which of schema.LABELS the frames should have, where they are packed.
          corrupt: "raise" compares sizes now, and of frames as they are read checksums and which frame it is, and
            stops at the first that is wrong; "skip" compares the checksums of all shards now (one pass over the data)
            and leaves the frames of damaged ones out, with a warning that names and counts them.

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
            raise records.damaged(str(self._root / self._shards[number]["file"]),
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

    def read_fields(self, sequence: schema.Sequence, index: int, names: Collection[str]) -> schema.RawFrame:
        """See schema.ReadsFields."""
        return self._read(sequence, index, names)

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
            raise records.damaged(where, str(error)) from error
        place = records.place_of(sequence.name, sequence.start + index)
        frame = records.decode_frame(record, where, only, place)
        for name in self._unwanted & frame.keys():
            del frame[name]  # type: ignore[misc]
        camera = self.description.camera
        if camera is not None and not np.array_equal(np.asarray(camera.intrinsics, np.float32),
                                                     frame.get("intrinsics", ())):
            camera = None  # a frame with a camera of its own has pictures of another size, as KITTI's dates have
        for name in fields.FIELDS.keys() & frame.keys():
            wanted = schema.shape_of(name, camera, self.description.voxels)
            fields.check_shape(name, np.shape(frame[name]), wanted, where)  # type: ignore[literal-required]
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
