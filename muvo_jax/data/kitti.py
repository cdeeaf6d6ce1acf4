"""KITTI raw folders (Geiger et al., IJRR 2013), read where they are.

Layout: <date>/calib_*.txt and <date>/<date>_drive_NNNN_sync/{image_02,velodyne_points,oxts}/data/NNNNNNNNNN.*, with
image_02/timestamps.txt. The path may be the folder of dates, a date or a drive. Camera images or scans may be missing
altogether; oxts may not, since actions come from it. image_00 and image_01 are grey, image_02 and image_03 colour.

Ego frame: x forward, y left, z up, origin on the ground under the lidar, which sits 1.73 m above the ground (the
velodyne axes point the same way, so a point only moves up by 1.73 m). The IMU's own place does not matter: only its
forward speed, forward acceleration and yaw rate are used.

KITTI records neither pedals nor steering wheel: actions are derived from the motion by a bicycle model, and the
contract says so. There is no route map, no reward and no second town: the first two thirds of each drive train, the
last third validates. The few returns of the recording car itself are left out.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import pathlib
import re
import warnings

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import files, schema

LIDAR_HEIGHT_M = 1.73
# The recording car around its lidar (x from, to; y from, to). It returns about 40 points a scan.
_OWN_CAR_M = ((-2.7, 2.6), (-1.9, 1.9))
# HDL-64E: 64 beams over 26.8 degrees, nominally -24.8 to +2.0. The calibrated scans reach from about -24 to +2.8, so
# the field of view is taken a little wider, lest the highest beams fall into one row.
LIDAR = config_lib.RangeViewGeometry(rows=64, columns=2048, elevation_min_rad=math.radians(-25.0),
                                     elevation_max_rad=math.radians(3.0), position_m=(0.0, 0.0, LIDAR_HEIGHT_M))
CONTRACT = config_lib.ActionContract(wheelbase_m=2.71, rate_hz=10.0, kinematics="bicycle", source="derived")
# Columns of an oxts line: speed forward (m/s), acceleration forward (m/s2), angular rate about the up axis (rad/s).
_OXTS_COLUMNS, _SPEED, _ACCELERATION, _YAW_RATE = 30, 8, 14, 22
_LATITUDE, _LONGITUDE, _YAW = 0, 1, 5  # degrees, degrees, rad (0 is east)
_EARTH_RADIUS_M = 6378137.0
_UNIT_TO_EGO_M = (0.81, -0.32)  # forward and left, from the GPS unit to the lidar (calib_imu_to_velo.txt)
_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}_sync")
_NOTE_SPLITS = ("KITTI: the first two thirds of each drive train, the last third is split \"val\"; there is no "
                "domain-shift split.")
_NOTE_ACTIONS = "KITTI: actions are derived from speed, acceleration and yaw rate (bicycle model), not recorded."
CAMERAS = ("image_00", "image_01", "image_02", "image_03")
_SUFFIXES = {"velodyne_points": ".bin", "oxts": ".txt"}


@dataclasses.dataclass(frozen=True)
class _Drive:
    folder: pathlib.Path
    camera: schema.Camera | None
    frame_ids: np.ndarray  # int64 [F], every number from the first frame of any sensor to the last
    absent: dict[str, int]  # sensor -> how many of frame_ids it lacks
    present: np.ndarray  # bool [F], whether all sensors have the frame
    timestamps_s: np.ndarray  # float64 [F], NaN for a missing frame


def find_drives(path: pathlib.Path) -> list[pathlib.Path]:
    """The drive folders at `path`, in it, or in its date folders, sorted by name."""
    if _DRIVE.fullmatch(path.resolve().name):
        return [path]
    return sorted(found for pattern in ("*_sync", "*/*_sync") for found in path.glob(pattern)
                  if found.is_dir() and _DRIVE.fullmatch(found.name))


def derive_action(speed_mps: float, acceleration_mps2: float, yaw_rate_radps: float,
                  contract: config_lib.ActionContract) -> np.ndarray:
    """The action (float32 [2]) that a bicycle model would need to move like this; yaw rate > 0 turns left."""
    full_mps2 = contract.accel_full_mps2 if acceleration_mps2 >= 0 else contract.brake_full_mps2
    steering_rad = -math.atan(contract.wheelbase_m * yaw_rate_radps / max(speed_mps, 1.0))
    return np.clip(np.array([acceleration_mps2 / full_mps2, steering_rad / contract.steer_full_rad]),
                   -1.0, 1.0).astype(np.float32)


class KittiRecording:
    """The drives under a path as one recording, seen by one of its cameras."""

    def __init__(self, path: pathlib.Path | str, camera: str = "image_02"):
        """Reads calibration and time stamps and looks which frames exist; frames themselves are read by `read`.

        Args:
          path: of a drive, a date or the folder of dates.
          camera: one of CAMERAS.

        Raises:
          DataError: where there is no drive, no drive has oxts and another sensor, or one lacks calibration or time
            stamps; for a camera that KITTI does not have.
        """
        path = pathlib.Path(path)
        if camera not in CAMERAS:
            raise schema.DataError(f"KITTI has no camera {camera!r}; it has {', '.join(CAMERAS)}.")
        folders = find_drives(path)
        if not folders:
            raise files.missing(path / "<date>_drive_NNNN_sync", "a KITTI raw drive")
        self._camera = camera
        sensors = {camera: ".png", **_SUFFIXES}
        self._sensors = {sensor: suffix for sensor, suffix in sensors.items()
                         if sensor == "oxts" or any(_has(folder, sensor, suffix) for folder in folders)}
        others = [name for name in CAMERAS if any(_has(folder, name, ".png") for folder in folders)]
        if camera not in self._sensors and (others or len(self._sensors) < 2):
            raise schema.DataError(f"{path}: no drive has frames of {camera}; there are "
                                   f"{', '.join(others) or 'none'} of other cameras. Unpack the synced drives, or "
                                   f"name a camera that is there.")
        whole = [folder for folder in folders
                 if all(_has(folder, sensor, suffix) for sensor, suffix in self._sensors.items())]
        if not whole:
            raise _lacking(folders[0], self._sensors)
        for folder in sorted(set(folders) - set(whole)):
            warnings.warn(f"{_lacking(folder, self._sensors)} The drive is left out.", schema.DataWarning, stacklevel=2)
        self._drives = {folder.resolve().name: _open_drive(folder, self._sensors) for folder in whole}
        steps = np.concatenate([np.diff(drive.timestamps_s) for drive in self._drives.values()])
        period_s = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1.0 / CONTRACT.rate_hz
        rate_hz = round(1.0 / period_s, 1)
        self.sequences = tuple(sequence for drive in self._drives.values()
                               for sequence in _cut(drive, period_s))
        modalities = {"speed_mps", "yaw_rate_radps", "pose", "action", "timestamp_s", "frame_id"}
        modalities |= {"image", "intrinsics", "camera_to_ego"} if camera in self._sensors else set()
        modalities |= {"points_m"} if "velodyne_points" in self._sensors else set()
        self.description = schema.RecordingDescription(
            name=", ".join(self._drives), kind="KITTI raw", rate_hz=rate_hz,
            camera=next(iter(self._drives.values())).camera, lidar=LIDAR if "points_m" in modalities else None,
            voxels=None, contract=dataclasses.replace(CONTRACT, rate_hz=rate_hz), modalities=frozenset(modalities),
            splits=("train", "val"), notes=(_NOTE_SPLITS, _NOTE_ACTIONS))

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        drive = self._drives[sequence.name]
        position = sequence.start + index
        frame_id = int(drive.frame_ids[position])
        paths = {sensor: drive.folder / sensor / "data" / f"{frame_id:010d}{suffix}"
                 for sensor, suffix in self._sensors.items()}
        speed_mps, acceleration_mps2, yaw_rate_radps = read_oxts(paths["oxts"])
        first = paths["oxts"].with_name(f"{int(drive.frame_ids[sequence.start]):010d}.txt")
        frame: schema.RawFrame = {
            "speed_mps": np.float32(speed_mps),
            "yaw_rate_radps": np.float32(yaw_rate_radps),
            "pose": read_pose(paths["oxts"], first),
            "action": derive_action(speed_mps, acceleration_mps2, yaw_rate_radps, self.description.contract),
            "timestamp_s": np.float64(drive.timestamps_s[position]),
            "frame_id": np.int64(frame_id),
        }
        if drive.camera is not None:
            image = files.read_image(paths[self._camera], "RGB")
            if image.shape[:2] != (drive.camera.height_px, drive.camera.width_px):
                raise schema.DataError(f"{paths[self._camera]}: {image.shape[1]}x{image.shape[0]} pixels, but the "
                                       f"calibration (S_rect) is for {drive.camera.width_px}x{drive.camera.height_px}. "
                                       f"Use rectified (synced) images, or scale P_rect and S_rect with them.")
            frame["image"] = image
            frame["intrinsics"] = np.asarray(drive.camera.intrinsics, np.float32)
            frame["camera_to_ego"] = np.asarray(drive.camera.camera_to_ego, np.float32)
        if "velodyne_points" in paths:
            frame["points_m"] = read_scan(paths["velodyne_points"])
        return frame

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        drive = self._drives[sequence.name]
        frame_id = int(drive.frame_ids[sequence.start + index])
        motion = read_oxts(drive.folder / "oxts" / "data" / f"{frame_id:010d}{self._sensors['oxts']}")
        return derive_action(*motion, self.description.contract)


def _has(folder: pathlib.Path, sensor: str, suffix: str) -> bool:
    return bool(files.numbered(folder / sensor / "data", suffix))


def _lacking(folder: pathlib.Path, sensors: dict[str, str]) -> schema.DataError:
    """What the first missing sensor of a drive should have been."""
    sensor, suffix = next((name, suffix) for name, suffix in sensors.items() if not _has(folder, name, suffix))
    return files.missing(folder / sensor / "data" / f"0000000000{suffix}",
                         f"the {sensor} frames of the drive (unpack the synced drive)")


def read_scan(path: pathlib.Path) -> np.ndarray:
    """Returns one velodyne scan as points float32 [N, 3] in the ego frame (reflectance is not used).

    Raises:
      DataError: for a missing or empty file, a size that is no multiple of 16 bytes, or more than 1 % NaN points.
    """
    if not path.is_file():
        raise files.missing(path, "a velodyne scan")
    content = path.read_bytes()
    if not content or len(content) % 16:
        raise schema.DataError(f"{path}: {len(content)} bytes; a velodyne scan is a positive multiple of 16 bytes "
                               f"(float32 x, y, z, reflectance). The file is truncated or no scan: copy it again, or "
                               f"delete it so that the sequence is split there.")
    points_m = np.frombuffer(content, np.float32).reshape(-1, 4)[:, :3]
    points_m = files.finite_points(points_m, path)
    (rear, front), (right, left) = _OWN_CAR_M
    x, y = points_m[:, 0], points_m[:, 1]
    own = (x > rear) & (x < front) & (y > right) & (y < left)
    return points_m[~own] + np.array([[0.0, 0.0, LIDAR_HEIGHT_M]], np.float32)


def read_oxts(path: pathlib.Path) -> tuple[float, float, float]:
    """Returns forward speed (m/s), forward acceleration (m/s2) and yaw rate (rad/s, left positive).

    Raises:
      DataError: for a missing file or one that is not a line of 30 numbers.
    """
    values = _oxts_values(path)
    return values[_SPEED], values[_ACCELERATION], values[_YAW_RATE]


def read_pose(path: pathlib.Path, origin: pathlib.Path) -> np.ndarray:
    """Returns the pose float64 [3] of the ego, x east and y north of where `origin` was measured (m), and yaw (rad).

    On the plane that touches the earth there, whose error is below 1 cm within some 100 m. Raises as `read_oxts`.
    """
    here, first = _oxts_values(path), _oxts_values(origin)
    north_m = _EARTH_RADIUS_M * math.radians(here[_LATITUDE] - first[_LATITUDE])
    parallel_m = _EARTH_RADIUS_M * math.cos(math.radians(first[_LATITUDE]))
    east_m = parallel_m * math.radians(here[_LONGITUDE] - first[_LONGITUDE])
    yaw_rad, (forward_m, left_m) = here[_YAW], _UNIT_TO_EGO_M
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([east_m + cosine * forward_m - sine * left_m, north_m + sine * forward_m + cosine * left_m,
                     yaw_rad])


def _oxts_values(path: pathlib.Path) -> list[float]:
    if not path.is_file():
        raise files.missing(path, "the motion of the frame (oxts)")
    try:
        values = [float(word) for word in path.read_text(encoding="utf-8").split()]
    except ValueError as error:
        raise schema.DataError(f"{path}: not a line of numbers ({error}).") from error
    if len(values) < _OXTS_COLUMNS or not all(map(math.isfinite, values)):
        raise schema.DataError(f"{path}: {len(values)} values, expected {_OXTS_COLUMNS} finite numbers (see "
                               f"dataformat.txt of KITTI). Unpack the oxts data of this drive again.")
    return values


def read_camera(date_folder: pathlib.Path, number: str) -> schema.Camera:
    """Returns the rectified camera `number` ("02") in the ego frame.

    A point goes lidar -> camera 0 (R, T) -> rectified camera 0 (R_rect_00) -> this camera (the fourth column of P_rect,
    which is K times the shift along the baseline).

    Raises:
      DataError: where a calibration file or a key is missing.
    """
    cameras = _read_calibration(date_folder / "calib_cam_to_cam.txt",
                                {f"P_rect_{number}": 12, "R_rect_00": 9, f"S_rect_{number}": 2})
    lidar = _read_calibration(date_folder / "calib_velo_to_cam.txt", {"R": 9, "T": 3})
    projection = cameras[f"P_rect_{number}"].reshape(3, 4)
    intrinsics = projection[:, :3]
    width_px, height_px = (round(side) for side in cameras[f"S_rect_{number}"])
    lidar_to_camera0 = _rigid(lidar["R"].reshape(3, 3), lidar["T"])
    rectify = _rigid(cameras["R_rect_00"].reshape(3, 3), np.zeros(3))
    shift = _rigid(np.eye(3), np.linalg.solve(intrinsics, projection[:, 3]))
    lidar_to_ego = _rigid(np.eye(3), np.array([0.0, 0.0, LIDAR_HEIGHT_M]))
    camera_to_ego = lidar_to_ego @ np.linalg.inv(shift @ rectify @ lidar_to_camera0)
    return schema.Camera.of(width_px, height_px, intrinsics, camera_to_ego)


def _lines(path: pathlib.Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise schema.DataError(f"{path}: not a text file ({error}). Unpack it again.") from error


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def _read_calibration(path: pathlib.Path, sizes: dict[str, int]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise files.missing(path, "the calibration of this date (KITTI offers it as a separate download)")
    lines = dict(line.split(":", 1) for line in _lines(path) if ":" in line)
    values = {}
    for key, size in sizes.items():
        try:
            values[key] = np.array([float(word) for word in lines[key].split()])
        except (KeyError, ValueError):
            values[key] = np.zeros(0)
        if values[key].size != size:
            raise schema.DataError(f"{path}: expected a line \"{key}:\" with {size} numbers; the file has the keys "
                                   f"{', '.join(lines) or 'none'}. Unpack the calibration of this date again.")
    return values


def _open_drive(folder: pathlib.Path, sensors: dict[str, str]) -> _Drive:
    numbers = {sensor: files.numbered(folder / sensor / "data", suffix) for sensor, suffix in sensors.items()}
    every = set().union(*numbers.values())
    frame_ids = np.arange(min(every), max(every) + 1)
    present = np.array([all(frame_id in have for have in numbers.values()) for frame_id in frame_ids.tolist()])
    if not present.any():
        raise schema.DataError(f"{folder}: no frame number is there for all of {', '.join(sensors)}. The folders are "
                               f"of different parts of a drive: unpack it again.")
    first = next(iter(sensors))
    camera = read_camera(folder.resolve().parent, first.rsplit("_", 1)[-1]) if first in CAMERAS else None
    return _Drive(folder=folder, camera=camera, frame_ids=frame_ids, present=present,
                  absent={sensor: len(frame_ids) - len(have) for sensor, have in numbers.items()},
                  timestamps_s=_read_timestamps(folder / first / "timestamps.txt", frame_ids, present))


def _read_timestamps(path: pathlib.Path, frame_ids: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Seconds of each frame, NaN where not present; line n of the file (from 0) is frame n."""
    if not path.is_file():
        raise files.missing(path, f"the time stamps of {path.parent.name}")
    lines = _lines(path)
    times_s = np.full(len(frame_ids), np.nan)
    for frame_id in frame_ids[present].tolist():
        try:
            text = lines[frame_id].strip()
            whole, _, fraction = text.partition(".")
            moment = datetime.datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=datetime.UTC)
            times_s[frame_id - frame_ids[0]] = moment.timestamp() + float(f"0.{fraction or 0}")
        except (IndexError, ValueError) as error:
            found = repr(lines[frame_id]) if frame_id < len(lines) else f"only {len(lines)} lines"
            raise schema.DataError(f"{path}: line {frame_id + 1} (the time of frame {frame_id}) is missing or not like "
                                   f"2011-09-26 13:02:25.964000000; found {found}. Take the file of the original "
                                   f"drive.") from error
    files.check_increasing(times_s[present], [f"{path}, line {frame_id + 1}" for frame_id in frame_ids[present]])
    return times_s


def _cut(drive: _Drive, period_s: float) -> list[schema.Sequence]:
    """The gap-free sequences of a drive, split at two thirds; warns of gaps."""
    boundary = len(drive.present) * 2 // 3
    late = files.after_gap(drive.timestamps_s, period_s)
    pieces = files.gap_free(drive.present, late | (np.arange(len(late)) == boundary))
    name = drive.folder.resolve().name
    files.warn_of_gaps(name, drive.present, drive.absent, late, len(pieces))
    return [schema.Sequence(split="train" if start < boundary else "val", name=name, start=start, length=length)
            for start, length in pieces]
