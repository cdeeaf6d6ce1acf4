"""Single scans of LIDAR_TOP, a Velodyne HDL-32E on the roof of a Renault Zoe."""

from __future__ import annotations

import pathlib

import numpy as np

from muvo_jax.data import fields, files, schema

BEAMS = 32
# The recording car around the middle of its rear axle (x from, to; y from, to), with its mirrors.
_OWN_CAR_M = ((-0.9, 3.7), (-1.0, 1.0))
_COLUMNS = 5  # x, y, z (m), intensity, number of the beam
_ROW_BYTES = 4 * _COLUMNS
_INTENSITY_END = 255
_STRANGE_SHARE = 0.01  # more points of an intensity or beam that cannot be are no scan


def read_scan(path: pathlib.Path, lidar_to_ego: np.ndarray) -> np.ndarray:
    """Returns a scan as points float32 [N, 3] in the ego frame, without the returns of the recording car.

    Args:
      lidar_to_ego: float64 [4, 4].

    Raises:
      DataError: for a missing, unreadable or empty file, a size that is no multiple of 20 bytes, more than 1 % NaN
        points, more rows of nothing but zeros than one beam has, or numbers that are no intensities and beams.
    """
    content = files.read_bytes(path, "a scan of LIDAR_TOP")
    if not content or len(content) % _ROW_BYTES:
        raise schema.DataError(f"{path}: {len(content)} bytes; a scan of nuScenes is a positive multiple of "
                               f"{_ROW_BYTES} bytes (float32 x, y, z, intensity, beam). The file is truncated or no "
                               f"scan: copy it again, or delete it so that the sequence is split there.")
    rows = np.frombuffer(content, np.float32).reshape(-1, _COLUMNS)
    # What does not return lies at the lidar itself, with the number of its beam: such rows of zeros are beam 0's alone.
    files.check_written(rows, path, most=1 / BEAMS)
    intensity, beam = rows[:, 3], rows[:, 4]
    for name, values, is_sound, expected in (
            ("intensities", intensity, (intensity >= 0) & (intensity <= _INTENSITY_END), f"0 to {_INTENSITY_END}"),
            ("beams", beam, np.isin(beam, np.arange(BEAMS)), f"whole numbers from 0 to {BEAMS - 1}")):
        if np.mean(~is_sound) > _STRANGE_SHARE:
            raise schema.DataError(f"{path}: its {name} reach from {values.min():g} to {values.max():g}, expected "
                                   f"{expected}. Is it a scan of float32 x, y, z, intensity, beam?")
    points_m = files.finite_points(rows[:, :3], path)
    fields.conform("points_m", points_m, str(path))
    moved_m = (points_m @ lidar_to_ego[:3, :3].T + lidar_to_ego[:3, 3]).astype(np.float32)
    (rear, front), (right, left) = _OWN_CAR_M
    x, y = moved_m[:, 0], moved_m[:, 1]
    return moved_m[~((x > rear) & (x < front) & (y > right) & (y < left))]
