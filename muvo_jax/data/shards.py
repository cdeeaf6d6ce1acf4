"""Writes the shards that records.py reads: each whole or not at all, by several processes and machines at once."""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import Callable, Iterator

from array_record.python import array_record_module

from muvo_jax.data import processes, recorder, records, schema, sources

PLAN_FILE = "plan.json"
FRAMES_PER_SHARD = 256
_LIST_FIELDS = ("split", "name", "start", "length")

Progress = Callable[[int, int], None]


def pack(source: pathlib.Path | str, out: pathlib.Path | str, *, encoding: records.Encoding | None = None,
         frames_per_shard: int = FRAMES_PER_SHARD, machine: int = 0, machines: int = 1, workers: int | None = None,
         progress: Progress | None = None) -> bool:
    """Packs a recording of any kind; shards that are complete already are kept.

    Args:
      machine, machines: this call writes the shards whose number is `machine` modulo `machines`.
      workers: processes, by default one for each processor.
      progress: called with (frames done, frames in all of this machine).

    Returns:
      Whether all shards of all machines are there and the manifest is written.

    Raises:
      DataError: for a source that cannot be read.
      BlockingIOError: where another process packs the same shards now.
      FileExistsError: where `out` holds another recording or other settings.
      RuntimeError: where a worker failed or was killed.
    """
    if not 0 <= machine < machines or frames_per_shard < 1:
        raise ValueError(f"machine {machine} of {machines}, {frames_per_shard} frames per shard: expected a machine "
                         f"from 0 to machines - 1 and at least one frame.")
    encoding = encoding or records.Encoding()
    out = pathlib.Path(out)
    recording = sources.open_recording(source)
    plan = _plan(recording, frames_per_shard, encoding)
    out.mkdir(parents=True, exist_ok=True)
    with processes.locked(out / f".packing-{machine}-of-{machines}", "packing"):
        _keep_plan(out, plan)
        total = sum(sequence.length for sequence in recording.sequences)
        shards = -(-total // frames_per_shard)
        mine = range(machine, shards, machines)
        size = lambda number: min(frames_per_shard, total - number * frames_per_shard)
        missing = [number for number in mine if _entry(out, number) is None]
        done, wanted = sum(size(number) for number in mine if number not in missing), sum(map(size, mine))
        workers = min(os.cpu_count() or 1, len(missing)) if workers is None else min(workers, len(missing))
        shares = [(str(source), out, missing[first::workers], frames_per_shard, encoding) for first in range(workers)]
        frames = (processes.stream(_write_share, shares, "packing") if workers > 1
                  else write_shards(recording, out, missing, frames_per_shard, encoding))
        for _ in frames:
            done += 1
            if progress is not None and done % 16 == 0:
                progress(done, wanted)
        entries = [_entry(out, number) for number in range(shards)]
        if None in entries:
            return False
        recorder.write_atomically(out / records.MANIFEST_FILE, json.dumps(
            plan | {"frames": total, "shards": entries}, indent=1, ensure_ascii=False))
    return True


def write_shards(recording: schema.Recording, out: pathlib.Path, numbers: list[int], frames_per_shard: int,
                 encoding: records.Encoding) -> Iterator[int]:
    """Writes some shards, frame by frame; yields the shard's number after each frame."""
    frames = [(sequence, index) for sequence in recording.sequences for index in range(sequence.length)]
    for number in numbers:
        path = out / _name(number)
        draft = path.with_name(f".{path.name}.draft")
        writer = array_record_module.ArrayRecordWriter(str(draft), "group_size:1,uncompressed")
        here = frames[number * frames_per_shard:(number + 1) * frames_per_shard]
        for sequence, index in here:
            writer.write(records.encode_frame(recording.read(sequence, index), encoding))
            yield number
        writer.close()
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        entry = {"file": path.name, "frames": len(here), "bytes": draft.stat().st_size,
                 "sha256": records.file_sha256(draft)}
        os.replace(draft, path)
        recorder.write_atomically(path.with_suffix(".json"), json.dumps(entry))


def _plan(recording: schema.Recording, frames_per_shard: int, encoding: records.Encoding) -> dict:
    described = recording.description
    sequences = [{name: getattr(sequence, name) for name in _LIST_FIELDS} for sequence in recording.sequences]
    counts = {split: sum(sequence.length for sequence in recording.sequences if sequence.split == split)
              for split in described.splits}
    return {"schema_version": records.SCHEMA_VERSION, "description": records.describe(described),
            "encoding": vars(encoding), "frames_per_shard": frames_per_shard, "frames_of_splits": counts,
            "sequences": sequences}


def _keep_plan(out: pathlib.Path, plan: dict) -> None:
    path = out / PLAN_FILE
    text = json.dumps(plan, indent=1, ensure_ascii=False)
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise FileExistsError(f"{path} is of another recording or other settings; choose another folder or remove "
                                  f"this one.")
        return
    if any(out.glob("shard-*")):
        raise FileExistsError(f"{out} holds shards without their {PLAN_FILE}; choose another folder.")
    recorder.write_atomically(path, text)


def _name(number: int) -> str:
    return f"shard-{number:05d}.arrayrecord"


def _entry(out: pathlib.Path, number: int) -> dict | None:
    """What a complete shard says about itself; None where it is not complete."""
    path = (out / _name(number)).with_suffix(".json")
    if not path.is_file():
        return None
    entry = json.loads(path.read_text(encoding="utf-8"))
    return None if records.shard_fault(out, entry, checksum=False) else entry


def _write_share(source: str, out: pathlib.Path, numbers: list[int], frames_per_shard: int,
                 encoding: records.Encoding) -> Iterator[int]:
    return write_shards(sources.open_recording(source), out, numbers, frames_per_shard, encoding)
