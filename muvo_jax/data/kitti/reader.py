"""KITTI raw folders (Geiger et al., IJRR 2013), read where they are.

Layout: <date>/calib_*.txt and <date>/<date>_drive_NNNN_sync/{image_02,velodyne_points,oxts}/data/NNNNNNNNNN.*, with
image_02/timestamps.txt. The path may be the folder of dates, a date or a drive. Camera images or scans may be missing
altogether; oxts may not, since actions come from it. image_00 and image_01 are grey, image_02 and image_03 colour.

Ego frame: x forward, y left, z up, origin on the ground under the lidar, which sits 1.73 m above the ground (the
velodyne axes point the same way, so a point only moves up by 1.73 m). The IMU's own place does not matter: only its
forward speed, forward acceleration and yaw rate are used.

KITTI records neither pedals nor steering wheel: actions are derived from the motion by a bicycle model, and the
contract says so. There is no route map, no reward and no second town: the first two thirds of each drive train, the
last third validates. Drives that the odometry benchmark calls 08, 09 and 10 are the split "test", by which lidar
forecasts are compared (the card kitti-4docc-1s). The few returns of the recording car itself are left out.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
import pathlib
import re
import warnings
from collections.abc import Collection

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import ego_motion, files, pictures, runs, schema, sequences
from muvo_jax.data.kitti import files as kitti_files
from muvo_jax.data.kitti.files import LIDAR_HEIGHT_M, read_camera, read_oxts, read_pose, read_scan
from muvo_jax.limits import between

__all__ = ["CAMERAS", "CONTRACT", "LIDAR", "LIDAR_HEIGHT_M", "KittiRecording", "find_drives", "read_camera",
           "read_oxts", "read_pose", "read_scan"]

# HDL-64E: 64 beams over 26.8 degrees, nominally -24.8 to +2.0. The calibrated scans reach from about -24 to +2.8, so
# the field of view is taken a little wider, lest the highest beams fall into one row.
LIDAR = config_lib.RangeViewGeometry(rows=64, columns=2048, elevation_min_rad=math.radians(-25.0),
                                     elevation_max_rad=math.radians(3.0), position_m=(0.0, 0.0, LIDAR_HEIGHT_M))
CONTRACT = config_lib.ActionContract(wheelbase_m=2.71, rate_hz=10.0, kinematics="bicycle", source="derived")
_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}_sync")
# First and last frame of sequences 08, 09 and 10, as the benchmark's devkit lists them.
TEST = {"2011_09_30_drive_0028_sync": (1100, 5170), "2011_09_30_drive_0033_sync": (0, 1590),
        "2011_09_30_drive_0034_sync": (0, 1200)}
_NOTE_TEST = ("KITTI: drives 2011_09_30 0028, 0033 and 0034, sequences 08 to 10 of the odometry benchmark, are split "
              "\"test\".")
_NOTE_SPLITS = ("KITTI: the first two thirds of each drive train, the last third is split \"val\"; there is no "
                "domain-shift split.")
_NOTE_ACTIONS = "KITTI: actions are derived from speed, acceleration and yaw rate (bicycle model), not recorded."
CAMERAS = ("image_00", "image_01", "image_02", "image_03")
_SUFFIXES = {"velodyne_points": (".bin",), "oxts": (".txt",)}
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_PERIOD_S = between(0.001, 10, "s")  # of drives that were thinned out, too
_MOST_FRAMES = 1_000_000  # of a drive: time stamps stand on the line of a frame's number


@dataclasses.dataclass(frozen=True)
class _Drive:
    name: str
    folder: pathlib.Path
    camera: schema.Camera | None
    frame_ids: np.ndarray  # int64 [F], every number from the first frame of any sensor to the last
    absent: dict[str, int]  # sensor -> how many of frame_ids it lacks
    present: np.ndarray  # bool [F], whether all sensors have the frame
    timestamps_s: np.ndarray  # float64 [F], NaN for a missing frame
    names: dict[str, dict[int, str]]  # sensor -> frame number -> file, where it is not named as KITTI names it

    def path(self, sensor: str, frame_id: int) -> pathlib.Path:
        """The file of a frame."""
        name = self.names.get(sensor, {}).get(frame_id) or _usual(sensor, frame_id)
        return self.folder / sensor / "data" / name


def find_drives(path: pathlib.Path) -> list[pathlib.Path]:
    """The drive folders at `path`, in it, or in its date folders, sorted by name."""
    if _DRIVE.fullmatch(_name(path)):
        return [path]
    return sorted(found for pattern in ("*_sync", "*/*_sync") for found in path.glob(pattern)
                  if found.is_dir() and _DRIVE.fullmatch(found.name))


class KittiRecording:
    """The drives under a path as one recording, seen by one of its cameras."""

    def __init__(self, path: pathlib.Path | str, camera: str = "image_02"):
        """Reads calibration and time stamps and looks which frames exist; frames themselves are read by `read`.

        Args:
          path: of a drive, a date or the folder of dates.
          camera: one of CAMERAS.

        Raises:
          DataError: where there is no drive, two are of one name, no drive has oxts and another sensor, or one lacks
            calibration or time stamps; for a camera that KITTI does not have.
        """
        path = pathlib.Path(path).expanduser()
        if camera not in CAMERAS:
            raise schema.DataError(f"KITTI has no camera {camera!r}; it has {', '.join(CAMERAS)}.")
        folders = find_drives(path)
        if not folders:
            raise files.missing(path / "<date>_drive_NNNN_sync", "a KITTI raw drive")
        self._camera = camera
        every = {folder: _sensors(folder, camera) for folder in folders}
        self._sensors = _shared_sensors(every, camera)
        others = [name for name in CAMERAS if any(name in has for has in every.values())]
        if camera not in self._sensors and (others or len(self._sensors) < 2):
            raise schema.DataError(f"{path}: no drive has frames of {camera}; there are "
                                   f"{', '.join(others) or 'none'} of other cameras. Unpack the synced drives, or "
                                   f"name a camera that is there.")
        whole = [folder for folder in folders if every[folder].issuperset(self._sensors)]
        if not whole:
            raise _lacking(folders[0], self._sensors, every[folders[0]])
        for folder in sorted(set(folders) - set(whole)):
            warnings.warn(f"{_lacking(folder, self._sensors, every[folder])} The drive is left out.",
                          schema.DataWarning, stacklevel=2)
        self._drives = {name: _open_drive(folder, self._sensors) for name, folder in _named(whole, path).items()}
        steps = np.concatenate([np.diff(drive.timestamps_s) for drive in self._drives.values()])
        period_s = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1.0 / CONTRACT.rate_hz
        rate_hz = round(1.0 / period_s, 1)
        self.sequences = tuple(sequence for drive in self._drives.values()
                               for sequence in _cut(drive, period_s))
        tested = [name in TEST for name in self._drives]
        splits = (() if all(tested) else ("train", "val")) + (("test",) if any(tested) else ())
        modalities = {"speed_mps", "yaw_rate_radps", "pose", "action", "timestamp_s", "frame_id"}
        modalities |= {"image", "intrinsics", "camera_to_ego"} if camera in self._sensors else set()
        modalities |= {"points_m"} if "velodyne_points" in self._sensors else set()
        self.description = schema.RecordingDescription(
            name=", ".join(self._drives), kind="KITTI raw", rate_hz=rate_hz,
            camera=next(iter(self._drives.values())).camera, lidar=LIDAR if "points_m" in modalities else None,
            voxels=None, contract=dataclasses.replace(CONTRACT, rate_hz=rate_hz), modalities=frozenset(modalities),
            splits=splits, notes=((_NOTE_SPLITS,) if "train" in splits else ()) + (
                (_NOTE_TEST,) if "test" in splits else ()) + (_NOTE_ACTIONS,))

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        return self.read_fields(sequence, index, self.description.modalities)

    def read_fields(self, sequence: schema.Sequence, index: int, names: Collection[str]) -> schema.RawFrame:
        """See schema.ReadsFields."""
        drive = self._drives[sequence.name]
        position = sequence.start + index
        frame_id = int(drive.frame_ids[position])
        paths = {sensor: drive.path(sensor, frame_id) for sensor in self._sensors}
        speed_mps, acceleration_mps2, yaw_rate_radps = read_oxts(paths["oxts"])
        first = drive.path("oxts", int(drive.frame_ids[sequence.start]))
        frame: schema.RawFrame = {
            "speed_mps": np.float32(speed_mps),
            "yaw_rate_radps": np.float32(yaw_rate_radps),
            "pose": read_pose(paths["oxts"], first),
            "action": ego_motion.derive_action(speed_mps, acceleration_mps2, yaw_rate_radps,
                                               self.description.contract),
            "timestamp_s": np.float64(drive.timestamps_s[position]),
            "frame_id": np.int64(frame_id),
        }
        if drive.camera is not None and "image" in names:
            image = pictures.read(paths[self._camera], "RGB")
            if image.shape[:2] != (drive.camera.height_px, drive.camera.width_px):
                raise schema.DataError(f"{paths[self._camera]}: {image.shape[1]}x{image.shape[0]} pixels, but the "
                                       f"calibration (S_rect) is for {drive.camera.width_px}x{drive.camera.height_px}. "
                                       f"Use rectified (synced) images, or scale P_rect and S_rect with them.")
            frame["image"] = image
            frame["intrinsics"] = np.asarray(drive.camera.intrinsics, np.float32)
            frame["camera_to_ego"] = np.asarray(drive.camera.camera_to_ego, np.float32)
        if "velodyne_points" in paths and "points_m" in names:
            frame["points_m"] = read_scan(paths["velodyne_points"])
        return frame

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        drive = self._drives[sequence.name]
        frame_id = int(drive.frame_ids[sequence.start + index])
        motion = read_oxts(drive.path("oxts", frame_id))
        return ego_motion.derive_action(*motion, self.description.contract)


def _name(folder: pathlib.Path) -> str:
    """A drive's name: what the folder is called here; where that is no drive's name, what a link leads to."""
    here = os.path.basename(os.path.abspath(folder))
    return here if _DRIVE.fullmatch(here) else folder.resolve().name


def _named(folders: list[pathlib.Path], path: pathlib.Path) -> dict[str, pathlib.Path]:
    """Name -> folder; of a drive and a link to it the one beside which its calibration lies.

    Raises:
      DataError: where two folders are of one drive, or two drives are one folder.
    """
    found: dict[str, pathlib.Path] = {}
    for folder in folders:
        name = _name(folder)
        other = found.setdefault(name, folder)
        if other.resolve() != folder.resolve():
            raise schema.DataError(f"{path}: {other} and {folder} are both drive {name}. Take one of them away, or "
                                   f"read the folders one by one.")
        if not _has_calibration(_date_folder(other)):
            found[name] = folder
    # A drive that tests, linked to one that trains, would be judged on what was trained.
    if twice := sequences.named_twice((folder.resolve(), name) for name, folder in found.items()):
        target, one, another = twice
        raise schema.DataError(f"{path}: drives {one} and {another} are one folder, {target}. Remove one of the links.")
    return found


def _has_calibration(date_folder: pathlib.Path) -> bool:
    return any((date_folder / name).is_file() for name in kitti_files.CALIBRATION)


def _date_folder(folder: pathlib.Path) -> pathlib.Path:
    """Where the calibration of a drive lies: beside it, or only beside what a link leads to."""
    beside, target = pathlib.Path(os.path.abspath(folder)).parent, folder.resolve().parent
    return target if _has_calibration(target) and not _has_calibration(beside) else beside


def _files(folder: pathlib.Path, sensor: str) -> dict[int, str]:
    """Frame number -> name of the files of a sensor.

    Raises:
      DataError: where its folder is there in another case.
    """
    if not (folder / sensor).is_dir():
        for path in folder.iterdir():
            if path.name.lower() == sensor:
                raise schema.DataError(f"{path}: expected the name {sensor}. Rename the folder.")
    return files.numbered(folder / sensor / "data", _SUFFIXES.get(sensor, _IMAGE_SUFFIXES))


def _sensors(folder: pathlib.Path, camera: str) -> set[str]:
    """Those that a drive has. The chosen camera and the lidar need half of the frames that either has: a few pictures
    would take away the scans of all other frames. Warns of less.
    """
    numbers = {sensor: set(_files(folder, sensor)) for sensor in (*CAMERAS, *_SUFFIXES)}
    chosen = (camera, "velodyne_points")
    frames = sorted(set().union(*(numbers[sensor] for sensor in chosen)))
    few = {sensor for sensor in chosen if numbers[sensor]
           and not runs.has_files(np.array([frame in numbers[sensor] for frame in frames]))}
    for sensor in sorted(few):
        warnings.warn(f"{folder}: only {len(numbers[sensor])} of {len(frames)} frames have a file in {sensor}, which "
                      f"is not used. Copy the others, or remove it.", schema.DataWarning, stacklevel=3)
    return {sensor for sensor, there in numbers.items() if there} - few


def _usual(sensor: str, frame_id: int) -> str:
    """As KITTI names it."""
    return f"{frame_id:010d}{_SUFFIXES.get(sensor, _IMAGE_SUFFIXES)[0]}"


def _shared_sensors(every: dict[pathlib.Path, set[str]], camera: str) -> tuple[str, ...]:
    """Of camera and lidar those that half of the drives have (or the one that most have), and oxts; warns of others."""
    counts = {sensor: sum(sensor in has for has in every.values()) for sensor in (camera, "velodyne_points")}
    most = max(counts.values())
    shared = [sensor for sensor, count in counts.items() if count and (2 * count >= len(every))]
    shared = shared or [sensor for sensor, count in counts.items() if count == most > 0]
    for sensor, count in counts.items():
        if count and sensor not in shared:
            warnings.warn(f"only {count} of {len(every)} drives have {sensor}: it is not used.", schema.DataWarning,
                          stacklevel=3)
    return (*shared, "oxts")


def _lacking(folder: pathlib.Path, sensors: tuple[str, ...], there: set[str]) -> schema.DataError:
    """What the first missing sensor of a drive should have been."""
    sensor = next(name for name in sensors if name not in there)
    if _files(folder, sensor):
        return schema.DataError(f"{folder / sensor / 'data'}: too few files, expected the {sensor} frames of the drive "
                                f"(unpack the synced drive).")
    return files.missing(folder / sensor / "data" / _usual(sensor, 0),
                         f"the {sensor} frames of the drive (unpack the synced drive)")


def _open_drive(folder: pathlib.Path, sensors: tuple[str, ...]) -> _Drive:
    numbers = {sensor: _files(folder, sensor) for sensor in sensors}
    every = set().union(*numbers.values())
    if max(every) - min(every) > _MOST_FRAMES:
        raise schema.DataError(f"{folder}: its frames are numbered from {min(every)} to {max(every)}. KITTI counts "
                               f"them, and line n of timestamps.txt is frame n: rename the files to their count.")
    frame_ids = np.arange(min(every), max(every) + 1)
    present = np.array([all(frame_id in have for have in numbers.values()) for frame_id in frame_ids.tolist()])
    if not present.any():
        raise schema.DataError(f"{folder}: no frame number is there for all of {', '.join(sensors)}. The folders are "
                               f"of different parts of a drive: unpack it again.")
    first = next(iter(sensors))
    camera = read_camera(_date_folder(folder), first.rsplit("_", 1)[-1]) if first in CAMERAS else None
    return _Drive(name=_name(folder), folder=folder, camera=camera, frame_ids=frame_ids, present=present,
                  absent={sensor: len(frame_ids) - len(have) for sensor, have in numbers.items()},
                  timestamps_s=_read_timestamps(folder / first / "timestamps.txt", frame_ids, present),
                  names={sensor: {number: name for number, name in have.items() if name != _usual(sensor, number)}
                         for sensor, have in numbers.items()})


def _read_timestamps(path: pathlib.Path, frame_ids: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Seconds of each frame, NaN where not present; line n of the file (from 0) is frame n."""
    stamps = kitti_files.text_lines(path, f"the time stamps of {path.parent.name}")
    times_s = np.full(len(frame_ids), np.nan)
    for frame_id in frame_ids[present].tolist():
        try:
            text = stamps[frame_id].strip()
            whole, _, fraction = text.partition(".")
            moment = datetime.datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=datetime.UTC)
            times_s[frame_id - frame_ids[0]] = moment.timestamp() + float(f"0.{fraction or 0}")
        except (IndexError, ValueError) as error:
            found = repr(stamps[frame_id]) if frame_id < len(stamps) else f"only {len(stamps)} lines"
            raise schema.DataError(f"{path}: line {frame_id + 1} (the time of frame {frame_id}) is missing or not like "
                                   f"2011-09-26 13:02:25.964000000; found {found}. Take the file of the original "
                                   f"drive.") from error
    sequences.check_increasing(times_s[present], [f"{path}, line {frame_id + 1}" for frame_id in frame_ids[present]])
    steps_s = np.diff(times_s)  # NaN beside a missing frame
    if np.isfinite(steps_s).any() and not _PERIOD_S.holds(period_s := float(np.nanmedian(steps_s))):
        raise schema.DataError(f"{path}: frames are {period_s:g} s apart, expected {_PERIOD_S} (KITTI's are 0.1 s). "
                               f"Take the file of the original drive.")
    return times_s


def _cut(drive: _Drive, period_s: float) -> list[schema.Sequence]:
    """The gap-free sequences of a drive, split at two thirds; of one that tests what is listed. Warns of gaps."""
    name = drive.name
    boundary = len(drive.present) * 2 // 3
    sequences.warn_of_rate(name, drive.timestamps_s[drive.present], period_s)
    late = sequences.after_gap(drive.timestamps_s, period_s)
    used = drive.present
    if name in TEST:
        boundary, (first, last) = 0, TEST[name]
        used = used & (drive.frame_ids >= first) & (drive.frame_ids <= last)
    pieces = sequences.gap_free(used, late | (np.arange(len(late)) == boundary))
    sequences.warn_of_gaps(name, drive.present, drive.absent, late, len(pieces))
    split = lambda start: "test" if name in TEST else "train" if start < boundary else "val"
    return [schema.Sequence(split=split(start), name=name, start=start, length=length) for start, length in pieces]
