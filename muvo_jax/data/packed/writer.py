"""Writes the shards that reader.py reads: each whole or not at all, by several processes and machines at once.

Beside each shard lies what it was made of (its frames, and a fingerprint of their runs' files), so that a source that
was corrected since makes those shards anew that it touches.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

from array_record.python import array_record_module

from muvo_jax.data import files, fingerprints, pictures, processes, schema, sources
from muvo_jax.data.packed import manifest, records

PLAN_FILE = "plan.json"
_CORRECTED = ("sequences", "frames_of_splits")  # what of a plan a corrected source may change

Progress = Callable[[int, int], None]


class Shard(NamedTuple):
    """A shard to be written: its number, (sequence, first frame, end) of what it holds, and the fingerprint of that."""

    number: int
    parts: tuple[tuple[schema.Sequence, int, int], ...]
    source: str

    @property
    def frames(self) -> int:
        return sum(stop - start for _, start, stop in self.parts)


def pack(source: pathlib.Path | str, out: pathlib.Path | str, *, encoding: records.Encoding | None = None,
         frames_per_shard: int = manifest.FRAMES_PER_SHARD, camera: str = "", key_frames: bool = False,
         labels: bool = True, machine: int = 0, machines: int = 1, workers: int | None = None,
         progress: Progress | None = None) -> bool:
    """Packs a recording of any kind; shards that are complete already are kept.

    Args:
      camera: which one, where the source has several; by default its reader's choice.
      key_frames: only these, where the source has them.
      labels: whether to pack what schema.LABELS names, too, as far as it is recorded.
      machine, machines: this call writes the shards whose number is `machine` modulo `machines`.
      workers: how many shards are packed side by side, by default one for each processor.
      progress: called with (frames done, frames in all of this machine).

    Returns:
      Whether all shards of all machines are there and the manifest is written.

    Raises:
      ValueError: where one of source and `out` lies in the other, and for numbers that cannot be.
      DataError: for a source that cannot be read.
      BlockingIOError: where another process packs the same shards now.
      FileExistsError: where `out` holds another recording or other settings.
      OSError: where a shard cannot be written; complete ones are kept.
      RuntimeError: where a worker was killed.
    """
    if not 0 <= machine < machines or frames_per_shard < 1 or (workers is not None and workers < 1):
        raise ValueError(f"machine {machine} of {machines}, {frames_per_shard} frames per shard, {workers} workers: "
                         f"expected a machine from 0 to machines - 1, at least one frame and one worker.")
    encoding = encoding or records.Encoding()
    source, out = pathlib.Path(source).expanduser(), pathlib.Path(out).expanduser()
    _check_apart(source, out)
    recording = sources.open_recording(source, camera=camera, key_frames=key_frames,
                                       labels=schema.LABELS if labels else ())
    plan = _plan(recording, frames_per_shard, encoding)
    out.mkdir(parents=True, exist_ok=True)
    with processes.locked(out / f".packing-{machine}-of-{machines}", "packing"):
        # Who divides the shards otherwise would write some of ours.
        processes.check_free((path for path in sorted(out.glob(".packing-*-of-*"))
                              if not path.name.endswith(f"-of-{machines}")), "packing")
        _keep_plan(out, plan)
        shards = _shards(recording, source, frames_per_shard)
        mine = shards[machine::machines]
        missing = [shard for shard in mine if _entry(out, shard, is_mine=True) is None]
        if missing:
            (out / manifest.MANIFEST_FILE).unlink(missing_ok=True)  # until they are there
        wanted, left = (sum(shard.frames for shard in group) for group in (mine, missing))
        for done, _ in enumerate(_write_all(recording, out, missing, encoding, workers), start=wanted - left + 1):
            if progress is not None and (done % 16 == 0 or done == wanted):
                progress(done, wanted)
        entries = [_entry(out, shard, is_mine=shard in mine) for shard in shards]
        if None in entries:
            return False
        _remove_more(out, len(shards))
        files.write_atomically(out / manifest.MANIFEST_FILE, json.dumps(
            plan | {"frames": sum(shard.frames for shard in shards), "shards": entries}, indent=1, ensure_ascii=False))
    return True


def write_shard(recording: schema.Recording, out: pathlib.Path, encoding: records.Encoding,
                shard: Shard) -> Iterator[int]:
    """Writes one shard, frame by frame; yields its number after each frame."""
    path = out / manifest.shard_name(shard.number)
    draft = path.with_name(f".{path.name}.draft")
    path.with_suffix(".json").unlink(missing_ok=True)
    with _writing(path):
        writer = array_record_module.ArrayRecordWriter(str(draft), "group_size:1,uncompressed")
    try:
        for sequence, start, stop in shard.parts:
            for index in range(start, stop):
                with pictures.keeping() as kept:
                    frame = recording.read(sequence, index)
                place = records.place_of(sequence.name, sequence.start + index)
                record = records.encode_frame(frame, encoding, kept, place)
                with _writing(path):
                    writer.write(record)
                yield shard.number
    finally:
        with _writing(path):
            writer.close()
    with draft.open("rb") as file:
        os.fsync(file.fileno())
    entry = {"file": path.name, "frames": shard.frames, "bytes": draft.stat().st_size,
             "sha256": manifest.file_sha256(draft)}
    os.replace(draft, path)
    files.write_atomically(path.with_suffix(".json"), json.dumps(entry | {"source": shard.source}))


@contextlib.contextmanager
def _writing(path: pathlib.Path) -> Iterator[None]:
    """Makes an OSError of what ArrayRecord raises where it cannot write."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(f"{path}: cannot be written ({error}). Make room on the disk, or correct permissions, and pack "
                      f"again; shards that are complete are kept.") from error


