"""Plain recordings written in the MUVO layout, as the authors' DataWriter leaves them, for their code to read.

    OUT/trainval/<mode>/<Town>/<run>/...    see files.py; one run for each gap-free sequence
    OUT/sensors.toml                        ours: where the sensors sit (the authors' code passes it over)
    OUT/runs.csv                            mode, town, run, and what of the source it is (recording, run, first frame,
                                            frames, and a fingerprint of the files that it was made of)

The plain format knows no expert's policy, no satellite position and no bird's-eye view of other cars: those columns are
zeros, as an autopilot leaves them, and the birdview is background throughout. The weather's name is that of frames.csv,
the town's the one that a run's name begins with, as in record_carla's (Town01_003). Frames without a recorded reward
get 1, lest the authors' filter drop the run. Where a run has no yaw rate, gyroscopes are zeros, and sensors.toml says
yaw_rate = false, by which our reader leaves them out. Voxels are written where the recorded grid is the authors'; else
make them from depth and lidar afterwards. Nothing here needs pandas.
"""

from __future__ import annotations

import csv
import io
import pathlib
import re
import shutil
import warnings
from collections.abc import Callable, Iterator

import numpy as np
from PIL import Image

from muvo_jax.data import description, fields, files, fingerprints, processes, schema, sequences
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import frame_pickle
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import tags as muvo_tags
from muvo_jax.data.plain import reader as plain_reader

# What the town's classes are in CARLA's tags (town/boxes.py: sky, road, marking, pavement, grass, building, ...).
TOWN_TAGS = np.array([13, 7, 6, 8, 22, 1, 9, 5, 10, 4], np.uint8)
_OTHER_TAG = 3
_LAYOUT_PX = 192
_COMMAND_FOLLOW = 4
_BACKGROUND = 1  # bit 0
_NO_WEATHER = "ClearNoon"  # where none is recorded
RUNS_FILE = "runs.csv"
_LOCK_FILE = ".exporting"
_COLUMNS = ("mode", "town", "run", "recording", "source", "first_frame", "frames", "fingerprint")
_TOWN = re.compile(r"(Town\d+\w*?)(?:_|$)")
_LABELS = frozenset({"depth_m", "image_classes", "point_classes"})
_WEATHER = ("cloudiness", "fog_density", "fog_distance", "fog_falloff", "precipitation", "precipitation_deposits",
            "sun_altitude_angle", "sun_azimuth_angle", "wetness", "wind_intensity")


def export(source: pathlib.Path | str, out: pathlib.Path | str, *, town: str = "Town01",
           progress: Callable[[int, int], None] | None = None) -> int:
    """Writes every sequence of a plain recording as a run of the MUVO layout; complete runs of it are kept.

    Args:
      source: a plain recording with image, depth, classes, points and route map.
      out: folder of the new recording.
      town: of the runs whose name does not say it; the authors' voxel step looks for Town*.
      progress: called with (frames done, frames in all).

    Returns:
      How many frames were written.

    Raises:
      DataError: where the source lacks what the authors' reader always opens, or a file is damaged.
      FileExistsError: where `out` holds an export of other sensors or another recording, or of this one as it was
        before its files were changed.
      BlockingIOError: where another process exports into `out`.
    """
    source, out = pathlib.Path(source).expanduser(), pathlib.Path(out).expanduser()
    if not re.fullmatch(r"Town\w+", town):
        raise ValueError(f"--town={town}: expected a name such as Town01; the authors' code looks for those.")
    recording = plain_reader.PlainRecording(source, labels=_LABELS)
    _check(recording, source)
    runs = _plan(recording, town)
    total, written = sum(sequence.length for _, sequence in runs), 0
    out.mkdir(parents=True, exist_ok=True)
    with processes.locked(out / _LOCK_FILE, "exporting"):
        _describe(recording, out)
        _keep_table(source, out, recording, runs)
        for folder, sequence in runs:
            target = out / muvo_runs.VERSION_FOLDER / folder
            if not (target / muvo_runs.FRAME_FILE).is_file():
                for _ in _write_run(recording, sequence, target):
                    written += 1
                    if progress is not None:
                        progress(written, total)
    return written


