"""Recordings in the MUVO / MILE CARLA layout, exactly as the authors' DataWriter and generate_voxels leave them.

    ROOT/trainval/<mode>/<Town>/<run>/pd_dataframe.pkl    one row a frame, paths relative to the run (runs.py)
    ROOT/trainval/<mode>/<Town>/<run>/occupancy/*.npz     ours, optional: muvo_jax.voxelize separates empty and unknown
    ROOT/sensors.toml                                     ours, optional: rate_hz, tags, yaw_rate, and the sections
                                                          [camera], [lidar], [voxels], [action], [route_map]

The path may also be the version's folder (trainval), a mode's (train), a town's or a run's. Modes are the splits; where
there is no mode above the towns, all is "train". The layout does not say how the sensors are mounted: without
sensors.toml they are the authors' (data_preprocess.yaml: camera with a field of view of 110 degrees and lidar at
(1, 0, 2) m, voxels of 0.5 m). It is looked for in the root, whichever folder of the layout the path is.

As in the authors' dataset class, runs with a mean reward below 0.6 and the first second of each run are left out. Runs
without pd_dataframe.pkl, which they skip in silence, are counted in a warning here. Pickles are read without executing
anything (safe_pickle.py).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import pathlib
import warnings
from collections.abc import Collection

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import description, ego_motion, fields, files, pictures, runs, schema, sequences
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import tags as muvo_tags

SENSORS_FILE = "sensors.toml"
OCCUPANCY_FOLDER = "occupancy"
RATE_HZ = 10.0
MIN_MEAN_REWARD = 0.6
SKIPPED_S = 1.0
MOUNT_M = (1.0, 0.0, 2.0)
FOV_RAD = math.radians(110.0)
LIDAR = config_lib.RangeViewGeometry(position_m=MOUNT_M)
VOXELS = config_lib.VoxelGrid()
# A pedal is not an acceleration: nothing can be computed from it without the car's engine.
ROUTE_MAP = config_lib.RouteMap(metres_per_px=0.6, ego_row=160 / 3, ego_column=32.0)  # every third pixel of theirs
CONTRACT = config_lib.ActionContract(kinematics="none", source="recorded", rate_hz=RATE_HZ)
_ROUTE_PX = 64
# RawFrame key -> kind of file.
_FILES = {"image": "image", "points_m": "points_semantic", "occupancy": "voxel", "route_map": "routemap"}
_LABEL_FILES = {"depth_m": "depth_semantic", "image_classes": "depth_semantic",
                "image_instance_mask": "depth_semantic", "point_classes": "points_semantic",
                "birds_eye_classes": "birdview", "birds_eye_instances": "birdview"}


class MuvoRecording:
    """A folder in the MUVO / MILE CARLA layout."""

    def __init__(self, path: pathlib.Path | str, *, min_mean_reward: float = MIN_MEAN_REWARD,
                 skipped_s: float = SKIPPED_S, labels: frozenset[str] = frozenset()):
        """Reads every data frame and looks which files exist; frames are read by `read`.

        Args:
          min_mean_reward: runs below are left out.
          skipped_s: left out at the start of each run.
          labels: which of schema.LABELS the frames should have, where they are recorded.

        Raises:
          Refused: for a data frame that asks for more than data.
          DataError: where there is no run, two have one name, none is good enough, or a data frame lacks what is
            needed.
        """
        path = pathlib.Path(path).expanduser()
        header, sensors_path = read_sensors(path)
        rate_hz = description.rate_hz(header, sensors_path) if "rate_hz" in header else RATE_HZ
        every = muvo_runs.find_runs(path)
        if not header.get("yaw_rate", True):
            every = [_without_imu(run) for run in every]
        _check_names(every, path)
        kept = [run for run in every if run.frames and not run.mean_reward < min_mean_reward]
        if not kept:
            raise schema.DataError(f"{path}: none of its {len(every)} runs has frames and a mean reward of "
                                   f"{min_mean_reward} or more. Record better ones.")
        kinds = _FILES | {key: kind for key, kind in _LABEL_FILES.items() if key in labels}
        self._is_carved = _is_carved(kept)
        if self._is_carved:
            kinds["occupancy"] = OCCUPANCY_FOLDER
            kept = [_with_occupancy(run) for run in kept]
        self._kinds = kinds
        self._files = {run.name: {kind: muvo_runs.find_files(run, kind) for kind in set(kinds.values())}
                       for run in kept}
        modalities, lacks = runs.shared([runs.Run(run.name, run.split, run.frames, self._fields_of(run))
                                         for run in kept], str(path))
        self._runs = {run.name: run for run in kept}
        self._columns = {run.name: _columns(run, rate_hz, "rate_hz" in header) for run in kept}
        _warn_of_steps(kept)
        for run in kept:
            muvo_runs.check_numbers(run, [kind for key, kind in kinds.items() if key in modalities])
        self.sequences = tuple(sequence for run in kept
                               for sequence in self._cut(run, modalities, lacks[run.name], skipped_s, rate_hz))
        present = {sequence.split for sequence in self.sequences}
        notes = _notes(every, kept, min_mean_reward, is_binary="occupancy" in modalities and not self._is_carved)
        section = lambda name: description.section(header, name, sensors_path, required=False)
        self.description = schema.RecordingDescription(
            name=path.resolve().name, kind="MUVO CARLA", rate_hz=rate_hz,
            modalities=modalities | ({"intrinsics", "camera_to_ego"} if "image" in modalities else set()),
            splits=tuple(sorted(present, key=lambda split: (split != "train", split))), notes=notes,
            camera=(section("camera") or self._assumed_camera()) if "image" in modalities else None,
            lidar=(section("lidar") or LIDAR) if "points_m" in modalities else None,
            voxels=(section("voxels") or VOXELS) if "occupancy" in modalities else None,
            classes=muvo_files.CLASSES if labels & {"image_classes", "point_classes"} else (),
            route_map=(section("route_map") or ROUTE_MAP) if "route_map" in modalities else None,
            contract=description.contract(header, sensors_path, rate_hz)
            or dataclasses.replace(CONTRACT, rate_hz=rate_hz))
        if (voxels := self.description.voxels) is not None:
            for run in kept:
                description.check_rule(run.folder / kinds["occupancy"], voxels)
        self._tags = muvo_tags.described(header, sensors_path) or self._recognised_tags(kept, path)

    def run(self, name: str) -> muvo_runs.Run:
        """The run of a sequence, for what RawFrame does not hold."""
        return self._runs[name]

    def read(self, sequence: schema.Sequence, index: int) -> schema.RawFrame:
        """See schema.Recording."""
        return self.read_fields(sequence, index, self.description.modalities)

    def read_fields(self, sequence: schema.Sequence, index: int, names: Collection[str]) -> schema.RawFrame:
        """See schema.ReadsFields."""
        run, row = self._runs[sequence.name], sequence.start + index
        described, columns = self.description, self._columns[sequence.name]
        wanted = {name for name in described.modalities if name in names and sequence.has((name,))}
        frame: schema.RawFrame = {name: values[row] for name, values in columns.items()  # type: ignore[assignment]
                                  if name in wanted}
        paths = {key: self._files[run.name][kind].path(row) for key, kind in self._kinds.items() if key in wanted}
        if described.camera is not None and "image" in paths:
            camera = described.camera
            frame["image"] = pictures.read(paths["image"], "RGB")
            if frame["image"].shape[:2] != (camera.height_px, camera.width_px):
                raise schema.DataError(f"{paths['image']}: {frame['image'].shape[1]}x{frame['image'].shape[0]} pixels, "
                                       f"the recording's first image has {camera.width_px}x{camera.height_px}. Do not "
                                       f"mix recordings of different settings in one folder.")
            frame["intrinsics"] = np.asarray(camera.intrinsics, np.float32)
            frame["camera_to_ego"] = np.asarray(camera.camera_to_ego, np.float32)
        if described.lidar is not None and "points_m" in paths:
            scan = muvo_files.read_points(paths["points_m"], described.lidar.position_m)
            frame["points_m"] = fields.conform("points_m", scan.points_m, str(paths["points_m"]))
            if "point_classes" in paths:
                frame["point_classes"] = self._translate(muvo_files.point_tags(scan, paths["points_m"]),
                                                         paths["points_m"])
        if described.voxels is not None and "occupancy" in paths:
            frame["occupancy"] = (_read_occupancy(paths["occupancy"], described.voxels) if self._is_carved else
                                  muvo_files.read_voxels(paths["occupancy"], described.voxels, self._translate))
        if "route_map" in paths:
            frame["route_map"] = _nearest(muvo_files.read_route_map(paths["route_map"]), _ROUTE_PX)
        image_size = (described.camera.height_px, described.camera.width_px) if described.camera is not None else None
        return frame | muvo_files.read_labels(paths, described.voxels or VOXELS, self._translate, image_size)

    def action(self, sequence: schema.Sequence, index: int) -> np.ndarray:
        """See schema.Recording."""
        return self._columns[sequence.name]["action"][sequence.start + index]

    def _fields_of(self, run: muvo_runs.Run) -> frozenset[str]:
        found = {"speed_mps", "action", "reward", "is_terminal", "timestamp_s", "frame_id"}
        if "imu" in run.columns:
            found |= {"yaw_rate_radps", "pose"}
        return frozenset(found | {key for key, kind in self._kinds.items()
                                  if runs.has_files(self._files[run.name][kind].present)})

    def _cut(self, run: muvo_runs.Run, modalities: frozenset[str], lacks: tuple[str, ...], skipped_s: float,
             rate_hz: float) -> list[schema.Sequence]:
        """The gap-free sequences of a run after its first second; warns of gaps."""
        present, absent = np.ones(run.frames, bool), {}
        for kind in sorted({self._kinds[key] for key in modalities.difference(lacks) if key in self._kinds}):
            there = self._files[run.name][kind].present
            present &= there
            absent[kind] = int((~there).sum())
        times_s = self._columns[run.name]["timestamp_s"]
        late = sequences.after_gap(times_s, 1.0 / rate_hz)
        pieces = sequences.gap_free(present, late)
        sequences.warn_of_gaps(str(run.folder), present, absent, late, len(pieces))
        first = int(np.searchsorted(times_s, times_s[0] + skipped_s - 0.5 / rate_hz))
        cut = [(max(start, first), start + length) for start, length in pieces]
        return [schema.Sequence(run.split, run.name, start, stop - start, lacks) for start, stop in cut if stop > start]

    def _assumed_camera(self) -> schema.Camera:
        """The authors', with the size of the first image that can be read, if possible one of the sequences."""
        inside = ((sequence.name, sequence.start + index) for sequence in self.sequences if sequence.has(("image",))
                  for index in range(sequence.length))
        every = ((name, row) for name, found in self._files.items()
                 for row in np.flatnonzero(found["image"].present).tolist())
        faults = []
        for name, row in itertools.chain(inside, every):
            try:
                height_px, width_px = pictures.read(self._files[name]["image"].path(row), "RGB").shape[:2]
            except schema.DataError as error:
                faults.append(error)
            else:
                return schema.Camera.level(width_px, height_px, FOV_RAD, MOUNT_M)
        raise faults[0]

    def _translate(self, tags: np.ndarray, path: pathlib.Path) -> np.ndarray:
        return muvo_tags.to_layout(tags, self._tags, path)

    def _recognised_tags(self, kept: list[muvo_runs.Run], path: pathlib.Path) -> muvo_tags.TagSet | None:
        """The tag set by what some files hold; None where nothing read needs one, or occupancy alone does.

        One run of each mode and town is looked at.

        Raises:
          DataError: where classes are wanted and the tags do not tell, or no file that has them can be read, or those
            of two runs are of two sets.
        """
        wanted = self.description.modalities & {"image_classes", "image_instance_mask", "point_classes"}
        if not wanted and (self._is_carved or "occupancy" not in self.description.modalities):
            return None
        every: list[np.ndarray] = []
        ground: list[np.ndarray] = []
        faults: list[schema.DataError] = []
        told: dict[muvo_tags.TagSet, str] = {}  # by which run first
        for run in {run.name.rpartition("/")[0]: run for run in kept}.values():
            of_run = muvo_tags.of_run(run, self._files[run.name])
            every, ground, faults = every + of_run.every, ground + of_run.ground, faults + of_run.faults
            if (found := muvo_tags.recognise(of_run.every, of_run.ground, str(run.folder))) is not None:
                told.setdefault(found, run.name)
        if len(told) > 1:
            raise schema.DataError(f"{path}: run {told[muvo_tags.OLDER]} has the semantic tags of CARLA up to 0.9.13, "
                                   f"{told[muvo_tags.NEWER]} those of 0.9.14 and later, which number classes "
                                   f"otherwise. Make two recordings of them, each with its tags in {SENSORS_FILE}.")
        tag_set = next(iter(told), None) or muvo_tags.recognise(every, ground, str(path))
        if tag_set is None and wanted:
            if faults and not every:
                raise faults[0]
            raise muvo_tags.undecided(str(path))
        return tag_set


