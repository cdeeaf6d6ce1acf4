"""The manifest of a packed recording: what it holds, which shards it has, and whether they are whole."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
import warnings
from typing import Any

from muvo_jax import config as config_lib
from muvo_jax.data import description as description_lib
from muvo_jax.data import fields, files, schema

SCHEMA_VERSION = 3  # 2 did not say in its records which frame they are; 1 had no recorded bytes of pictures either
_READABLE_VERSIONS = (1, 2, SCHEMA_VERSION)
MANIFEST_FILE = "manifest.json"
FRAMES_PER_SHARD = 256  # where nothing else is said
# What values that are anything at all can lead to.
_MALFORMED = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, MemoryError)


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
    except (ValueError, RecursionError) as error:
        raise schema.DataError(f"{path}: not valid JSON ({error}). Pack the recording again.") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if type(version) is not int or version not in _READABLE_VERSIONS:
        raise schema.DataError(f"{path}: schema_version is {version!r}, this reader knows {SCHEMA_VERSION} and earlier "
                               f"ones. Pack the recording again, or use the muvo_jax that wrote it.")
    lacking = [name for name in ("shards", "frames_per_shard", "sequences", "description") if name not in manifest]
    if lacking:
        raise schema.DataError(f"{path}: {', '.join(lacking)} missing. Pack the recording again.")
    fault = _manifest_fault(manifest)
    if fault:
        raise schema.DataError(f"{path}: {fault}. Pack the recording again.")
    return manifest


def _manifest_fault(manifest: dict) -> str | None:
    """What contradicts itself in a manifest or is of another type; None where nothing does."""
    per_shard, shards, sequences = (manifest[name] for name in ("frames_per_shard", "shards", "sequences"))
    if not is_count(per_shard, least=1):
        return f"frames_per_shard is {str(per_shard)[:80]}, expected a whole number of 1 or more"
    for name, entries, fault in (("shards", shards, entry_fault), ("sequences", sequences, _sequence_fault)):
        if not isinstance(entries, list):
            return f"{name} is no list"
        for number, entry in enumerate(entries):
            if said := fault(entry):
                return f"{name}[{number}]: {said}"
    for number, shard in enumerate(shards):
        if shard["file"] != shard_name(number):
            return f"shards[{number}]: file is {shard['file'][:80]}, expected {shard_name(number)}"
    total = sum(sequence["length"] for sequence in sequences)
    frames = [min(per_shard, total - number * per_shard) for number in range(len(shards))]
    if [shard["frames"] for shard in shards] != frames or sum(frames) != total:
        return (f"{len(shards)} shards of {per_shard} frames with {sum(shard['frames'] for shard in shards)} in all do "
                f"not hold the {total} frames of the sequences")
    starts = [(sequence["name"], sequence["start"]) for sequence in sequences]
    return "two sequences of one run begin at one frame" if len(set(starts)) < len(starts) else None


def shard_name(number: int) -> str:
    """The file of a shard."""
    return f"shard-{number:05d}.arrayrecord"


def entry_fault(entry: Any) -> str | None:
    """What is wrong with what a shard says about itself; None where it can be used."""
    if not isinstance(entry, dict):
        return "no table"
    if not isinstance(entry.get("file"), str):
        return f"file is {str(entry.get('file'))[:80]}, expected the name of a file"
    for field in ("frames", "bytes"):
        if not is_count(entry.get(field), least=1):
            return f"{field} is {str(entry.get(field))[:80]}, expected a whole number of 1 or more"
    if entry["frames"] > entry["bytes"]:
        return f"{entry['frames']} frames in {entry['bytes']} bytes"
    return None if isinstance(entry.get("sha256"), str) else "sha256 is no text"


def _sequence_fault(sequence: Any) -> str | None:
    if not isinstance(sequence, dict) or set(sequence) - {"lacks"} != {"split", "name", "start", "length"}:
        return "expected split, name, start and length, and lacks where its frames lack fields"
    if not (isinstance(sequence["split"], str) and isinstance(sequence["name"], str)):
        return "split and name must be text"
    if not (is_count(sequence["start"]) and is_count(sequence["length"], least=1)):
        return f"start {str(sequence['start'])[:80]} and length {str(sequence['length'])[:80]} must be whole numbers"
    lacks = sequence.get("lacks", [])
    if not isinstance(lacks, list) or not all(isinstance(name, str) and name in fields.FIELDS for name in lacks):
        return f"lacks is {str(lacks)[:80]}, expected a list of recorded fields"
    return None


def is_count(value: Any, least: int = 0) -> bool:
    """Whether a value from a file is a whole number of at least `least`, and none that overflows."""
    return type(value) is int and least <= value < 2**62


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


def describe_sequence(sequence: schema.Sequence) -> dict:
    """The JSON form of a sequence, schema.Sequence(**it) again; `lacks` is left out where it is empty."""
    values = dataclasses.asdict(sequence)
    lacks = values.pop("lacks")
    return values | ({"lacks": list(lacks)} if lacks else {})


def describe(description: schema.RecordingDescription) -> dict:
    """The JSON form of a description, without its kind."""
    values = dataclasses.asdict(description)
    values["modalities"] = sorted(description.modalities)
    return values


def read_description(manifest: dict, path: pathlib.Path) -> schema.RecordingDescription:
    """The inverse of `describe`; `path` of the manifest is for messages.

    Older manifests do not say the scale of their route maps: the default is assumed, with a warning.

    Raises:
      DataError: where it is malformed.
    """
    try:
        values = {"route_map": None, "classes": []} | manifest["description"]
        rate_hz = description_lib.rate_hz(values, path)
        unknown = set(values["modalities"]) - set(fields.FIELDS)
        if unknown:
            raise ValueError(f"modalities has {', '.join(sorted(unknown))}, which are no recorded fields")
        sections = {name: description_lib.section({name: values[name]} if values[name] else {}, name, path,
                                                  required=False)
                    for name in ("camera", "lidar", "voxels", "route_map")}
        if "route_map" in values["modalities"] and sections["route_map"] is None:
            sections["route_map"] = _assumed_route_map(path)
        contract = config_lib.parse(config_lib.ActionContract, values["contract"], f"{path}: contract")
        if abs(contract.rate_hz / rate_hz - 1.0) > description_lib.SAME_RATE:
            raise ValueError(f"rate_hz is {rate_hz:g}, but contract.rate_hz is {contract.rate_hz:g}")
        return schema.RecordingDescription(
            name=str(description_lib.field(values, "name", str, path)), kind=f"packed {values['kind']}",
            rate_hz=rate_hz, contract=contract, modalities=frozenset(values["modalities"]),
            splits=description_lib.splits(values, path), notes=_texts(values, "notes"),
            classes=_texts(values, "classes"), **sections)
    except schema.DataError:
        raise
    except _MALFORMED as error:
        raise schema.DataError(f"{path}: description is malformed ({error}). Pack the recording again.") from error


def _texts(values: dict, name: str) -> tuple[str, ...]:
    found = values[name]
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
        raise ValueError(f"{name} is {str(found)[:80]}, expected a list of text")
    return tuple(found)


def _assumed_route_map(path: pathlib.Path) -> config_lib.RouteMap:
    assumed = config_lib.RouteMap()
    warnings.warn(f"{path}: does not say the scale of its route maps; {assumed.metres_per_px:g} m a pixel is assumed, "
                  f"as the built-in town draws them. Pack a recording of another scale again.", schema.DataWarning,
                  stacklevel=4)
    return assumed
