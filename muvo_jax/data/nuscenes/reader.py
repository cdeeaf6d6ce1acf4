"""The reader of nuScenes: tables and files as they come out of the archives, of v1.0-mini and v1.0-trainval.

    ROOT/v1.0-mini/*.json                    tables; those of annotations, maps and logs are not read
    ROOT/samples/<SENSOR>/*                  files of key frames, 2 a second
    ROOT/sweeps/<SENSOR>/*                   the others; both are needed unless key frames alone are read

Ego frame: nuScenes' own, x forward, y left, z up, origin on the ground under the middle of the rear axle. Time stamps,
pose and speed of a frame are the scan's (scenes.py says which scans and pictures make frames); its number is the scan's
time stamp in microseconds, which the name of its file holds.

Neither pedals nor steering are in these tables: actions are derived from the poses by a bicycle model, and the contract
says so. There is no route map and no reward. Scenes are split as nuScenes splits them. The few returns of the recording
car itself are left out.
"""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
import warnings
from collections.abc import Collection

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import ego_motion, files, pictures, runs, schema, sequences, words
from muvo_jax.data.nuscenes import scans, scene_splits, scenes, tables

CAMERAS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
# HDL-32E: 32 beams 4/3 degrees apart, from -30.67 to 10.67 degrees; half a step beyond, so that each beam is the middle
# of a row.
_ELEVATIONS_RAD = (math.radians(-94 / 3), math.radians(34 / 3))
_COLUMNS = 1080  # returns a beam and turn
CONTRACT = config_lib.ActionContract(wheelbase_m=2.588, rate_hz=10.0, kinematics="bicycle", source="derived")
_OF_TABLES = frozenset({"speed_mps", "yaw_rate_radps", "pose", "action", "timestamp_s", "frame_id"})
_OF_IMAGE = frozenset({"intrinsics", "camera_to_ego"})
_SENSORS = ("image", "points_m")
_NOTE_ACTIONS = ("nuScenes: actions are derived from the poses (speed, acceleration and yaw rate of a bicycle model), "
                 "not recorded.")
_NOTE_TIME = ("nuScenes: pictures are up to 0.05 s older or newer than their scans. camera_to_ego of a frame allows "
              "for the way that the car went meanwhile; a window has that of its first frame.")


