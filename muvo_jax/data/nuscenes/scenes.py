"""Scenes of nuScenes as runs of evenly spaced frames: which scan, which picture, where the car was and how it moved.

Scans turn up 20 times a second, pictures at 12 of these 20 turns. A frame is a scan and the picture nearest to it: of
every second scan, so that frames are 0.1 s apart, their pictures all different and at most 0.05 s away; or of each key
frame. Pictures were taken elsewhere than the scan where the car moved meanwhile: `camera_to_ego` is the camera's place
then, in the ego frame of the scan.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from typing import NamedTuple

import numpy as np

from muvo_jax.data import ego_motion, fields, files, schema
from muvo_jax.data.nuscenes import tables as tables_lib
from muvo_jax.limits import between

LIDAR = "LIDAR_TOP"
SWEEP_PERIOD_S, _SPARED_S = 0.1, 0.025  # half a turn of the lidar
_PICTURE_WITHIN_S = 0.075  # of its scan; more means that pictures were lost
_KEY_PICTURE_WITHIN_S = 0.25
_STEP_S = between(0.01, 2.0, "s")


class Motion(NamedTuple):
    """How a car moved, each [F]: see ego_motion.of_poses."""

    speed_mps: np.ndarray
    acceleration_mps2: np.ndarray
    yaw_rate_radps: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """The frames of a scene.

    Attributes:
      name, split: such as scene-0061 and train.
      time_us: int64 [F], of the scans, since 1970.
      files: "points_m" and "image" -> names of the frames' files below the data's root, bytes [F]; b"" for none.
      present: the same keys -> bool [F], whether these are there.
      pose: float64 [F, 3], x and y (m) on the map and yaw (rad).
      motion: from the poses.
      lidar_to_ego: float64 [4, 4].
      camera: as calibrated.
      camera_to_ego: float64 [F, 4, 4], in the ego frame of the scan.
    """

    name: str
    split: str
    time_us: np.ndarray
    files: dict[str, np.ndarray]
    present: dict[str, np.ndarray]
    pose: np.ndarray
    motion: Motion
    lidar_to_ego: np.ndarray
    camera: schema.Camera
    camera_to_ego: np.ndarray

    @property
    def frames(self) -> int:
        return len(self.time_us)

    @property
    def times_s(self) -> np.ndarray:
        """float64 [F]."""
        return self.time_us / 1e6


def build(root: pathlib.Path, tables: tables_lib.Tables, names: list[tuple[str, str]], camera: str, *,
          key_frames: bool) -> list[Scene]:
    """The scenes that have a scan and a picture in the tables, whatever files are there.

    Args:
      names: name and split of each scene, in the order of the tables' rows.
      key_frames: whether every scan of the tables makes a frame (they are then of key frames).

    Raises:
      DataError: for calibrations that make no camera or change within a scene, times that repeat, or motion that
        cannot be.
    """
    scans, pictures = tables.of(LIDAR), tables.of(camera)
    found = []
    for index, (name, split) in enumerate(names):
        of_scene = [rows[slice(*np.searchsorted(rows["scene"], [index, index + 1]))] for rows in (scans, pictures)]
        if all(map(len, of_scene)):
            found.append(_scene(f"{root}, {name}", name, split, tables, *of_scene, key_frames=key_frames))
    there = {key: _existing(root, [scene.files[key] for scene in found]) for key in ("points_m", "image")}
    return [dataclasses.replace(scene, present={key: values[index] for key, values in there.items()})
            for index, scene in enumerate(found)]


def _scene(where: str, name: str, split: str, tables: tables_lib.Tables, scans: np.ndarray, pictures: np.ndarray, *,
           key_frames: bool) -> Scene:
    if not (np.diff(scans["time_us"]) > 0).all():
        raise schema.DataError(f"{where}: two scans have one timestamp in sample_data.json. Unpack the metadata again.")
    step_s = float(np.median(np.diff(scans["time_us"]))) / 1e6 if len(scans) > 1 else SWEEP_PERIOD_S
    if not _STEP_S.holds(step_s):
        raise schema.DataError(f"{where}: scans are {step_s:g} s apart, which must be {_STEP_S}. The timestamps of "
                               f"sample_data.json must be microseconds.")
    if not key_frames:
        scans = scans[_spaced(scans["time_us"] / 1e6)]
    lidar, camera = (_only(rows, tables, where) for rows in (scans, pictures))
    if camera.intrinsics is None:
        raise schema.DataError(f"{where}: {camera.channel} has no camera_intrinsic in calibrated_sensor.json. Unpack "
                               f"the metadata again.")
    try:
        described = schema.Camera.of(int(pictures["width_px"][0]), int(pictures["height_px"][0]), camera.intrinsics,
                                     camera.to_ego)
    except ValueError as error:
        raise schema.DataError(f"{where}: calibrated_sensor.json and sample_data.json make no camera: {error}"
                               ) from error
    nearest, is_near = _nearest(scans["time_us"], pictures["time_us"],
                                _KEY_PICTURE_WITHIN_S if key_frames else _PICTURE_WITHIN_S)
    pictures = pictures[nearest]
    at_scan = tables.poses[scans["pose"]]
    pose = np.stack([at_scan[:, 0, 3], at_scan[:, 1, 3], np.arctan2(at_scan[:, 1, 0], at_scan[:, 0, 0])], axis=1)
    motion = Motion(*ego_motion.of_poses(pose, (scans["time_us"] - scans["time_us"][0]) / 1e6))
    for field, values in (("speed_mps", motion.speed_mps), ("yaw_rate_radps", motion.yaw_rate_radps)):
        fields.conform(field, values, f"{where}, from ego_pose.json", values.shape)
    at_picture = tables.poses[pictures["pose"]]
    meanwhile = np.linalg.inv(at_scan) @ at_picture
    meanwhile[(at_scan == at_picture).all(axis=(1, 2))] = np.eye(4)  # exactly
    return Scene(name, split, scans["time_us"].copy(), {
        "points_m": scans["name"].copy(), "image": np.where(is_near, pictures["name"], b"")}, {}, pose, motion,
        lidar.to_ego, described, meanwhile @ camera.to_ego)


def _only(rows: np.ndarray, tables: tables_lib.Tables, where: str) -> tables_lib.Calibration:
    """The calibration of a sensor's rows."""
    places = np.unique(rows["calibration"])
    first = tables.calibrations[places[0]]
    if len(places) > 1:
        raise schema.DataError(f"{where}: {first.channel} has {len(places)} calibrations in one scene, expected one. "
                               f"Unpack the metadata again.")
    return first