def _check(recording: plain_reader.PlainRecording, source: pathlib.Path) -> None:
    described = recording.description
    names = {"image": "image", "points_m": "points_m", "route_map": "route_map", "depth_m": "depth",
             "image_classes": "classes"}
    there = sequences.in_every_frame(recording)
    lacking = [name for field, name in names.items() if field not in there]
    if lacking or described.lidar is None:
        raise schema.DataError(f"{source}: the authors' reader always opens image, depth, classes, points and route "
                               f"map; this recording has no {', '.join(lacking)}.")


def _describe(recording: plain_reader.PlainRecording, out: pathlib.Path) -> None:
    described = recording.description
    has_yaw = "yaw_rate_radps" in sequences.in_every_frame(recording)
    if not has_yaw:
        warnings.warn(f"{described.name}: not every run has yaw_rate_radps or yaw_rad: gyroscopes of the export are "
                      f"zeros there, as of a car that never turns. Our reader leaves yaw rate and pose out, the "
                      f"authors' code cannot know it.", schema.DataWarning, stacklevel=3)
    voxels = described.voxels if described.voxels == muvo_reader.VOXELS else None
    route_map = described.route_map if described.route_map != muvo_reader.ROUTE_MAP else None
    said = {"rate_hz": described.rate_hz, "tags": muvo_tags.OLDER} | ({} if has_yaw else {"yaw_rate": False})
    files.write_description(out / muvo_reader.SENSORS_FILE, said | description.tables(
        camera=described.camera, lidar=described.lidar, action=described.contract, voxels=voxels,
        route_map=route_map), "other sensors")


def _plan(recording: plain_reader.PlainRecording, town: str) -> list[tuple[str, schema.Sequence]]:
    """(mode/town/run, sequence): "train" stays, the other splits become val0, val1, ... in their order."""
    others = [split for split in recording.description.splits if split != "train"]
    modes = {"train": "train"} | {split: f"val{index}" for index, split in enumerate(others)}
    counts: dict[str, int] = {}
    plan = []
    for sequence in recording.sequences:
        named = _TOWN.match(sequence.name.rsplit("/", 1)[-1])
        folder = f"{modes[sequence.split]}/{named[1] if named else town}"
        number = counts.setdefault(folder, 0)
        counts[folder] += 1
        plan.append((f"{folder}/{number:04d}", sequence))
    return plan


def _keep_table(source: pathlib.Path, out: pathlib.Path, recording: plain_reader.PlainRecording,
                runs: list[tuple[str, schema.Sequence]]) -> None:
    """Writes runs.csv, before any run; complete runs that are there must be those that it names.

    Raises:
      FileExistsError: where one is of something else.
    """
    path = out / RUNS_FILE
    states = {name: _state(source, name) for name in {sequence.name for _, sequence in runs}}
    rows = [[*pathlib.PurePosixPath(folder).parts, recording.description.name, sequence.name, str(sequence.start),
             str(sequence.length), states[sequence.name]] for folder, sequence in runs]
    before = _rows_of(path)
    for complete in sorted((out / muvo_runs.VERSION_FOLDER).glob(f"*/*/*/{muvo_runs.FRAME_FILE}")):
        place = complete.parent.parts[-3:]
        old, new = (next((row for row in table if tuple(row[:3]) == place), []) for table in (before, rows))
        if old != new:
            raise FileExistsError(f"{complete.parent} was made of "
                                  f"{_told(old, f'something that {RUNS_FILE} does not say')}, but would now be "
                                  f"{_told(new, 'no run of this recording')} ({source}). Choose another folder, or "
                                  f"remove {out} to export anew.")
    table = io.StringIO(newline="")
    csv.writer(table, lineterminator="\n").writerows([_COLUMNS, *rows])
    files.write_atomically(path, table.getvalue())


