"""Recognises what kind of recording a folder is. One more format is one more entry of KINDS."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from muvo_jax.data import files, schema
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.nuscenes import reader as nuscenes_reader
from muvo_jax.data.nuscenes import tables as nuscenes_tables
from muvo_jax.data.packed import manifest
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.plain import reader as plain_reader


class Kind(NamedTuple):
    """A recording format.

    Attributes:
      name: for messages.
      layout: how a folder of this kind is recognised, for messages.
      matches: whether a folder is one.
      open: its reader.
      cameras: names that `open` takes as its `camera`; empty where a recording has one only.
      options: of "camera", "labels", "corrupt" and "key_frames" those that `open` takes.
    """

    name: str
    layout: str
    matches: Callable[[pathlib.Path], bool]
    open: Callable[..., schema.Recording]
    cameras: tuple[str, ...] = ()
    options: tuple[str, ...] = ("labels",)


KINDS = (
    Kind("packed", f"a folder of shards with {manifest.MANIFEST_FILE}",
         lambda path: (path / manifest.MANIFEST_FILE).is_file(), packed_reader.PackedRecording,
         options=("labels", "corrupt")),
    Kind("plain", f"a folder with {plain_reader.DESCRIPTION_FILE}",
         lambda path: (path / plain_reader.DESCRIPTION_FILE).is_file(), plain_reader.PlainRecording),
    Kind("KITTI raw", "<date>/<date>_drive_NNNN_sync folders, or one of them",
         lambda path: bool(kitti_reader.find_drives(path)), kitti_reader.KittiRecording, kitti_reader.CAMERAS,
         options=("camera",)),
    Kind("nuScenes", "a folder with v1.0-mini or v1.0-trainval, or one of these",
         lambda path: bool(nuscenes_tables.folders(path)), nuscenes_reader.NuScenesRecording, nuscenes_reader.CAMERAS,
         options=("camera", "key_frames")),
    Kind("MUVO CARLA", f"trainval/<mode>/<Town>/<run> folders with {muvo_runs.FRAME_FILE}, or one of them",
         lambda path: bool(muvo_runs.folders(path)), muvo_reader.MuvoRecording),
)


_ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".xz", ".bz2", ".zst", ".7z", ".rar")


def recognise(path: pathlib.Path | str, *, camera: str = "", key_frames: bool = False) -> Kind:
    """What kind of recording a folder is, without opening it.

    Raises:
      DataError: for a path that is missing, a file, empty or of no known kind (naming the kinds and what was found), or
        a camera or key frames that this kind does not have.
    """
    path = pathlib.Path(path).expanduser()
    known = "; ".join(f"{kind.name} ({kind.layout})" for kind in KINDS)
    if str(path) == "town" and not path.exists():
        raise schema.DataError("\"town\" names the built-in world, which python -m muvo_jax.train --data=town records "
                               "first; here give the folder of a recording, such as that in ~/.cache/muvo_jax.")
    if not path.exists():
        raise schema.DataError(f"data folder {path} does not exist. Expected a recording: {known}; or \"town\", the "
                               f"built-in world.")
    if path.is_file() and path.name.lower().endswith(_ARCHIVES):
        raise schema.DataError(f"{path} is an archive: unpack it and give the folder that comes out. Expected a "
                               f"recording: {known}.")
    if not path.is_dir():
        raise schema.DataError(f"{path} is a file; expected the folder of a recording: {known}.")
    if not any(path.iterdir()):
        raise schema.DataError(f"data folder {path} is empty. Expected a recording: {known}; or \"town\", the built-in "
                               f"world.")
    kind = next((kind for kind in KINDS if kind.matches(path)), None)
    if kind is None:
        raise schema.DataError(f"data folder {path} is of no known kind. Known are {known}. Found "
                               f"{files.listing(path)}.")
    if camera and camera not in kind.cameras:
        raise schema.DataError(f"{path}: a recording of kind {kind.name} has no camera {camera!r}"
                               f"{' but ' + ', '.join(kind.cameras) if kind.cameras else '; it has one only'}.")
    if key_frames and "key_frames" not in kind.options:
        raise schema.DataError(f"{path}: a recording of kind {kind.name} has no key frames; leave --key-frames out.")
    return kind


def open_recording(path: pathlib.Path | str, *, camera: str = "", key_frames: bool = False,
                   skip_corrupt_shards: bool = False, labels: Collection[str] = ()) -> schema.Recording:
    """Opens a folder with the reader of its kind (the built-in town is a plain recording in its cache folder).

    Args:
      camera: which one, where the format records several; by default the reader's choice.
      key_frames: only these, where the format has them (nuScenes).
      skip_corrupt_shards: of a packed recording; see packed_reader.PackedRecording.
      labels: which of schema.LABELS the frames should have, where the recording holds them.

    Raises:
      DataError: as `recognise`, or what the reader objects to.
    """
    path = pathlib.Path(path).expanduser()
    kind = recognise(path, camera=camera, key_frames=key_frames)
    given: dict[str, Any] = {"labels": frozenset(labels), "corrupt": "skip" if skip_corrupt_shards else "raise"}
    given |= {"key_frames": key_frames} | ({"camera": camera} if camera else {})
    return kind.open(path, **{name: value for name, value in given.items() if name in kind.options})