def read_sensors(path: pathlib.Path) -> tuple[dict, pathlib.Path]:
    """sensors.toml in this folder of the layout or the nearest one above it, up to the recording's root, and where.

    Empty where there is none.

    Raises:
      DataError: where it is malformed or has entries that are unknown.
    """
    above = [path.resolve(), *path.resolve().parents][:muvo_runs.root_levels(path) + 1]
    found = next((folder / SENSORS_FILE for folder in above if (folder / SENSORS_FILE).is_file()), None)
    header = files.read_toml(found) if found is not None else {}
    found = found or path / SENSORS_FILE
    description.check_names(header, found, ("rate_hz", "tags", "yaw_rate"))
    if not isinstance(header.get("yaw_rate", True), bool):
        raise schema.DataError(f"{found}: yaw_rate is {header['yaw_rate']!r}, expected false where the gyroscopes of "
                               f"the runs measured nothing, else true.")
    return header, found


def _check_names(every: list[muvo_runs.Run], path: pathlib.Path) -> None:
    """Raises DataError where two runs have one name, such as those of two recordings in one folder, or are one."""
    if twice := sequences.named_twice((run.name, run.folder) for run in every):
        name, one, other = twice
        raise schema.DataError(f"{path}: {one} and {other} are both run {name}. Read the recordings one by one, or "
                               f"rename one of the folders.")
    # A mode linked to another one would be judged on what was trained.
    if linked := sequences.named_twice((run.folder.resolve(), run.name) for run in every):
        folder, one_name, other_name = linked
        raise schema.DataError(f"{path}: {one_name} and {other_name} are one folder, {folder}. Remove one of the "
                               f"links.")