class NuScenesRecording:
    """The scenes of nuScenes as one recording, seen by one of its cameras."""

    def __init__(self, path: pathlib.Path | str, camera: str = "CAM_FRONT", *, key_frames: bool = False):
        """Reads the tables and looks which files exist; frames themselves are read by `read`.

        Args:
          path: the folder that has v1.0-mini or v1.0-trainval in it, or that folder.
          camera: one of CAMERAS.
          key_frames: only these, 2 a second; else frames are 0.1 s apart.

        Raises:
          DataError: where a table is missing or malformed, two scenes have one name, there are tables of several
            versions, or no scene of the official splits has files.
        """
        path = pathlib.Path(path).expanduser()
        if camera not in CAMERAS:
            raise schema.DataError(f"nuScenes has no camera {camera!r}; it has {', '.join(CAMERAS)}.")
        folder = _tables_folder(path)
        self._root = folder.parent
        self._folder = folder
        for entry in self._root.iterdir():
            if entry.name != entry.name.lower() and entry.name.lower() in ("samples", "sweeps"):
                raise schema.DataError(f"{entry}: expected the name {entry.name.lower()}. Rename the folder.")
        every = _scenes(folder, camera, key_frames=key_frames)
        self._scenes = {scene.name: scene for scene in self._downloaded(every, camera, key_frames=key_frames)}
        period_s = _period_s(list(self._scenes.values()))
        rate_hz = round(1.0 / period_s, 1)
        modalities, lacks = runs.shared([runs.Run(scene.name, scene.split, scene.frames, _fields_of(scene))
                                         for scene in self._scenes.values()], str(path))
        self.sequences = tuple(sequence for scene in self._scenes.values()
                               for sequence in self._cut(scene, modalities, lacks[scene.name], period_s))
        splits = {sequence.split for sequence in self.sequences}
        first = next(iter(self._scenes.values()))
        self.description = schema.RecordingDescription(
            name=f"{self._root.resolve().name} {folder.resolve().name}", kind="nuScenes", rate_hz=rate_hz,
            camera=first.camera if "image" in modalities else None,
            lidar=_lidar(first) if "points_m" in modalities else None, voxels=None,
            contract=dataclasses.replace(CONTRACT, rate_hz=rate_hz),
            modalities=modalities | (_OF_IMAGE if "image" in modalities else frozenset()),
            splits=tuple(split for split in ("train", "val") if split in splits),
            notes=(_NOTE_ACTIONS, *((_NOTE_TIME,) if modalities.issuperset(_SENSORS) else ())))

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        return self.read_fields(sequence, index, self.description.modalities)

    def read_fields(self, sequence: schema.Sequence, index: int, names: Collection[str]) -> schema.RawFrame:
        """See schema.ReadsFields."""
        scene, row = self._scenes[sequence.name], sequence.start + index
        frame: schema.RawFrame = {
            "speed_mps": np.float32(scene.motion.speed_mps[row]),
            "yaw_rate_radps": np.float32(scene.motion.yaw_rate_radps[row]),
            "pose": scene.pose[row].copy(),
            "action": self.action(sequence, index),
            "timestamp_s": np.float64(scene.times_s[row]),
            "frame_id": np.int64(scene.time_us[row]),
        }
        if "image" in names and self._has(sequence, "image"):
            path = self._path(scene, "image", row)
            frame["image"] = pictures.read(path, "RGB")
            if frame["image"].shape[:2] != (scene.camera.height_px, scene.camera.width_px):
                raise schema.DataError(f"{path}: {frame['image'].shape[1]}x{frame['image'].shape[0]} pixels, but "
                                       f"sample_data.json says {scene.camera.width_px}x{scene.camera.height_px}. Use "
                                       f"the original pictures.")
            frame["intrinsics"] = np.asarray(scene.camera.intrinsics, np.float32)
            frame["camera_to_ego"] = scene.camera_to_ego[row].astype(np.float32)
        if "points_m" in names and self._has(sequence, "points_m"):
            frame["points_m"] = scans.read_scan(self._path(scene, "points_m", row), scene.lidar_to_ego)
        return frame

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        motion, row = self._scenes[sequence.name].motion, sequence.start + index
        return ego_motion.derive_action(float(motion.speed_mps[row]), float(motion.acceleration_mps2[row]),
                                        float(motion.yaw_rate_radps[row]), self.description.contract)

    def run_files(self, name: str) -> list[pathlib.Path]:
        """See schema.ListsFiles."""
        scene = self._scenes[name]
        found = [self._folder / f"{table}.json" for table in tables.NAMES]
        for key in _SENSORS:
            found += [self._path(scene, key, row) for row in np.flatnonzero(scene.present[key]).tolist()]
        return found

    def _has(self, sequence: schema.Sequence, name: str) -> bool:
        return name in self.description.modalities and sequence.has((name,))

    def _path(self, scene: scenes.Scene, key: str, row: int) -> pathlib.Path:
        return self._root / os.fsdecode(scene.files[key][row])

    def _downloaded(self, every: list[scenes.Scene], camera: str, *, key_frames: bool) -> list[scenes.Scene]:
        """The scenes that have the files of a sensor; says how many have not.

        Raises:
          DataError: where none has, or only other cameras have pictures.
        """
        found = [scene for scene in every if _fields_of(scene) != _OF_TABLES]
        others = [name for name in CAMERAS if name != camera and any(
            next((self._root / kind / name).glob("*"), None) for kind in ("samples", "sweeps"))]
        if others and not any("image" in _fields_of(scene) for scene in found):
            raise schema.DataError(f"{self._root}: no scene has {_which(key_frames)} of {camera}; there are folders of "
                                   f"{', '.join(others)}. Unpack its files, or name a camera that is there."
                                   f"{_hint(every)}")
        if not found:
            raise schema.DataError(f"{self._root}: none of {words.counted(len(every), 'scene')} of the official splits "
                                   f"has {_which(key_frames)} of {camera} or {scenes.LIDAR}. The folder holds "
                                   f"{files.listing(self._root)}; samples and sweeps belong beside "
                                   f"{self._folder.name}.{_hint(every)}")
        if len(found) < len(every):
            warnings.warn(f"{self._root}: {len(every) - len(found)} of {words.counted(len(every), 'scene')} have no "
                          f"{_which(key_frames)} of {camera} or {scenes.LIDAR} here (their archives were not unpacked) "
                          f"and are left out.", sequences.GapWarning, stacklevel=3)
        return found

    def _cut(self, scene: scenes.Scene, modalities: frozenset[str], lacks: tuple[str, ...],
             period_s: float) -> list[schema.Sequence]:
        """The gap-free sequences of a scene; warns of gaps."""
        needed = [key for key in _SENSORS if key in modalities and key not in lacks]
        present = np.logical_and.reduce([np.ones(scene.frames, bool), *(scene.present[key] for key in needed)])
        sequences.warn_of_rate(f"{self._root}, {scene.name}", scene.times_s, period_s)
        late = sequences.after_gap(scene.times_s, period_s)
        pieces = sequences.gap_free(present, late)
        absent = {key: int((~scene.present[key]).sum()) for key in needed}
        sequences.warn_of_gaps(f"{self._root}, {scene.name}", present, absent, late, len(pieces))
        return [schema.Sequence(scene.split, scene.name, start, length, lacks) for start, length in pieces]


