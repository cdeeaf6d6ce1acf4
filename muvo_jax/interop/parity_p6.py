"""Parity of the MUVO layout's reader with the authors' CarlaDataset: pointers, filters and batches (pack P6).

A pack is p6_pointers.json (which frames their class picks, with the settings it ran under) and p6_dataset.npz (what it
reads from them). Everything is computed again from the recordings: the range view by ops/range_view.py in float32, all
else exactly. Where the authors differ from what muvo_jax does by default (their windows end two frames early, their
intrinsics are of another field of view than the recording's), this module follows them.
"""

from __future__ import annotations

import json
import math
import pathlib
import random
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage

from muvo_jax.data import carla, carla_files, files, schema
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops

POINTERS_FILE, ARRAYS_FILE = "p6_pointers.json", "p6_dataset.npz"
_ROWS_HZ = 10.0
_MAX_POINTS = 60_000
_VEHICLE_BITS = (1 << carla_files.BIRDVIEW_BITS.index("vehicle")) | (1 << carla_files.BIRDVIEW_BITS.index("pedestrian"))
# How far an entry may be off; what is not named must be equal. Share of the filled pixels, metres of xyz and of range.
_RANGE_TOLERANCE = (5e-4, 1e-5, 1e-4)
_TOLERANCES = {"intrinsics": 1e-6, "depth": 1e-7, "depth_color": 1e-7}


class Check(NamedTuple):
    """One comparison.

    Attributes:
      name: what was compared.
      error: measured; 0 for equal, infinite where it cannot be compared.
      tolerance: largest error that passes.
    """

    name: str
    error: float
    tolerance: float = 0.0

    @property
    def passed(self) -> bool:
        return self.error <= self.tolerance


def check(pack: pathlib.Path, recordings: pathlib.Path) -> list[Check]:
    """Compares a pack with what this project reads from the recordings that it was made from.

    Raises:
      DataError: where the pack or the recordings cannot be read.
    """
    expected = json.loads((pack / POINTERS_FILE).read_text(encoding="utf-8"))
    arrays = {name: files.read_npz(pack / ARRAYS_FILE, name) for name in _names(pack / ARRAYS_FILE)}
    runs = carla.find_runs(recordings)
    results = _check_pointers(expected, runs)
    for batch, entry in expected["batches"].items():
        results += _check_batch(batch, entry, arrays, runs, expected["config"])
    if "bev_out_of_view_mask::crc32" in arrays:
        name = "bev_out_of_view_mask"
        results.append(_compare(name, _out_of_view(expected["config"]), arrays, name))
    return results


def starts(frames: int, length: int, stride: int, skipped: int) -> range:
    """First frames of the authors' windows in a run: their bound loses the last windows that would still fit."""
    return range(skipped, frames - stride * length)


def pointers(runs: list[carla.Run], split: str, length: int, config: Mapping) -> list[list]:
    """[run, frames] of every window of a split, in the authors' order; runs of little reward are left out."""
    stride, skipped = int(config["STRIDE_SEC"] * _ROWS_HZ), int(config["FILTER_BEGINNING"] * _ROWS_HZ)
    return [[_short(run), list(range(start, start + length * stride, stride))] for run in runs
            if run.split == split and not run.mean_reward < config["FILTER_NORM_REWARD"]
            for start in starts(run.frames, length, stride, skipped)]


def _short(run: carla.Run) -> str:
    return run.name.removeprefix(f"{run.split}/")


def _names(path: pathlib.Path) -> list[str]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return list(arrays)
    except (OSError, ValueError) as error:
        raise schema.DataError(f"{path}: not a readable NPZ file ({error}).") from error


def _check_pointers(expected: Mapping, runs: list[carla.Run]) -> list[Check]:
    config = expected["config"]
    length = config["SEQ"]

    def equal(name: str, ours: Any, theirs: Any) -> Check:
        return Check(name, 0.0 if ours == theirs else math.inf)

    results = []
    for split, theirs in expected["splits"].items():
        here = [run for run in runs if run.split == split]
        low = [_short(run) for run in here if run.mean_reward < config["FILTER_NORM_REWARD"]]
        ours = pointers(runs, split, length, config)
        rewards = {run: values["mean_reward"] for run, values in theirs["runs"].items()}
        off = max([abs(run.mean_reward - rewards.get(_short(run), math.inf)) for run in here], default=0.0)
        results += [
            equal(f"{split}/runs", {_short(run): run.frames for run in here},
                  {run: values["frames"] for run, values in theirs["runs"].items()}),
            Check(f"{split}/mean_reward", off, 1e-12),
            equal(f"{split}/filtered", low, theirs["filtered"]),
            equal(f"{split}/kept", [_short(run) for run in here if _short(run) not in low], theirs["kept"]),
            equal(f"{split}/len", len(ours), theirs["len"]), equal(f"{split}/pointers", ours, theirs["pointers"])]
    for name in expected:
        kind, *rest = name.split("_")
        if name.startswith("reduction_factor_"):  # EVAL.DATASET_REDUCTION: a sample by Python's generator, seed 0
            factor, split = int(rest[1]), rest[2]
            every = pointers(runs, split, length, config)
            chosen = random.Random(0).sample(every, int(len(every) / factor))
            results.append(equal(name, chosen, expected[name]))
        elif kind.startswith("seq") and kind[3:].isdigit() and rest[-3:] == ["first", "last", "len"]:
            windows = [frames for _, frames in pointers(runs, rest[-4], int(kind[3:]), config)]
            bounds: list[Any] = [windows[0], windows[-1], len(windows)] if windows else [None, None, 0]
            results.append(equal(name, bounds, expected[name]))
    return results