def _is_carved(kept: list[muvo_runs.Run]) -> bool:
    """Whether the runs with most of the frames have occupancy of ours."""
    carved = sum(run.frames for run in kept if any((run.folder / OCCUPANCY_FOLDER).glob("*.npz")))
    return 2 * carved >= sum(run.frames for run in kept)


def _columns(run: muvo_runs.Run, rate_hz: float, is_stated: bool) -> dict[str, np.ndarray]:
    """What RawFrame has of the table, by its names: [F, ...].

    Raises:
      DataError: for numbers that a field cannot have, or frames that are numbered in other steps than 1 while no rate
        is stated.
    """
    where = str(run.folder / muvo_runs.FRAME_FILE)
    numbers, step = muvo_runs.numbering(run), _step(run)
    if step != 1 and not is_stated:
        raise schema.DataError(f"{where}: frames are numbered in steps of {step}. If {step - 1} of {step} were taken "
                               f"out, say rate_hz = {RATE_HZ / step:g} in {SENSORS_FILE}.")
    columns = {"action": muvo_runs.actions(run), "speed_mps": run.numbers("speed", 1)[:, 0],
               "reward": np.clip(run.numbers("reward", 1)[:, 0], -1.0, 1.0),
               "is_terminal": np.zeros(run.frames, bool), "frame_id": numbers,
               "timestamp_s": (numbers - numbers[0]) / (step * rate_hz)}
    if "imu" in run.columns:
        columns["yaw_rate_radps"] = muvo_runs.yaw_rates(run)
        columns["pose"] = ego_motion.dead_reckoned(columns["speed_mps"], columns["yaw_rate_radps"], rate_hz)
    for name in ("action", "speed_mps", "yaw_rate_radps"):
        if name in columns:
            fields.conform(name, columns[name], where, columns[name].shape)
    return columns


