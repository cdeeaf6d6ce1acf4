"""Sensor descriptions in TOML: sections [camera], [lidar], [voxels], [action], each a dataclass, with clear errors."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

from muvo_jax import config as config_lib
from muvo_jax.data import schema

_SECTIONS: dict[str, Callable] = {"camera": schema.Camera, "lidar": config_lib.RangeViewGeometry,
                                  "voxels": config_lib.VoxelGrid, "action": config_lib.ActionContract}


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
      DataError: where it is missing or not above 0.
    """
    value = float(field(header, "rate_hz", (int, float), path))
    if not 0 < value < float("inf"):
        raise schema.DataError(f"{path}: rate_hz is {value}, expected a number above 0.")
    return value


def section(header: dict, name: str, path: pathlib.Path, *, required: bool):
    """One section as its dataclass; None where it is neither there nor required.

    Raises:
      DataError: where it is required and missing, or has unknown fields, wrong types or matrices of another size.
    """
    if name not in header:
        if required:
            raise schema.DataError(f"{path}: section [{name}] is missing, although there is data that needs it.")
        return None
    if name == "action" and isinstance(header[name], dict) and "step_action" in header[name]:
        raise schema.DataError(f"{path}: action.step_action says how windows are cut, not how actions were recorded. "
                               f"Take it out, and train with --set contract.step_action={header[name]['step_action']}.")
    try:
        value = config_lib.parse(_SECTIONS[name], header[name], f"{path}: {name}")
    except (TypeError, ValueError) as error:
        raise schema.DataError(str(error)) from error
    if name == "camera":
        _check_matrix(value.intrinsics, 3, f"{path}: camera.intrinsics")
        _check_matrix(value.camera_to_ego, 4, f"{path}: camera.camera_to_ego")
    return value


def _check_matrix(rows: tuple[tuple[float, ...], ...], size: int, where: str) -> None:
    if [len(row) for row in rows] != [size] * size:
        raise schema.DataError(f"{where}: got {rows}, expected {size} rows of {size} numbers.")
