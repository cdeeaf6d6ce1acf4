"""Makes the occupancy of recordings from depth maps and lidar scans, frame by frame and in parallel.

Rule "carved" (ours): what a ray hit is occupied, what rays of lidar and camera passed through is empty, the rest is
unknown. Rule "reference": what is hit is occupied and all else counts as empty, in the MUVO layout point for point
and label for label as the authors' generate_voxels.

    plain format, both rules    <run>/occupancy/000012.npz
    MUVO layout, carved         <run>/occupancy/occupancy_000000012.npz; their code does not look there, ours does
    MUVO layout, reference      <run>/voxel/voxel_000000012.npy, and the column voxel_path in pd_dataframe.pkl

Files are numbered as the frame's others. rule.json beside them says how they were made; files of two rules, grids or
calibrations are never mixed.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import pathlib
import shutil
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import description, fields, files, pictures, processes, schema
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import frame_pickle, safe_pickle
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.plain import cameras
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import voxels as voxel_ops

RULES = ("carved", "reference")
ORIGINAL_FRAME_FILE = "pd_dataframe.before_voxels.pkl"
_LOCK_FILE = ".voxelizing"
_CHUNK = 4  # frames that a process makes at a time
_LEVEL = ((0, 0, 1), (-1, 0, 0), (0, -1, 0))


class Frame(NamedTuple):
    """The files of one frame, two to read, one to write; its intrinsics and camera_to_ego, if not the Rig's, and the
    table that they stand in, if they are the frame's own.
    """

    depth: pathlib.Path
    points: pathlib.Path
    target: pathlib.Path
    calibration: schema.RawFrame | None = None
    table: pathlib.Path | None = None


class Rig(NamedTuple):
    """What holds for all frames; `camera` is None for the authors' in the MUVO layout, whatever the image's size."""

    is_muvo: bool
    rule: str
    camera: schema.Camera | None
    lidar_position_m: tuple[float, float, float]
    grid: config_lib.VoxelGrid


class Result(NamedTuple):
    """How many frames were made, and how many were there and are kept."""

    made: int
    kept: int


def voxelize(path: pathlib.Path | str, *, rule: str = "carved", overwrite: bool = False, workers: int | None = None,
             progress: Callable[[int, int], None] | None = None) -> Result:
    """Makes what is missing of the occupancy of a recording, and again what is older than the depth map, scan or
    camera that it was made of; other whole files that are there are kept.

    Args:
      path: a plain recording, or any folder of the MUVO layout (all its runs and frames, as in the authors' tool).
      rule: one of RULES.
      overwrite: makes everything anew.
      workers: processes, by default one for each processor.
      progress: called with (frames done, frames in all).

    Raises:
      DataError: for a path of another kind, without depth or lidar, without a described grid; or, when all other
        frames are done, for frames that cannot be made.
      FileExistsError: where files of another rule, grid or calibration are there, or of one that no rule.json says.
      BlockingIOError: where another process works on `path`.
      RuntimeError: where a worker was killed.
    """
    path = pathlib.Path(path).expanduser()
    if rule not in RULES or (workers is not None and workers < 1):
        raise ValueError(f"rule {rule!r}, {workers} workers: expected one of {', '.join(RULES)}, at least one worker.")
    rig, runs = _survey(path, rule)
    frames = [frame for run in runs.values() for frame in run]
    with processes.locked(path / _LOCK_FILE, "voxelizing"):
        processes.check_free(_other_locks(path, runs), "voxelizing")
        how, folders = _how(rig), {frame.target.parent for frame in frames}
        ours = {folder for folder in folders if (folder / files.RULE_FILE).is_file()}
        for folder in folders:
            _clear(folder, how, overwrite)
        missing = [frame for frame in frames if not files.is_whole_array(frame.target)
                   or (frame.target.parent in ours and _is_stale(frame))]
        for folder in {frame.target.parent for frame in missing}:
            folder.mkdir(exist_ok=True)
            files.write_atomically(folder / files.RULE_FILE, json.dumps(how) + "\n")
        kept = len(frames) - len(missing)
        chunks = [missing[first:first + _CHUNK] for first in range(0, len(missing), _CHUNK)]
        workers = min(workers or processes.processors(), len(chunks))
        made = (processes.spread(make_frames, chunks, shared=(rig,), workers=workers, doing="voxelizing")
                if workers > 1 else (make_frames(rig, chunk) for chunk in chunks))
        faults: list[str] = []
        done = kept
        for outcomes in made:
            faults += filter(None, outcomes)
            done += len(outcomes)
            if progress is not None:
                progress(done, len(frames))
        if rig.is_muvo and rule == "reference":
            for folder, run in runs.items():
                if all(frame.target.is_file() for frame in run):
                    _add_column(folder, run)
    if faults:
        raise schema.DataError(f"{path}: {len(faults)} of {len(frames)} frames have no occupancy, the others are done. "
                               f"{' '.join(faults[:3])}{' ...' * (len(faults) > 3)}")
    return Result(made=len(missing), kept=kept)


def _other_locks(path: pathlib.Path, runs: Collection[pathlib.Path]) -> list[pathlib.Path]:
    """Of whoever may work on some of these runs by another path: one above, or one between it and the runs."""
    here = path.resolve()
    between = {parent for run in runs for parent in (run.resolve(), *run.resolve().parents)
               if parent.is_relative_to(here)}
    above = here.parents[:muvo_runs.MOST_LEVELS]
    return [folder / _LOCK_FILE for folder in sorted({*between, *above} - {here})]


def make_frames(rig: Rig, frames: list[Frame]) -> list[str]:
    """Makes frames; what was wrong with each, or an empty string."""
    outcomes = []
    for frame in frames:
        try:
            files.write_atomically(frame.target, _content(rig, frame))
        except schema.DataError as error:
            outcomes.append(str(error))
        else:
            outcomes.append("")
    return outcomes


def carved_occupancy(depth_m: np.ndarray, points_m: np.ndarray, intrinsics: np.ndarray, camera_to_ego: np.ndarray,
                     lidar_position_m: tuple[float, float, float], grid: config_lib.VoxelGrid, *,
                     keep: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The occupancy of one frame.

    Every pixel and every point occupies. Of the pixels, only so many carve that their rays, at the far end of the grid,
    lie at most a voxel apart.

    Args:
      depth_m: [H, W], along the optical axis; infinite in the sky (such a ray carves to the grid's border), NaN or not
        positive where nothing was measured.
      points_m: float32 [P, 3], ego frame, of the lidar.
      intrinsics, camera_to_ego: [3, 3] and [4, 4].
      keep: leaves out points [Q, 3] that count for nothing, such as the recording car's own.

    Returns:
      uint8 [X, Y, Z]: 1 occupied, 0 empty, 255 unknown.
    """
    camera_m = camera_to_ego[:3, 3]
    corners_m = np.array([grid.origin_m, np.add(grid.origin_m, np.multiply(grid.shape, grid.voxel_size_m))])
    reach_m = float(np.linalg.norm(np.abs(corners_m - camera_m).max(axis=0)))  # every voxel is nearer to the camera
    stride = max(1, int(grid.voxel_size_m * min(intrinsics[0, 0], intrinsics[1, 1]) / reach_m))
    thinned_m = np.full_like(depth_m, np.nan)
    chosen = np.s_[stride // 2::stride, stride // 2::stride]
    thinned_m[chosen] = np.where(np.isposinf(depth_m[chosen]), reach_m, depth_m[chosen])
    ends_m = keep(camera_ops.depth_to_points(thinned_m, intrinsics, camera_to_ego))
    seen_m = keep(camera_ops.depth_to_points(depth_m, intrinsics, camera_to_ego))
    occupied = voxel_ops.voxelize(np.concatenate([seen_m, points_m]), grid) == voxel_ops.OCCUPIED
    empty = voxel_ops.carve(camera_m, ends_m, grid) | voxel_ops.carve(np.array(lidar_position_m), points_m, grid)
    return np.where(occupied, voxel_ops.OCCUPIED, np.where(empty, voxel_ops.EMPTY, voxel_ops.UNKNOWN)).astype(np.uint8)


def _survey(path: pathlib.Path, rule: str) -> tuple[Rig, dict[pathlib.Path, list[Frame]]]:
    """What is measured with, and the frames of every run by its folder; checks that there is depth and lidar."""
    if (path / plain_reader.DESCRIPTION_FILE).is_file():
        rig, runs = _survey_plain(path, rule)
    elif path.is_dir() and muvo_runs.folders(path):
        rig, runs = _survey_muvo(path, rule)
    else:
        raise schema.DataError(f"{path} is no recording whose occupancy can be made; expected a plain one (a folder "
                               f"with {plain_reader.DESCRIPTION_FILE}) or runs of the MUVO layout (with "
                               f"{muvo_runs.FRAME_FILE}).")
    for folder, frames in runs.items():
        for what, places in (("depth map", {frame.depth for frame in frames}),
                             ("lidar scan", {frame.points for frame in frames})):
            if places and not any(place.is_file() for place in places):
                raise schema.DataError(f"{folder}: no frame has a {what} (such as {min(places)}); occupancy is made "
                                       f"from both. Record them, or train without: then the target is made from each "
                                       f"scan alone.")
    return rig, runs


def _survey_plain(path: pathlib.Path, rule: str) -> tuple[Rig, dict[pathlib.Path, list[Frame]]]:
    toml_path = path / plain_reader.DESCRIPTION_FILE
    header = plain_reader.read_header(path)
    if "voxels" not in header:
        raise schema.DataError(f"{toml_path}: no section [voxels], the grid to fill; add one, such as [voxels] shape = "
                               f"[192, 192, 64], voxel_size_m = 0.5, origin_m = [-48.0, -48.0, -6.0].")
    camera, lidar, grid = (description.section(header, name, toml_path, required=True)
                           for name in ("camera", "lidar", "voxels"))
    runs = {}
    for run in plain_reader.read_runs(path, description.splits(header, toml_path)):
        cameras.check(run.columns, camera, run.folder / plain_reader.FRAMES_FILE)
        depths, scans, targets = (plain_reader.frame_files(run, name) for name in ("depth_m", "points_m", "occupancy"))
        has_own = any(field.columns[0] in run.columns for field in cameras.FIELDS)
        table = run.folder / plain_reader.FRAMES_FILE if has_own else None
        runs[run.folder] = [Frame(depths[row], scans[row], targets[row], cameras.of_frame(run.columns, row, camera),
                                  table)
                            for row in range(len(depths))]
    return Rig(False, rule, camera, lidar.position_m, grid), runs


def _survey_muvo(path: pathlib.Path, rule: str) -> tuple[Rig, dict[pathlib.Path, list[Frame]]]:
    header, toml_path = muvo_reader.read_sensors(path)
    camera, lidar, grid = (description.section(header, name, toml_path, required=False)
                           for name in ("camera", "lidar", "voxels"))
    runs = {}
    for run in muvo_runs.find_runs(path):
        lacking = [kind for kind in ("depth_semantic", "points_semantic") if f"{kind}_path" not in run.columns]
        if lacking:
            raise schema.DataError(f"{run.folder / muvo_runs.FRAME_FILE}: no column {lacking[0]}_path; occupancy is "
                                   f"made from depth and lidar. Record both.")
        names = (muvo_reader.occupancy_names(run) if rule == "carved" else
                 [muvo_files.file_name("voxel", number) for number in muvo_runs.numbering(run).tolist()])
        depths, scans = (muvo_runs.find_files(run, kind) for kind in ("depth_semantic", "points_semantic"))
        runs[run.folder] = [Frame(depths.path(row), scans.path(row), run.folder / name)
                            for row, name in enumerate(names)]
    return Rig(True, rule, camera, (lidar or muvo_reader.LIDAR).position_m, grid or muvo_reader.VOXELS), runs


def _how(rig: Rig) -> dict[str, Any]:
    """What rule.json says: rule and grid, which description.check_rule reads, and how the sensors sit."""
    camera = None if rig.camera is None else {name: getattr(rig.camera, name) for name in ("intrinsics",
                                                                                          "camera_to_ego")}
    said = {"rule": rig.rule} | dataclasses.asdict(rig.grid)
    said |= dict(zip(description.CALIBRATION, (camera, rig.lidar_position_m), strict=True))
    return json.loads(json.dumps(said))


def _is_stale(frame: Frame) -> bool:
    """Whether what a frame's file was made of was changed since."""
    made_ns = frame.target.stat().st_mtime_ns
    return any(path is not None and path.is_file() and path.stat().st_mtime_ns > made_ns
               for path in (frame.depth, frame.points, frame.table))


def _clear(folder: pathlib.Path, how: Mapping[str, Any], overwrite: bool) -> None:
    """Removes what an interrupted write left in a folder of results, and all results where that is wanted."""
    path = folder / files.RULE_FILE
    if overwrite:
        for old in folder.glob("*.np[yz]"):
            old.unlink()
    elif path.is_file():
        description.check_same_rule(path, how)
    else:
        _check_unruled(folder)
    for draft in folder.glob(".*.np[yz].*"):
        draft.unlink()


def _check_unruled(folder: pathlib.Path) -> None:
    """Raises FileExistsError for files that nobody noted a rule and grid of; the authors' tables of voxels need none.

    Tables that are cut off pass, too: they are made again.
    """
    for path in sorted(folder.glob("[!.]*.np[yz]")):
        header = files.npy_header(path) if path.suffix == ".npy" else None
        if header is not None and (len(header.shape) != 2 or header.shape[1] != 4 or header.dtype.kind not in "ui"):
            raise FileExistsError(f"{path}: {header.dtype} {list(header.shape)}, expected a table of voxels, whole "
                                  f"numbers [M, 4]. --overwrite removes the files there and makes all anew.")
        if path.suffix == ".npz":
            raise FileExistsError(f"{path}: no {files.RULE_FILE} beside it says by which rule and grid it was made. "
                                  f"--overwrite removes the files there and makes all anew; or move them away.")


def _content(rig: Rig, frame: Frame) -> bytes:
    """The bytes of the frame's new file."""
    if rig.is_muvo:
        depth, tags = muvo_files.read_depth_semantic(frame.depth)
        scan = muvo_files.read_points(frame.points, rig.lidar_position_m)
        fields.conform("points_m", scan.points_m, str(frame.points))
        if rig.rule == "reference":
            file = io.BytesIO()
            np.save(file, _reference_table(rig, frame, depth * muvo_files.DEPTH_RANGE_M, tags, scan))
            return file.getvalue()
        keep: Callable[[np.ndarray], np.ndarray] = _without_own_car
        depth_m, points_m = np.where(depth < 1.0, depth * muvo_files.DEPTH_RANGE_M, np.inf), scan.points_m
    else:
        depth_m, points_m = _read_plain(frame)
        keep = _all
    intrinsics, camera_to_ego = _pinhole(rig.camera, depth_m.shape, frame.depth)
    if frame.calibration is not None:
        intrinsics, camera_to_ego = frame.calibration["intrinsics"], frame.calibration["camera_to_ego"]
    if rig.rule == "reference":
        seen_m = camera_ops.depth_to_points(depth_m, intrinsics, camera_to_ego)
        occupancy = voxel_ops.voxelize(np.concatenate([seen_m, points_m]), rig.grid)
    else:
        occupancy = carved_occupancy(depth_m, points_m, intrinsics, camera_to_ego, rig.lidar_position_m, rig.grid,
                                     keep=keep)
    return files.npz_bytes({"occupancy": occupancy})


def _read_plain(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] and points [N, 3], m, float32, of which the reader of the plain format would say the same."""
    recorded = (files.read_npz(frame.depth, "depth_m") if frame.depth.suffix.lower() == ".npz" else
                pictures.read(frame.depth, "depth_m"))
    points_m = fields.conform("points_m", files.read_npz(frame.points, "points_m"), str(frame.points))
    return fields.conform("depth_m", recorded, str(frame.depth)), files.finite_points(points_m, frame.points)


def _reference_table(rig: Rig, frame: Frame, depth_m: np.ndarray, tags: np.ndarray,
                     scan: muvo_files.Points) -> np.ndarray:
    if scan.tags is None:
        raise schema.DataError(f"{frame.points}: no ObjTag, what each point hit; the reference rule labels with it. "
                               f"Use the rule {RULES[0]}.")
    fov_rad, position_m = muvo_reader.FOV_RAD, muvo_reader.MOUNT_M
    if rig.camera is not None:
        intrinsics, camera_to_ego = _pinhole(rig.camera, depth_m.shape, frame.depth)
        centre_px = (depth_m.shape[1] / 2, depth_m.shape[0] / 2)
        if not (np.allclose(camera_to_ego[:3, :3], _LEVEL) and np.allclose(intrinsics[:2, 2], centre_px)):
            raise schema.DataError(f"{muvo_reader.SENSORS_FILE}: the reference rule knows only level cameras with a "
                                   f"centred principal point. Use the rule {RULES[0]}.")
        fov_rad = 2.0 * math.atan(0.5 * depth_m.shape[1] / float(intrinsics[0, 0]))
        x_m, y_m, z_m = map(float, camera_to_ego[:3, 3])
        position_m = (x_m, y_m, z_m)
    seen_m, pixel = camera_ops.reference_depth_points(depth_m, fov_rad, position_m)
    points_m, hit = np.concatenate([seen_m, scan.points_m]), np.concatenate([tags.reshape(-1)[pixel], scan.tags])
    kept = ~muvo_files.in_ego_box(points_m)
    return voxel_ops.voxel_table(points_m[kept], hit[kept], rig.grid, winning_tag=muvo_files.ROAD_LINE)


def _all(points_m: np.ndarray) -> np.ndarray:
    return points_m


def _without_own_car(points_m: np.ndarray) -> np.ndarray:
    return points_m[~muvo_files.in_ego_box(points_m)]


def _pinhole(camera: schema.Camera | None, shape: tuple[int, ...],
             path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    height_px, width_px = shape
    if camera is None:
        return (camera_ops.intrinsics_from_fov(width_px, height_px, muvo_reader.FOV_RAD),
                camera_ops.level_camera_to_ego(muvo_reader.MOUNT_M))
    if (camera.width_px, camera.height_px) != (width_px, height_px):
        raise schema.DataError(f"{path}: {width_px}x{height_px} pixels, but the camera is described with "
                               f"{camera.width_px}x{camera.height_px}; depth must be that of the image.")
    return np.asarray(camera.intrinsics, np.float32), np.asarray(camera.camera_to_ego, np.float32)


def _add_column(folder: pathlib.Path, frames: list[Frame]) -> None:
    """Tells the data frame where the voxels are, as the authors' tool does; the original is kept beside it."""
    path = folder / muvo_runs.FRAME_FILE
    columns = safe_pickle.load_table(path)
    if "voxel_path" in columns:
        return
    names = [frame.target.relative_to(folder).as_posix() for frame in frames]
    if not (folder / ORIGINAL_FRAME_FILE).exists():
        shutil.copyfile(path, folder / ORIGINAL_FRAME_FILE)
    files.write_atomically(path, frame_pickle.frame(dict(columns) | {"voxel_path": names}))