def _step(run: muvo_runs.Run) -> int:
    """By how much the numbers of a run's frames mostly increase."""
    steps, counts = np.unique(np.diff(muvo_runs.numbering(run)), return_counts=True)
    return int(steps[np.argmax(counts)]) if steps.size else 1


def _warn_of_steps(kept: list[muvo_runs.Run]) -> None:
    """Warns where frames of some runs are numbered in other steps: one rate cannot hold for both."""
    named: dict[int, str] = {}
    for run in kept:
        if run.frames > 2:
            named.setdefault(_step(run), run.name)
    if len(named) > 1:
        told = " and ".join(f"in steps of {step} in {name}" for step, name in sorted(named.items()))
        warnings.warn(f"frames are numbered {told}, yet one rate holds for all: speeds and actions would count for "
                      f"another time. Keep runs of another rate in a recording of their own.", schema.DataWarning,
                      stacklevel=3)


def occupancy_names(run: muvo_runs.Run) -> muvo_runs.NumberedNames:
    """Paths of the frames' occupancy, relative to the run; by their numbers, since rows may be taken out later."""
    return muvo_runs.NumberedNames(f"{OCCUPANCY_FOLDER}/{OCCUPANCY_FOLDER}_", muvo_runs.numbering(run), 9, ".npz")