def _state(source: pathlib.Path, run: str) -> str:
    """The fingerprint of what a run is made of; not of the whole source, in which the export may lie."""
    described = fingerprints.of_files(source, [source / plain_reader.DESCRIPTION_FILE])
    return fingerprints.combined([described, fingerprints.of_runs(source / run, [run])[run]])


def _rows_of(path: pathlib.Path) -> list[list[str]]:
    """Those of a runs.csv; none where there is none, or it is damaged."""
    try:
        return list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))[1:]
    except (FileNotFoundError, UnicodeDecodeError, csv.Error):
        return []


def _told(row: list[str], nothing: str) -> str:
    """What a row of runs.csv says of its source."""
    if len(row) != len(_COLUMNS):
        return nothing
    *_, recording, run, first, frames, fingerprint = row
    return f"{frames} frames from {first} on of {run} of {recording}, whose files have the fingerprint {fingerprint}"


def _write_run(recording: plain_reader.PlainRecording, sequence: schema.Sequence,
               target: pathlib.Path) -> Iterator[int]:
    """Writes one run, the data frame last; yields after each frame."""
    shutil.rmtree(target, ignore_errors=True)
    for kind in (*muvo_files.KINDS, "image_left", "image_right", "image_all"):
        (target / kind).mkdir(parents=True)
    described = recording.description
    has_voxels = (described.voxels == muvo_reader.VOXELS and "occupancy" in described.modalities
                  and sequence.has(("occupancy",)))
    if not has_voxels:
        (target / "voxel").rmdir()
    rows = []
    for index in range(sequence.length):
        frame = recording.read(sequence, index)
        _write_frame(frame, recording, target, index)
        rows.append(frame)
        yield index
    weathers = recording.words(sequence, "weather") or [""] * len(rows)
    content = frame_pickle.frame(_columns(rows, target.parent.name, [name or _NO_WEATHER for name in weathers],
                                          has_voxels))
    draft = target / f".{muvo_runs.FRAME_FILE}.part"
    draft.write_bytes(content)
    draft.replace(target / muvo_runs.FRAME_FILE)


