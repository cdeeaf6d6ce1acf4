"""Descriptions in TOML: sections [camera], [lidar], [voxels], [action], [route_map], each a dataclass; clear errors."""

from __future__ import annotations

import dataclasses
import difflib
import json
import pathlib
from collections.abc import Callable, Collection, Mapping
from typing import Any

from muvo_jax import config as config_lib
from muvo_jax.data import files, schema

_SECTIONS: dict[str, Callable] = {"camera": schema.Camera, "lidar": config_lib.RangeViewGeometry,
                                  "voxels": config_lib.VoxelGrid, "action": config_lib.ActionContract,
                                  "route_map": config_lib.RouteMap}
SAME_RATE = 0.01
CALIBRATION = ("camera", "lidar_position_m")  # of a rule.json, where it was written since December 2026


def tables(**sections) -> dict[str, dict[str, Any]]:
    """The sections of a description as `section` reads them: name -> fields; those that are None are left out.

    How windows are cut (step_action) is a run's to say, not a recording's.
    """
    found = {name: dataclasses.asdict(value) for name, value in sections.items() if value is not None}
    found.get("action", {}).pop("step_action", None)
    return found


def field(header: dict, name: str, kind: type | tuple[type, ...], path: pathlib.Path):
    """A top-level entry of the description.

    Raises:
      DataError: where it is missing or of another type.
    """
    if not isinstance(header.get(name), kind) or isinstance(header.get(name), bool):
        raise schema.DataError(f"{path}: {name} is {header.get(name)!r}, expected "
                               f"{getattr(kind, '__name__', 'a number')}.")
    return header[name]


def rate_hz(header: dict, path: pathlib.Path) -> float:
    """Frames per second.

    Raises:
      DataError: where it is missing or cannot be.
    """
    value = float(field(header, "rate_hz", (int, float), path))
    if not config_lib.RATE_HZ.holds(value):
        raise schema.DataError(f"{path}: rate_hz is {value}; it must be {config_lib.RATE_HZ}.")
    return value


def names(header: dict, name: str, path: pathlib.Path) -> tuple[str, ...]:
    """A top-level list of different names.

    Raises:
      DataError: where it is missing, empty, or holds something else or one name twice.
    """
    found = field(header, name, list, path)
    if not found or not all(isinstance(item, str) and item for item in found) or len(set(found)) < len(found):
        raise schema.DataError(f"{path}: {name} is {found!r}, expected a list of different names.")
    return tuple(found)


def splits(header: dict, path: pathlib.Path) -> tuple[str, ...]:
    """The entry `splits`: names of folders in the recording.

    Raises:
      DataError: as `names`, or for what is no name of a folder.
    """
    found = names(header, "splits", path)
    for name in found:
        if name in (".", "..") or set("/\\\0:") & set(name):
            raise schema.DataError(f"{path}: splits has {name!r}, expected names of folders that lie beside this file.")
    return found


def contract(header: dict, path: pathlib.Path, rate_hz: float) -> config_lib.ActionContract | None:
    """The section [action]; its rate_hz may be left out. None where there is no such section.

    Raises:
      DataError: as `section`, or where its rate is another one than that of the frames.
    """
    given = header.get("action")
    if isinstance(given, dict) and "rate_hz" not in given:
        header = header | {"action": given | {"rate_hz": rate_hz}}
    found = section(header, "action", path, required=False)
    if found is not None and abs(found.rate_hz / rate_hz - 1.0) > SAME_RATE:
        raise schema.DataError(f"{path}: rate_hz is {rate_hz:g}, but action.rate_hz is {found.rate_hz:g}: a step would "
                               f"last two times. An action belongs to each frame; leave action.rate_hz out, or make "
                               f"both the frames' rate.")
    return found


def section(header: dict, name: str, path: pathlib.Path, *, required: bool):
    """One section as its dataclass; None where it is neither there nor required.

    Raises:
      DataError: where it is required and missing, or has unknown fields, wrong types or numbers that cannot be.
    """
    if name not in header:
        if required:
            raise schema.DataError(f"{path}: section [{name}] is missing, although there is data that needs it.")
        return None
    if name == "action" and isinstance(header[name], dict) and "step_action" in header[name]:
        raise schema.DataError(f"{path}: action.step_action says how windows are cut, not how actions were recorded. "
                               f"Take it out, and train with --set contract.step_action={header[name]['step_action']}.")
    try:
        return config_lib.parse(_SECTIONS[name], header[name], f"{path}: {name}")
    except TypeError as error:
        raise schema.DataError(f"{path}: {name}: {error}") from error
    except ValueError as error:
        raise schema.DataError(str(error)) from error


def check_names(header: dict, path: pathlib.Path, known: Collection[str]) -> None:
    """Raises DataError for a top-level entry that looks like a misspelt one of `known` or of the sections."""
    names = (*known, *_SECTIONS)
    for name in header:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.7)
        if name not in names and near:
            raise schema.DataError(f"{path}: {name!r} is unknown. Did you mean {near[0]}?")


def check_rule(folder: pathlib.Path, grid: config_lib.VoxelGrid) -> None:
    """Raises DataError where occupancy says (files.RULE_FILE) that it was made for another grid than described."""
    path = folder / files.RULE_FILE
    if not path.is_file():
        return
    try:
        made_for = json.loads(files.read_bytes(path, "the rule that occupancy was made by"))
        found = {name: made_for[name] for name in dataclasses.asdict(grid)}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise schema.DataError(f"{path}: does not say by which rule and grid the files there were made ({error}). Make "
                               f"them again (python -m muvo_jax.voxelize --overwrite), or remove it.") from error
    described = json.loads(json.dumps(dataclasses.asdict(grid)))
    if found != described:
        raise schema.DataError(f"{folder}: occupancy was made for {found}, but the grid is described with {described}. "
                               f"Correct the section [voxels], or make it again (python -m muvo_jax.voxelize "
                               f"--overwrite).")


def check_same_rule(path: pathlib.Path, how: Mapping[str, Any]) -> None:
    """Raises FileExistsError where a rule.json says something else; without calibration it is an older one."""
    text = files.read_bytes(path, "a rule").decode(errors="replace")
    try:
        found = dict(json.loads(text))
    except (ValueError, TypeError, RecursionError):
        found = {}
    other = [name for name, value in how.items()
             if found.get(name) != value and (name in found or name not in CALIBRATION)]
    if other:
        told = {name: found.get(name) for name in other} if found else text.strip()[:300]
        raise FileExistsError(f"{path}: the files there were made by {told}, not by "
                              f"{({name: how[name] for name in other})}. --overwrite removes them and makes all anew.")