def _tables_folder(path: pathlib.Path) -> pathlib.Path:
    path = pathlib.Path(os.path.abspath(path))  # a link to the tables alone is not followed: files lie beside the link
    found = tables.folders(path)
    if not found:
        raise files.missing(path / "v1.0-trainval", "the tables of nuScenes")
    if len(found) > 1:
        raise schema.DataError(f"{path} has the tables of {', '.join(folder.name for folder in found)}: give the one "
                               f"that is meant, such as {found[0]}.")
    return found[0]


def _scenes(folder: pathlib.Path, camera: str, *, key_frames: bool) -> list[scenes.Scene]:
    """Those of the official splits."""
    split_of = scene_splits.of(folder.name)
    named = tables.scene_names(folder)
    known = {token: name for token, name in named.items() if name in split_of}
    _check_names(known, folder)
    if not known:
        raise schema.DataError(f"{folder}: none of its {words.counted(len(named), 'scene')} "
                               f"({', '.join(list(named.values())[:3])}) is in the official splits train and val. Give "
                               f"{' or '.join(scene_splits.OF_VERSION)}.")
    if len(known) < len(named):
        warnings.warn(f"{folder}: {len(named) - len(known)} of {len(named)} scenes are in neither of the official "
                      f"splits train and val and are left out.", schema.DataWarning, stacklevel=3)
    read = tables.read(folder, list(known), (scenes.LIDAR, camera), key_frames=key_frames)
    return scenes.build(folder.parent, read, [(name, split_of[name]) for name in known.values()], camera,
                        key_frames=key_frames)


def _check_names(named: dict[str, str], folder: pathlib.Path) -> None:
    """Raises DataError where two scenes (token -> name) have one name."""
    if twice := sequences.named_twice((name, token) for token, name in named.items()):
        name, one, other = twice
        raise schema.DataError(f"{folder / 'scene.json'}: rows {one} and {other} are both named {name}. Unpack the "
                               f"metadata again; of tables that were put together, rename one.")


def _fields_of(scene: scenes.Scene) -> frozenset[str]:
    return _OF_TABLES | {key for key in _SENSORS if runs.has_files(scene.present[key])}


def _period_s(found: list[scenes.Scene]) -> float:
    """The usual time from a frame to the next."""
    steps_s = np.concatenate([np.diff(scene.times_s) for scene in found])
    return float(np.median(steps_s)) if len(steps_s) else scenes.SWEEP_PERIOD_S


def _lidar(scene: scenes.Scene) -> config_lib.RangeViewGeometry:
    low_rad, high_rad = _ELEVATIONS_RAD
    x_m, y_m, z_m = scene.lidar_to_ego[:3, 3].tolist()
    return config_lib.RangeViewGeometry(rows=scans.BEAMS, columns=_COLUMNS, elevation_min_rad=low_rad,
                                        elevation_max_rad=high_rad, position_m=(x_m, y_m, z_m))


def _which(key_frames: bool) -> str:
    return "files of key frames" if key_frames else "files"


def _hint(every: list[scenes.Scene]) -> str:
    """What to do where only a few files of each scene are there: those of key frames."""
    if not any(present.any() for scene in every for present in scene.present.values()):
        return ""
    return " There are files of a few frames: if they are of key frames, read these alone (--key-frames)."