def _write_frame(frame: schema.RawFrame, recording: plain_reader.PlainRecording, target: pathlib.Path,
                 number: int) -> None:
    described = recording.description
    assert described.lidar is not None and described.camera is not None
    for name in ("intrinsics", "camera_to_ego"):
        if not np.array_equal(frame[name], np.asarray(getattr(described.camera, name), np.float32)):  # type: ignore
            raise schema.DataError(f"frame {int(frame['frame_id'])} has {name} of its own in frames.csv, but the "
                                   f"layout knows one camera for all. Export frames of one camera.")
    tags_of = _layout_tags(recording)

    def path(kind: str) -> pathlib.Path:
        return target / muvo_files.file_name(kind, number)

    def save(kind: str, pixels: np.ndarray) -> None:
        Image.fromarray(np.ascontiguousarray(pixels)).save(path(kind), compress_level=1)

    save("image", frame["image"])
    save("depth_semantic", np.concatenate([muvo_files.encode_depth(frame["depth_m"]),
                                           tags_of[frame["image_classes"]][..., None]], axis=-1))
    route = frame["route_map"]
    save("routemap", np.where(np.kron(route, np.ones((_LAYOUT_PX // route.shape[0],) * 2, np.uint8)) > 127, 255, 0)
         .astype(np.uint8))
    save("birdview", np.full((_LAYOUT_PX, _LAYOUT_PX), _BACKGROUND, np.uint16))
    hit = tags_of[frame["point_classes"]] if "point_classes" in frame else np.full(len(frame["points_m"]), _OTHER_TAG,
                                                                                  np.uint8)
    path("points_semantic").write_bytes(frame_pickle.npy_of_dict(
        {"points_xyz": to_lidar_frame(frame["points_m"], described.lidar.position_m), "ObjTag": hit}))
    if described.voxels == muvo_reader.VOXELS and "occupancy" in frame:
        z, y, x = np.nonzero(frame["occupancy"].transpose(2, 1, 0) == 1)
        np.save(path("voxel"), np.stack([x, y, z, np.full(len(x), _OTHER_TAG)], axis=1).astype(np.uint16))


def _layout_tags(recording: plain_reader.PlainRecording) -> np.ndarray:
    """uint8 [256], class of the recording -> tag of the layout, by name; without names they are the layout's already.

    The town names none and has its own.
    """
    names = recording.stated_classes
    tags = np.arange(256, dtype=np.uint8)
    if names:
        known = {name: tag for tag, name in enumerate(muvo_files.CLASSES)}
        tags[:len(names)] = [known.get(name, _OTHER_TAG) for name in names]
    elif recording.description.name == "town":
        tags[:len(TOWN_TAGS)] = TOWN_TAGS
    tags[fields.UNKNOWN] = 0  # unlabelled; the authors' reader knows no tag beyond 22
    return tags


def to_lidar_frame(points_m: np.ndarray, lidar_position_m: tuple[float, float, float]) -> np.ndarray:
    """Ego frame (x forward, y left) to CARLA's lidar frame (y right), float32 [N, 3] in Fortran order."""
    x, y, z = (np.float32(value) for value in lidar_position_m)
    moved = points_m.astype(np.float32) * np.array([[1, -1, 1]], np.float32) - np.array([[x, -y, z]], np.float32)
    return np.asfortranarray(moved)


def _columns(rows: list[schema.RawFrame], town: str, weathers: list[str], has_voxels: bool) -> dict:
    """All columns in the order of DataWriter (and generate_voxels), with its types."""
    count = len(rows)

    def cells(size: int, dtype=np.float32, value: float = 0.0) -> list[np.ndarray]:
        return [np.full(size, value, dtype) for _ in range(count)]

    def paths(kind: str) -> list[str]:
        return [muvo_files.file_name(kind, number) for number in range(count)]

    def imu(row: schema.RawFrame) -> np.ndarray:
        reading = np.zeros(7, np.float32)
        reading[5] = -row.get("yaw_rate_radps", np.float32(0))
        return reading

    accelerations = [float(row["action"][0]) for row in rows]
    actions = [np.array([max(value, 0.0), row["action"][1], max(-value, 0.0)], np.float32)
               for value, row in zip(accelerations, rows, strict=True)]
    columns: dict = {
        "action_mu": cells(1), "action_sigma": cells(1), "action": actions,
        "speed": [np.array([row["speed_mps"]], np.float32) for row in rows],
        "reward": np.array([row.get("reward", 1.0) for row in rows], np.float64), "value": np.zeros(count, np.float32),
        "features": cells(1), "gnss": cells(3), "target_gps": cells(3), "imu": [imu(row) for row in rows],
        "command": cells(1, np.int8, _COMMAND_FOLLOW), "target_gps_next": cells(3),
        "command_next": cells(1, np.int8, _COMMAND_FOLLOW),
    }
    columns |= {f"{kind}_path": paths(kind) for kind in ("image", "depth_semantic", "birdview", "routemap",
                                                         "points_semantic")}
    columns |= {"n_classes": np.full(count, len(muvo_files.BIRDVIEW_BITS), np.int64),
                "is_expert": np.ones(count, bool), "weather": weathers, "town": [town] * count,
                "n_vehicles": [[0, 0]] * count, "n_walkers": [[0, 0]] * count, "route_id": np.zeros(count, np.int64),
                "env_id": ["Endless-v0"] * count}
    columns |= {name: np.zeros(count, np.float64) for name in _WEATHER}
    return columns | ({"voxel_path": paths("voxel")} if has_voxels else {})