def _without_imu(run: muvo_runs.Run) -> muvo_runs.Run:
    return dataclasses.replace(run, columns={name: cells for name, cells in run.columns.items() if name != "imu"})


def _with_occupancy(run: muvo_runs.Run) -> muvo_runs.Run:
    names = occupancy_names(run)
    return dataclasses.replace(run, columns=run.columns | {f"{OCCUPANCY_FOLDER}_path": names})


def _read_occupancy(path: pathlib.Path, grid: config_lib.VoxelGrid) -> np.ndarray:
    occupancy = files.read_npz(path, "occupancy")
    if occupancy.shape != grid.shape:
        raise schema.DataError(f"{path}: a grid of {list(occupancy.shape)}, expected {list(grid.shape)}. Describe the "
                               f"grid in {SENSORS_FILE}, or make the occupancy again.")
    return fields.conform("occupancy", occupancy, str(path))


def _nearest(picture: np.ndarray, side: int) -> np.ndarray:
    """The pixel in the upper left corner of each of side x side cells, as the reference resizes its route map."""
    rows, columns = (np.arange(side) * size // side for size in picture.shape)
    return np.ascontiguousarray(picture[rows[:, None], columns])


def _notes(every: list[muvo_runs.Run], kept: list[muvo_runs.Run], min_mean_reward: float, *,
           is_binary: bool) -> tuple[str, ...]:
    notes = ["MUVO layout: an action is (throttle where pressed, else -brake; steering); pedals, not accelerations."]
    if len(kept) < len(every):
        notes.append(f"MUVO layout: {len(every) - len(kept)} of {len(every)} runs are left out, their mean reward is "
                     f"below {min_mean_reward}.")
    if is_binary:
        notes.append("MUVO layout: stored voxels say what is occupied; every other voxel counts as empty, seen or not.")
    return tuple(notes)
