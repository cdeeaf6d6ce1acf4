"""File p6: what the authors' CarlaDataset picks and reads from recordings in the MUVO layout, against our reader.

p6_pointers.json says which frames their class picks, under which settings, and p6_dataset.npz what it reads. All is
computed again from the recordings: the range view by ops/range_view.py in float32, all else exactly. Where the authors
differ from what muvo_jax does by default (their windows end two frames early, their intrinsics are of another field of
view than the recording's), this module follows them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import random
import re
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import scipy.ndimage

from muvo_jax import config as config_lib
from muvo_jax.data import pictures, schema
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.interop.parity import cases, golden
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_view_ops

POINTERS_FILE = "p6_pointers.json"
_ROWS_HZ = 10.0
_MOST_POINTS, _BIRDVIEW_SIDE = 60_000, 192  # where the arrays do not say
_VEHICLE_BITS = (1 << muvo_files.BIRDVIEW_BITS.index("vehicle")) | (1 << muvo_files.BIRDVIEW_BITS.index("pedestrian"))
# Of the range view: share of the pixels that may differ, and how much the others may.
_PIXEL_SHARE, _XYZ_M, _RANGE_M = 5e-4, 1e-5, 1e-4
Checks = Iterator[cases.Check]


class _Recordings:
    """What both groups read first.

    Raises:
      GoldenError: where p6_pointers.json is missing or unreadable.
      DataError: where the recordings are.
    """

    def __init__(self, context: cases.Context):
        assert context.recordings is not None
        path = context.file.path.with_name(POINTERS_FILE)
        try:
            self.expected = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise golden.GoldenError(f"{path}: expected the pointers of the file ({error}).") from error
        self.config = self.expected["config"]
        self.runs = muvo_runs.find_runs(context.recordings)


def batches(context: cases.Context) -> Checks:
    """Every entry of every batch, their types and shapes, and the mask of what the camera cannot show."""
    recordings = _Recordings(context)
    for name, described in recordings.expected["batches"].items():
        yield from _batch(name, described, recordings)
    side, *_ = context.shape("bev_out_of_view_mask") or (_BIRDVIEW_SIDE,)
    yield cases.Check("bev_out_of_view_mask", _out_of_view(recordings.config, side), 0.0, _different)


def _alone(name: str, ours: Any, theirs: Any) -> cases.Check:
    return cases.Check(name, ours, 0.0, lambda _pack, _entry, got: 0.0 if got == theirs else math.inf,
                       stands_alone=True)


def starts(frames: int, length: int, stride: int, skipped: int) -> range:
    """First frames of the authors' windows in a run: their bound loses the last windows that would still fit."""
    return range(skipped, frames - stride * length)


def pointers(runs: list[muvo_runs.Run], split: str, length: int, config: Mapping) -> list[list]:
    """[run, frames] of every window of a split, in the authors' order; runs of little reward are left out."""
    stride, skipped = int(config["STRIDE_SEC"] * _ROWS_HZ), int(config["FILTER_BEGINNING"] * _ROWS_HZ)
    return [[_short(run), list(range(start, start + length * stride, stride))] for run in runs
            if run.split == split and not run.mean_reward < config["FILTER_NORM_REWARD"]
            for start in starts(run.frames, length, stride, skipped)]


def _short(run: muvo_runs.Run) -> str:
    return run.name.removeprefix(f"{run.split}/")


def pointer_lists(context: cases.Context) -> Checks:
    """Runs, filters, windows in order, the reduced set and other window lengths."""
    recordings = _Recordings(context)
    config, runs = recordings.config, recordings.runs
    for split, theirs in recordings.expected["splits"].items():
        here = [run for run in runs if run.split == split]
        low = [_short(run) for run in here if run.mean_reward < config["FILTER_NORM_REWARD"]]
        ours = pointers(runs, split, config["SEQ"], config)
        rewards = {run: values["mean_reward"] for run, values in theirs["runs"].items()}
        off = max([abs(run.mean_reward - rewards.get(_short(run), math.inf)) for run in here], default=0.0)
        yield _alone(f"{split}: runs and frames", {_short(run): run.frames for run in here},
                     {run: values["frames"] for run, values in theirs["runs"].items()})
        yield cases.Check(f"{split}: mean rewards", off, 1e-12, lambda _pack, _entry, got: got, stands_alone=True)
        yield _alone(f"{split}: filtered", low, theirs["filtered"])
        yield _alone(f"{split}: kept", [_short(run) for run in here if _short(run) not in low], theirs["kept"])
        yield _alone(f"{split}: length", len(ours), theirs["len"])
        yield _alone(f"{split}: pointers", ours, theirs["pointers"])
    yield _alone("data module", _data_module(runs, config), recordings.expected.get("datamodule"))
    for name, theirs in recordings.expected.items():
        reduced = re.fullmatch(r"reduction_factor_(\d+)_(\w+)", name)
        other = re.fullmatch(r"seq(\d+)_(?:default_)?(\w+)_first_last_len", name)
        if reduced:  # EVAL.DATASET_REDUCTION: a sample by Python's generator with seed 0
            every = pointers(runs, reduced[2], config["SEQ"], config)
            yield _alone(name, random.Random(0).sample(every, int(len(every) / int(reduced[1]))), theirs)
        elif other:
            windows = [frames for _, frames in pointers(runs, other[2], int(other[1]), config)]
            bounds: list[Any] = [windows[0], windows[-1], len(windows)] if windows else [None, None, 0]
            yield _alone(name, bounds, theirs)