def _check_batch(batch: str, entry: Mapping, arrays: Mapping, runs: list[carla.Run], config: Mapping) -> list[Check]:
    run = next((run for run in runs if (run.split, _short(run)) == (entry["split"], entry["run"])), None)
    if run is None:
        return [Check(f"{batch}: run {entry['run']} of {entry['split']} is missing", math.inf)]
    frames = [_read_frame(run, row, config) for row in entry["frames"]]
    results = []
    for name, described in entry["entries"].items():
        if name not in frames[0]:
            results.append(Check(f"{batch}/{name}", math.inf))
            continue
        ours = np.stack([frame[name] for frame in frames])
        same = (str(ours.dtype), list(ours.shape)) == (described["dtype"], described["shape"])
        results.append(Check(f"{batch}/{name} dtype and shape", 0.0 if same else math.inf))
        if not same or not any(key.split("::")[0] == f"{batch}/{name}" for key in arrays):
            continue
        if name == "range_view_pcd_xyzd":
            results += _compare_range_view(f"{batch}/range_view", ours, arrays)
        else:
            results.append(_compare(f"{batch}/{name}", ours, arrays, f"{batch}/{name}"))
    return results


def _read_frame(run: carla.Run, row: int, config: Mapping) -> dict[str, np.ndarray]:
    """One frame under the names and in the form of the authors' batches, all of their optional entries included."""
    action = carla.actions(run)[row]
    position_m = carla.LIDAR.position_m
    image = files.read_image(run.path("image", row), "RGB")
    depth, tags = carla_files.read_depth_semantic(run.path("depth_semantic", row))
    birdview = carla_files.read_birdview(run.path("birdview", row))
    scan = carla_files.read_points(run.path("points_semantic", row), position_m)
    height_px, width_px = config["IMAGE_SIZE"]
    classes = carla_files.is_occupied(tags).astype(np.int64)
    raw = np.zeros((_MAX_POINTS, 3), np.float32)
    raw[:len(scan.points_m)] = scan.points_m
    bits = int(run.columns["n_classes"][row])
    planes = _bit_planes(birdview, bits)
    frame = {
        "image": image.transpose(2, 0, 1),
        "route_map": np.repeat(carla_files.read_route_map(run.path("routemap", row))[None], 3, axis=0),
        "birdview": planes.astype(np.float32),
        "birdview_label": np.where(planes, np.arange(bits)[:, None, None], 0).max(axis=0)[None],
        "instance_label": scipy.ndimage.label(birdview & _VEHICLE_BITS)[0][None].astype(np.int32),
        "range_view_pcd_xyzd": range_view_ops.project(scan.points_m, carla.LIDAR).transpose(2, 0, 1),
        "points_raw": raw, "num_points": np.int64(len(scan.points_m)),
        "image_instance_mask": np.isin(tags, (carla_files.PEDESTRIAN, carla_files.VEHICLE))[None],
        "semantic_image": classes[None], "depth": np.where(depth > 0.999, -1.0, depth)[None],
        "depth_color": files.read_image(run.path("depth_semantic", row), "RGBA")[..., :3].transpose(2, 0, 1) / 255.0,
        "throttle_brake": action[:1], "steering": action[1:], "speed": run.numbers("speed", 1)[row],
        "reward": np.clip(run.numbers("reward", 1)[row], -1.0, 1.0), "value_function": run.numbers("value", 1)[row],
        "intrinsics": camera_ops.intrinsics_from_fov(width_px, height_px, math.radians(config["IMAGE_FOV"])),
        "extrinsics": camera_ops.level_camera_to_ego(carla.MOUNT_M),
    }
    if scan.tags is not None:
        frame["range_view_pcd_seg"] = _range_classes(scan)[None]
    if "voxel_path" in run.columns:
        frame["voxel"] = carla_files.read_voxels(run.path("voxel", row), carla.VOXELS)[None]
    return frame


def _bit_planes(birdview: np.ndarray, bits: int) -> np.ndarray:
    return (birdview[None] >> np.arange(bits, dtype=np.uint16)[:, None, None] & 1).astype(bool)