def _write_all(recording: schema.Recording, out: pathlib.Path, shards: list[Shard], encoding: records.Encoding,
               workers: int | None) -> Iterator[int]:
    """Yields a shard's number for each of its frames, here frame by frame, from several processes shard by shard."""
    workers = min(workers or processes.processors(), len(shards))
    if workers > 1:
        for shard_numbers in processes.spread(_write_whole, shards, shared=(recording, out, encoding), workers=workers,
                                              doing="packing"):
            yield from shard_numbers
        return
    for shard in shards:
        yield from write_shard(recording, out, encoding, shard)


def _write_whole(recording: schema.Recording, out: pathlib.Path, encoding: records.Encoding, shard: Shard) -> list[int]:
    return list(write_shard(recording, out, encoding, shard))


def _check_apart(source: pathlib.Path, out: pathlib.Path) -> None:
    here, there = source.resolve(), out.resolve()
    if here == there or here.is_relative_to(there) or there.is_relative_to(here):
        raise ValueError(f"{out} and the recording {source} lie in one another; shards would mix with what is "
                         f"recorded. Choose a folder beside it.")


def _plan(recording: schema.Recording, frames_per_shard: int, encoding: records.Encoding) -> dict:
    described = recording.description
    sequences = [manifest.describe_sequence(sequence) for sequence in recording.sequences]
    counts = {split: sum(sequence.length for sequence in recording.sequences if sequence.split == split)
              for split in described.splits}
    plan = {"schema_version": manifest.SCHEMA_VERSION, "description": manifest.describe(described),
            "encoding": vars(encoding), "frames_per_shard": frames_per_shard, "frames_of_splits": counts,
            "sequences": sequences}
    return json.loads(json.dumps(plan))  # as it will be read: tuples become lists


def _keep_plan(out: pathlib.Path, plan: dict) -> None:
    """Writes the plan; one of the same recording and settings may be there, with other sequences if it was corrected.

    Raises:
      FileExistsError: where there is another one, or shards without any.
    """
    path = out / PLAN_FILE
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            before = None
        if before == plan:
            return
        fixed = lambda of: {name: value for name, value in of.items() if name not in _CORRECTED}
        if not isinstance(before, dict) or fixed(before) != fixed(plan):
            raise FileExistsError(f"{path} is of another recording or other settings; choose another folder or remove "
                                  f"this one.")
        (out / manifest.MANIFEST_FILE).unlink(missing_ok=True)
    elif any(out.glob("shard-*")):
        raise FileExistsError(f"{out} holds shards without their {PLAN_FILE}; choose another folder.")
    files.write_atomically(path, json.dumps(plan, indent=1, ensure_ascii=False))


def _shards(recording: schema.Recording, source: pathlib.Path, frames_per_shard: int) -> list[Shard]:
    """All shards of a recording, in the order of its sequences."""
    groups: list[list[tuple[schema.Sequence, int, int]]] = []
    room = 0
    for sequence in recording.sequences:
        start = 0
        while start < sequence.length:
            if not room:
                groups.append([])
                room = frames_per_shard
            stop = min(start + room, sequence.length)
            groups[-1].append((sequence, start, stop))
            room -= stop - start
            start = stop
    names = {sequence.name for sequence in recording.sequences}
    states = ({name: fingerprints.of_files(source, recording.run_files(name)) for name in names}
              if isinstance(recording, schema.ListsFiles) else fingerprints.of_runs(source, names))
    return [Shard(number, tuple(parts), fingerprints.combined(
        [f"{sequence.name}/{sequence.start + start}+{stop - start}:{states[sequence.name]}"
         for sequence, start, stop in parts])) for number, parts in enumerate(groups)]


def _entry(out: pathlib.Path, shard: Shard, *, is_mine: bool) -> dict | None:
    """What a complete shard says about itself; None where it is not complete, or was made of something else.

    Only a machine's own shards are compared with its source: file times of another machine's copy may differ.
    """
    name = manifest.shard_name(shard.number)
    try:
        entry = json.loads((out / name).with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if manifest.entry_fault(entry) or entry["file"] != name or entry["frames"] != shard.frames:
        return None
    made_of = entry.pop("source", None)
    if (is_mine and made_of != shard.source) or manifest.shard_fault(out, entry, checksum=False):
        return None
    return entry


def _remove_more(out: pathlib.Path, shards: int) -> None:
    """Removes shards that a longer source had before it was corrected."""
    number = shards
    while (path := out / manifest.shard_name(number)).exists():
        path.unlink()
        path.with_suffix(".json").unlink(missing_ok=True)
        number += 1
