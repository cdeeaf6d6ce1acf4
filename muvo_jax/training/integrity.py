"""Proof that a checkpoint on disk is what was written: the SHA-256 of every file, in a list that is written last."""

from __future__ import annotations

import hashlib
import json
import os
import pathlib

SCHEMA_VERSION = 1
CHECKSUM_FILE = "checksums.json"
DAMAGED_FOLDER = "damaged_checkpoints"
_ITEMS = ("meta", "variables")  # every checkpoint has these; `training` only those that a run goes on from


def damage(folder: pathlib.Path) -> str | None:
    """Why a checkpoint folder cannot be trusted, or None where every file is as it was written."""
    try:
        listed = list(json.loads((folder / CHECKSUM_FILE).read_text(encoding="utf-8"))["files"].items())
    except FileNotFoundError:
        return f"it has no {CHECKSUM_FILE}, so saving was interrupted"
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return f"its {CHECKSUM_FILE} cannot be read"
    for item in _ITEMS:
        if not any(name.startswith(f"{item}/") for name, _ in listed):
            return f"its {CHECKSUM_FILE} lists nothing of {item}/"
    for name, expected in listed:
        path = folder / name
        if not path.is_file():
            return f"{name} is missing"
        try:
            found = _sha256(path)
        except OSError as error:
            return f"{name} cannot be read ({error.strerror or error})"
        if found != expected:
            return f"{name} has changed since it was written ({path.stat().st_size} bytes now)"
    return None


def set_aside(folder: pathlib.Path, run_folder: str | os.PathLike) -> pathlib.Path:
    """Moves a checkpoint out of the way (RUN/damaged_checkpoints), so that its step can be written again."""
    target = pathlib.Path(run_folder).expanduser() / DAMAGED_FOLDER / folder.name
    copy = 1
    while target.exists():
        copy += 1
        target = target.with_name(f"{folder.name}-{copy}")
    target.parent.mkdir(exist_ok=True)
    folder.rename(target)
    return target


def seal(folder: pathlib.Path) -> None:
    """Lists the checksums of all files of a complete checkpoint; the list appears as a whole or not at all."""
    files = {path.relative_to(folder).as_posix(): _sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}
    partial = folder / (CHECKSUM_FILE + ".part")
    with partial.open("w", encoding="utf-8") as file:
        json.dump({"schema_version": SCHEMA_VERSION, "files": files}, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(folder / CHECKSUM_FILE)


def _sha256(path: pathlib.Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