def _range_classes(scan: carla_files.Points) -> np.ndarray:
    """Class of the nearest point of each pixel, in float64 as the authors compute it; 0 where empty."""
    geometry, points_m = carla.LIDAR, scan.points_m.astype(np.float64)
    relative_m = points_m - np.asarray(geometry.position_m)[None]
    range_m = np.sqrt((relative_m ** 2).sum(axis=1))
    yaw_rad = np.arctan2(relative_m[:, 1], relative_m[:, 0])
    elevation_rad = np.arcsin(relative_m[:, 2] / range_m)
    share = (elevation_rad - geometry.elevation_min_rad) / (geometry.elevation_max_rad - geometry.elevation_min_rad)
    column = np.clip(np.floor(0.5 * (1.0 - yaw_rad / np.pi) * geometry.columns), 0, geometry.columns - 1).astype(int)
    row = np.clip(np.floor((1.0 - share) * geometry.rows), 0, geometry.rows - 1).astype(int)
    order = np.argsort(-range_m, kind="stable")
    classes = np.zeros((geometry.rows, geometry.columns), np.int64)
    assert scan.tags is not None
    classes[row[order], column[order]] = carla_files.is_occupied(scan.tags)[order]
    return classes


def _out_of_view(config: Mapping) -> np.ndarray:
    """bool [192, 192], the birdview cells that the cropped camera image cannot show; row 0 is farthest ahead.

    The authors' configuration: cells of 0.2 m, ego 32 cells above the bottom edge, camera 1 m ahead of it, image
    columns 64 to 895 of 960.
    """
    side, cell_m, crop = 192, 0.2, (64, 896)
    focal_px = camera_ops.intrinsics_from_fov(config["IMAGE_SIZE"][1], config["IMAGE_SIZE"][0],
                                              math.radians(config["IMAGE_FOV"]))[0, 0].astype(np.float64)
    behind = int(32 + 1.0 / cell_m)
    right_m = np.arange(-side // 2, side // 2) * cell_m
    ahead_m = 0.01 + np.arange(side - behind)[::-1] * cell_m
    column_px = right_m[None] / ahead_m[:, None] * focal_px + config["IMAGE_SIZE"][1] / 2 - crop[0]
    hidden = (column_px < 0) | (column_px >= crop[1] - crop[0])
    return np.concatenate([hidden, np.ones((behind, side), bool)])


def _compare(name: str, ours: np.ndarray, arrays: Mapping, key: str) -> Check:
    """Checksum where there is one, else the stored values, whole or every n-th."""
    if f"{key}::crc32" in arrays:
        crc = zlib.crc32(np.ascontiguousarray(ours.astype(np.int64)).tobytes())
        return Check(name, 0.0 if crc == int(arrays[f"{key}::crc32"][0]) else _share_different(ours, arrays, key))
    stored, have = _stored(ours, arrays, key)
    tolerance = _TOLERANCES.get(key.split("/")[-1], 0.0)
    difference = np.abs(have.astype(np.float64) - stored.astype(np.float64))
    scale = np.maximum(np.abs(stored), 1.0) if key.endswith("intrinsics") else 1.0
    return Check(name, float((difference / scale).max(initial=0.0)), tolerance)


def _share_different(ours: np.ndarray, arrays: Mapping, key: str) -> float:
    """Of the stored values; at least one of all, since the checksums differ."""
    stored, have = _stored(ours, arrays, key)
    return max(float((stored != have).mean()), 1.0 / max(ours.size, 1))


def _stored(ours: np.ndarray, arrays: Mapping, key: str) -> tuple[np.ndarray, np.ndarray]:
    if key in arrays:
        return arrays[key], ours
    return arrays[f"{key}::sub"], ours.reshape(-1)[::int(arrays[f"{key}::meta"][0])]


def _compare_range_view(name: str, ours: np.ndarray, arrays: Mapping) -> list[Check]:
    """Filled pixels and their values; where ours and theirs fill different pixels counts, not what is in them."""
    theirs, values = arrays[f"{name}@pixels"], arrays[f"{name}@values"]
    flat = ours.transpose(0, 2, 3, 1).reshape(-1, 4)
    mine = np.flatnonzero(flat[:, 3] >= 0)
    share = len(np.setxor1d(mine, theirs)) / max(len(theirs), 1)
    both = np.isin(theirs, mine)
    off_m = np.abs(flat[theirs[both]] - values[both])
    # Another point of the pixel may have won by a rounding error: that is a different pixel, not a different value.
    same = (off_m[:, :3].max(axis=1, initial=0.0) <= _RANGE_TOLERANCE[1]) & (off_m[:, 3] <= _RANGE_TOLERANCE[2])
    share += float((~same).sum()) / max(len(theirs), 1)
    agreed = off_m[same]
    return [Check(f"{name} share of pixels", share, _RANGE_TOLERANCE[0]),
            Check(f"{name} xyz (m)", float(agreed[:, :3].max(initial=0.0)), _RANGE_TOLERANCE[1]),
            Check(f"{name} range (m)", float(agreed[:, 3].max(initial=0.0)), _RANGE_TOLERANCE[2])]


CHECKS: dict[str, Callable[[pathlib.Path, pathlib.Path], list[Check]]] = {"P6": check}