def _spaced(times_s: np.ndarray) -> np.ndarray:
    """Indices of scans SWEEP_PERIOD_S apart, as near as the lidar's turns allow."""
    kept = [0]
    for index, time_s in enumerate(times_s):
        if time_s - times_s[kept[-1]] > SWEEP_PERIOD_S - _SPARED_S:
            kept.append(index)
    return np.array(kept)


def _nearest(times_us: np.ndarray, others_us: np.ndarray, within_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Of each time the index of the nearest other one (both sorted), and whether it is near."""
    after = np.clip(np.searchsorted(others_us, times_us), 1, max(len(others_us) - 1, 1))
    candidates = np.minimum(np.stack([after - 1, after]), len(others_us) - 1)
    away_us = np.abs(others_us[candidates] - times_us)
    best = np.argmin(away_us, axis=0)
    chosen = np.arange(len(times_us))
    return candidates[best, chosen], away_us[best, chosen] <= within_s * 1e6


def _existing(root: pathlib.Path, groups: list[np.ndarray]) -> list[np.ndarray]:
    """Of each name whether there is a file; looks into every folder once instead of at every file."""
    listed: dict[bytes, frozenset[bytes]] = {}
    found = []
    for names in groups:
        parts = [os.path.split(name) for name in names.tolist()]
        for folder, _ in parts:
            if folder not in listed:
                path = os.path.join(os.fsencode(root), folder)
                listed[folder] = frozenset(files.names_in(path))
        found.append(np.array([bool(name) and name in listed[folder] for folder, name in parts], bool))
    return found