def _data_module(runs: list[muvo_runs.Run], config: Mapping) -> dict[str, Any]:
    """Sizes of the authors' data module: all validation sets are its test set, every 50th window validates.

    The second and third validation sets are entered late, so that small ones give nothing.
    """
    sizes = {split: len(pointers(runs, split, config["SEQ"], config)) for split in ("train", "val0", "val1", "val2")}
    samplers = [len(range(first, sizes[f"val{index}"], 50)) for index, first in enumerate((0, 1500, 3000))]
    return {"train_dataset": sizes["train"], **{f"val_dataset_{index}": sizes[f"val{index}"] for index in range(3)},
            "test_dataset": sum(sizes[f"val{index}"] for index in range(3)), "val_samplers": samplers}


def _batch(batch: str, described: Mapping, recordings: _Recordings) -> Checks:
    place = (described["split"], described["run"])
    run = next((run for run in recordings.runs if (run.split, _short(run)) == place), None)
    if run is None:
        raise schema.DataError(f"the recordings have no run {place[1]} in {place[0]}, which {batch} was read from.")
    shapes = {name: form["shape"] for name, form in described["entries"].items()}
    frames = [_read_frame(run, row, recordings.config, shapes) for row in described["frames"]]
    for name, form in described["entries"].items():
        if name not in frames[0]:
            raise schema.DataError(f"{batch}/{name}: the recordings do not hold it.")
        ours = np.stack([frame[name] for frame in frames])
        yield _alone(f"{batch}/{name}: dtype and shape", [str(ours.dtype), list(ours.shape)],
                     [form["dtype"], form["shape"]])
        if name == "voxel":
            yield cases.Check(f"{batch}/voxel@nonzero", np.flatnonzero(ours), 0.0, _different)
        if name == "range_view_pcd_xyzd":
            yield from _range_view(batch, ours)
        else:
            yield cases.Check(f"{batch}/{name}", ours, *_MEASURES.get(name, (0.0, _different)))


def _read_frame(run: muvo_runs.Run, row: int, config: Mapping, shapes: Mapping) -> dict[str, np.ndarray]:
    """One frame under the names and in the form of the authors' batches, all of their optional entries included.

    `shapes` are those of the batch's entries: the recording does not say how large range views and clouds are.
    """
    *_, rows, columns = shapes.get("range_view_pcd_xyzd", (muvo_reader.LIDAR.rows, muvo_reader.LIDAR.columns))
    *_, most_points, _ = shapes.get("points_raw", (_MOST_POINTS, 3))
    lidar = dataclasses.replace(muvo_reader.LIDAR, rows=rows, columns=columns)
    action = muvo_runs.actions(run)[row]
    image = pictures.read(run.path("image", row), "RGB")
    depth, tags = muvo_files.read_depth_semantic(run.path("depth_semantic", row))
    birdview = muvo_files.read_birdview(run.path("birdview", row))
    scan = muvo_files.read_points(run.path("points_semantic", row), lidar.position_m)
    height_px, width_px = config["IMAGE_SIZE"]
    classes = muvo_files.is_occupied(tags).astype(np.int64)
    raw = np.zeros((most_points, 3), np.float32)
    raw[:len(scan.points_m)] = scan.points_m[:most_points]
    bits = int(run.columns["n_classes"][row])
    planes = _bit_planes(birdview, bits)
    frame = {
        "image": image.transpose(2, 0, 1),
        "route_map": np.repeat(muvo_files.read_route_map(run.path("routemap", row))[None], 3, axis=0),
        "birdview": planes.astype(np.float32),
        "birdview_label": np.where(planes, np.arange(bits)[:, None, None], 0).max(axis=0)[None],
        "instance_label": scipy.ndimage.label(birdview & _VEHICLE_BITS)[0][None].astype(np.int32),
        "range_view_pcd_xyzd": range_view_ops.project(scan.points_m, lidar).transpose(2, 0, 1),
        "points_raw": raw, "num_points": np.int64(len(scan.points_m)),
        "image_instance_mask": np.isin(tags, (muvo_files.PEDESTRIAN, muvo_files.VEHICLE))[None],
        "semantic_image": classes[None], "depth": np.where(depth > 0.999, -1.0, depth)[None],
        "depth_color": pictures.read(run.path("depth_semantic", row), "RGBA")[..., :3].transpose(2, 0, 1) / 255.0,
        "throttle_brake": action[:1], "steering": action[1:], "speed": run.numbers("speed", 1)[row],
        "reward": np.clip(run.numbers("reward", 1)[row], -1.0, 1.0), "value_function": run.numbers("value", 1)[row],
        "intrinsics": camera_ops.intrinsics_from_fov(width_px, height_px, math.radians(config["IMAGE_FOV"])),
        "extrinsics": camera_ops.level_camera_to_ego(muvo_reader.MOUNT_M),
    }
    if scan.tags is not None:
        frame["range_view_pcd_seg"] = _range_classes(scan, lidar)[None]
    if "voxel_path" in run.columns:
        frame["voxel"] = muvo_files.read_voxels(run.path("voxel", row), muvo_reader.VOXELS)[None]
    return frame


