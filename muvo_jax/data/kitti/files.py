"""The single files of a KITTI raw drive: scans, motion and place (oxts), calibration."""

from __future__ import annotations

import math
import pathlib

import numpy as np

from muvo_jax.data import fields, files, schema, sequences
from muvo_jax.limits import between

LIDAR_HEIGHT_M = 1.73
# The recording car around its lidar (x from, to; y from, to). It returns about 40 points a scan.
_OWN_CAR_M = ((-2.7, 2.6), (-1.9, 1.9))
# Columns of an oxts line: speed forward (m/s), acceleration forward (m/s2), angular rate about the up axis (rad/s).
_OXTS_COLUMNS, _SPEED, _ACCELERATION, _YAW_RATE = 30, 8, 14, 22
_LATITUDE, _LONGITUDE, _YAW = 0, 1, 5  # degrees, degrees, rad (0 is east)
_EARTH_RADIUS_M = 6378137.0
_UNIT_TO_EGO_M = (0.81, -0.32)  # forward and left, from the GPS unit to the lidar (calib_imu_to_velo.txt)
CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
# Columns of an oxts line that are used, and what they may be.
_OXTS_LIMITS = {_LATITUDE: ("latitude", between(-90, 90, "degrees")), _LONGITUDE: ("longitude", between(-180, 180,
                "degrees")), _YAW: ("yaw", between(-2 * math.pi, 2 * math.pi, "rad")),
                _SPEED: ("forward speed", between(-100, 150, "m/s")),
                _ACCELERATION: ("forward acceleration", between(-100, 100, "m/s2")),
                _YAW_RATE: ("angular rate about the up axis", between(-20, 20, "rad/s"))}
_REFLECTANCE_SHARE = 0.01  # more of it outside [0, 1] is no reflectance


def read_scan(path: pathlib.Path) -> np.ndarray:
    """Returns one velodyne scan as points float32 [N, 3] in the ego frame (reflectance is not used).

    Raises:
      DataError: for a missing, unreadable or empty file, a size that is no multiple of 16 bytes, or more than 1 % of
        the points NaN or nothing but zeros.
    """
    content = files.read_bytes(path, "a velodyne scan")
    if not content or len(content) % 16:
        raise schema.DataError(f"{path}: {len(content)} bytes; a velodyne scan is a positive multiple of 16 bytes "
                               f"(float32 x, y, z, reflectance). The file is truncated or no scan: copy it again, or "
                               f"delete it so that the sequence is split there.")
    rows = np.frombuffer(content, np.float32).reshape(-1, 4)
    files.check_written(rows, path)
    points_m = files.finite_points(rows[:, :3], path)
    reflectance = rows[:, 3]
    if np.mean((reflectance < 0) | (reflectance > 1)) > _REFLECTANCE_SHARE:
        raise schema.DataError(f"{path}: the fourth number of its points reaches from {reflectance.min():g} to "
                               f"{reflectance.max():g}; a reflectance lies between 0 and 1. Is it a scan of float32 x, "
                               f"y, z, reflectance?")
    fields.conform("points_m", points_m, str(path))
    (rear, front), (right, left) = _OWN_CAR_M
    x, y = points_m[:, 0], points_m[:, 1]
    own = (x > rear) & (x < front) & (y > right) & (y < left)
    return points_m[~own] + np.array([[0.0, 0.0, LIDAR_HEIGHT_M]], np.float32)


def read_oxts(path: pathlib.Path) -> tuple[float, float, float]:
    """Returns forward speed (m/s), forward acceleration (m/s2) and yaw rate (rad/s, left positive).

    Raises:
      DataError: for a missing or unreadable file or one that is not a line of 30 numbers.
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
    content = files.read_bytes(path, "the motion of the frame (oxts)")  # its error is a ValueError, too
    try:
        values = [float(word) for word in content.decode("utf-8-sig").split()]
    except ValueError as error:
        raise schema.DataError(f"{path}: not a line of numbers ({error}).") from error
    if len(values) != _OXTS_COLUMNS or not all(map(math.isfinite, values)):
        raise schema.DataError(f"{path}: {len(values)} values, expected {_OXTS_COLUMNS} finite numbers (see "
                               f"dataformat.txt of KITTI). Unpack the oxts data of this drive again.")
    for column, (name, limits) in _OXTS_LIMITS.items():
        if not limits.holds(values[column]):
            raise schema.DataError(f"{path}: {name} (number {column + 1}) is {values[column]:g}; it must be {limits} "
                                   f"(see dataformat.txt of KITTI).")
    return values


def read_camera(date_folder: pathlib.Path, number: str) -> schema.Camera:
    """Returns the rectified camera `number` ("02") in the ego frame.

    A point goes lidar -> camera 0 (R, T) -> rectified camera 0 (R_rect_00) -> this camera (the fourth column of P_rect,
    which is K times the shift along the baseline).

    Raises:
      DataError: where a calibration file or a key is missing, or a key is there twice with different numbers.
    """
    of_cameras, of_lidar = (date_folder / name for name in CALIBRATION)
    cameras = _read_calibration(of_cameras, {f"P_rect_{number}": 12, "R_rect_00": 9, f"S_rect_{number}": 2})
    lidar = _read_calibration(of_lidar, {"R": 9, "T": 3})
    projection = cameras[f"P_rect_{number}"].reshape(3, 4)
    intrinsics = projection[:, :3]
    width_px, height_px = (round(side) for side in cameras[f"S_rect_{number}"])
    try:
        lidar_to_camera0 = _rigid(lidar["R"].reshape(3, 3), lidar["T"])
        rectify = _rigid(cameras["R_rect_00"].reshape(3, 3), np.zeros(3))
        shift = _rigid(np.eye(3), np.linalg.solve(intrinsics, projection[:, 3]))
        lidar_to_ego = _rigid(np.eye(3), np.array([0.0, 0.0, LIDAR_HEIGHT_M]))
        camera_to_ego = lidar_to_ego @ np.linalg.inv(shift @ rectify @ lidar_to_camera0)
        return schema.Camera.of(width_px, height_px, intrinsics, camera_to_ego)
    except ValueError as error:
        raise schema.DataError(f"{date_folder}: {' and '.join(CALIBRATION)} make no camera: {error}") from error


def text_lines(path: pathlib.Path, what: str) -> list[str]:
    """The lines of a text file; raises DataError, which calls it `what`, where it is missing or unreadable."""
    try:
        return files.read_bytes(path, what).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise schema.DataError(f"{path}: not a text file ({error}). Unpack it again.") from error


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def _read_calibration(path: pathlib.Path, sizes: dict[str, int]) -> dict[str, np.ndarray]:
    text = text_lines(path, "the calibration of this date (KITTI offers it as a separate download)")
    pairs = [(key, value.strip()) for key, _, value in (line.partition(":") for line in text if ":" in line)]
    if twice := sequences.named_twice(pair for pair in pairs if pair[0] in sizes):
        key, one, other = twice
        raise schema.DataError(f"{path}: \"{key}:\" is there twice, as {one} and as {other}. Remove the wrong line, or "
                               f"unpack the calibration of this date again.")
    lines = dict(pairs)
    values = {}
    for key, size in sizes.items():
        try:
            values[key] = np.array([float(word) for word in lines[key].split()])
        except (KeyError, ValueError):
            values[key] = np.zeros(0)
        if values[key].size != size or not np.isfinite(values[key]).all():
            raise schema.DataError(f"{path}: expected a line \"{key}:\" with {size} finite numbers; the file has the "
                                   f"keys {', '.join(lines) or 'none'}. Unpack the calibration of this date again.")
    return values