def _bit_planes(birdview: np.ndarray, bits: int) -> np.ndarray:
    return (birdview[None] >> np.arange(bits, dtype=np.uint16)[:, None, None] & 1).astype(bool)


def _range_classes(scan: muvo_files.Points, geometry: config_lib.RangeViewGeometry) -> np.ndarray:
    """Class of the nearest point of each pixel, in float64 as the authors compute it; 0 where empty."""
    points_m = scan.points_m.astype(np.float64)
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
    classes[row[order], column[order]] = muvo_files.is_occupied(scan.tags)[order]
    return classes


def _out_of_view(config: Mapping, side: int) -> np.ndarray:
    """bool [side, side], the birdview cells that the cropped camera image cannot show; row 0 is farthest ahead.

    The authors' configuration: cells of 0.2 m, ego 32 cells above the bottom edge, camera 1 m ahead of it, image
    columns 64 to 895 of 960.
    """
    cell_m, crop = 0.2, (64, 896)
    focal_px = camera_ops.intrinsics_from_fov(config["IMAGE_SIZE"][1], config["IMAGE_SIZE"][0],
                                              math.radians(config["IMAGE_FOV"]))[0, 0].astype(np.float64)
    behind = int(32 + 1.0 / cell_m)
    right_m = np.arange(-side // 2, side // 2) * cell_m
    ahead_m = 0.01 + np.arange(side - behind)[::-1] * cell_m
    column_px = right_m[None] / ahead_m[:, None] * focal_px + config["IMAGE_SIZE"][1] / 2 - crop[0]
    hidden = (column_px < 0) | (column_px >= crop[1] - crop[0])
    return np.concatenate([hidden, np.ones((behind, side), bool)])


def _different(file: golden.File, entry: str, got: np.ndarray) -> float:
    """0 where equal: by checksum where there is one, else by all stored values. Minus zero equals zero."""
    checksum = file.arrays.get(f"{entry}::crc32")
    if checksum is not None:
        if zlib.crc32(np.ascontiguousarray(got.astype(np.int64)).tobytes()) == int(checksum[0]):
            return 0.0
        return max(_share(file, entry, got), 1.0 / max(got.size, 1))
    return _share(file, entry, got)


def _share(file: golden.File, entry: str, got: np.ndarray) -> float:
    """Of the values stored, those that differ; all where there are not as many of them."""
    try:
        return file.share_different(entry, got)
    except ValueError:
        return 1.0


def _absolute(file: golden.File, entry: str, got: np.ndarray) -> float:
    stored = file.arrays[entry] if entry in file.arrays else file.arrays[f"{entry}::sub"]
    have = got if entry in file.arrays else got.reshape(-1)[::int(file.arrays[f"{entry}::meta"][0])]
    return float(np.abs(have.astype(np.float64) - stored).max(initial=0.0))


# How far an entry may be off; what is not named must be equal.
_MEASURES = {"intrinsics": (1e-6, golden.File.error), "depth": (1e-7, _absolute), "depth_color": (1e-7, _absolute)}


def _range_view(batch: str, ours: np.ndarray) -> Checks:
    """The filled pixels, the values in those that both fill, and the image as it is stored.

    Where a rounding error lets another point win, or fall into the next pixel, the pixel differs as a whole.
    """
    flat = ours.transpose(0, 2, 3, 1).reshape(-1, 4)
    mine = np.flatnonzero(flat[:, 3] >= 0)

    def pixels(file: golden.File, entry: str, got: np.ndarray) -> float:
        return len(np.setxor1d(got, file[entry])) / max(len(file[entry]), 1)

    def values(file: golden.File, entry: str, got: np.ndarray) -> float:
        theirs = file[f"{batch}/range_view@pixels"]
        both = np.isin(theirs, mine)
        off_m = np.abs(got[theirs[both]] - file[entry][both])
        return float(((off_m[:, :3].max(axis=1) > _XYZ_M) | (off_m[:, 3] > _RANGE_M)).mean()) if len(off_m) else 1.0

    def image(file: golden.File, entry: str, got: np.ndarray) -> float:
        stored = file.arrays[f"{entry}::sub"]
        have = got.reshape(-1)[::int(file.arrays[f"{entry}::meta"][0])]
        return float((np.abs(have - stored) > _RANGE_M).mean())

    yield cases.Check(f"{batch}/range_view@pixels", mine, _PIXEL_SHARE, pixels)
    yield cases.Check(f"{batch}/range_view@values", flat, _PIXEL_SHARE, values)
    yield cases.Check(f"{batch}/range_view_pcd_xyzd", ours, _PIXEL_SHARE, image)


GROUPS = (pointer_lists, batches)
