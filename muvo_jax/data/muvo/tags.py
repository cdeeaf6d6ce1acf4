"""Which simulator's semantic tags a recording in the MUVO layout has, and what they are in the layout's own.

CARLA 0.9.14 numbered its tags anew: what was a road (7) is a traffic light. The layout's tags are those of 0.9.13. A
recording says which it has (`tags` in sensors.toml); else they tell: some exist only in the newer set, and what lies
under the car is a road. Where neither helps, nothing is guessed.
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np

from muvo_jax.data import schema
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import safe_pickle

TagSet = Literal["0.9.13", "0.9.14"]
OLDER, NEWER = get_args(TagSet)
# The most common tag of the ground: road line, road, sidewalk, ground, terrain; and the same in the newer numbers.
_GROUND = {OLDER: (6, 7, 8, 14, 22), NEWER: (1, 2, 24, 25)}
_OLDER_TAGS, _NEWER_TAGS = len(muvo_files.CLASSES), 29
_GROUND_SHARE, _GROUND_BAND_M = 0.5, 0.5
# Where the two sets differ in what counts as occupied: the sky of either.
_SKIES = (11, 13)
_TRIES = 8


def described(header: dict, path: pathlib.Path) -> TagSet | None:
    """The tag set that a description names; None where it does not.

    Raises:
      DataError: for one that is unknown.
    """
    named = header.get("tags")
    if named is not None and named not in (OLDER, NEWER):
        raise schema.DataError(f"{path}: tags is {named!r}, expected \"{OLDER}\" (CARLA up to 0.9.13) or \"{NEWER}\" "
                               f"(0.9.14 and later).")
    return named


class RunTags(NamedTuple):
    """Tags of some files of a run, all of them and those of the ground; and what was wrong with files passed by."""

    every: list[np.ndarray]
    ground: list[np.ndarray]
    faults: list[schema.DataError]


def of_run(run: muvo_runs.Run, known: Mapping[str, muvo_runs.KindFiles]) -> RunTags:
    """The tags that scans, voxels and pictures of a run hold, as far as they are there.

    Of each kind two files are looked at, a quarter and half of the way through the run; where one is damaged, which may
    be of a kind that nobody reads, the next. `known` has the files of the kinds that are read.
    """
    found = RunTags([], [], [])
    for kind, read in (("points_semantic", _of_scan), ("voxel", _of_voxels), ("depth_semantic", _of_picture)):
        try:
            there = known[kind] if kind in known else muvo_runs.find_files(run, kind)
        except schema.DataError as error:
            found.faults.append(error)
            continue
        rows = np.flatnonzero(there.present)
        for first in sorted({run.frames // 4, run.frames // 2}):
            for row in rows[rows >= first][:_TRIES].tolist():
                try:
                    read(there.path(row), found)
                    break
                except schema.DataError as error:
                    found.faults.append(error)
    return found


def _of_scan(path: pathlib.Path, found: RunTags) -> None:
    scan = muvo_files.read_points(path, (0.0, 0.0, 0.0))
    if scan.tags is not None and len(scan.tags):
        found.every.append(scan.tags)
        height_m = scan.points_m[:, 2]
        found.ground.append(scan.tags[height_m < np.percentile(height_m, 5) + _GROUND_BAND_M])


def _of_voxels(path: pathlib.Path, found: RunTags) -> None:
    rows = safe_pickle.load_npy(path)
    if isinstance(rows, np.ndarray) and rows.ndim == 2 and rows.shape[1] == 4 and len(rows):
        found.every.append(rows[:, 3])


def _of_picture(path: pathlib.Path, found: RunTags) -> None:
    _, tags = muvo_files.read_depth_semantic(path)
    found.every.append(tags)
    found.ground.append(tags[-max(len(tags) // 8, 1):])


def recognise(every: Iterable[np.ndarray], ground: Iterable[np.ndarray], where: str) -> TagSet | None:
    """The set that tags are of; None where they do not tell.

    Args:
      every: tags, unsigned, of some files.
      ground: those of them that lie under and before the car.
      where: for messages.

    Raises:
      DataError: for tags that neither set has.
    """
    counts, below = (sum((np.bincount(np.minimum(tags, 255).astype(np.uint8).ravel(), minlength=256) for tags in parts),
                         np.zeros(256, np.int64)) for parts in (every, ground))
    known = np.flatnonzero(counts[:muvo_files.UNKNOWN_TAG])
    if known.size and known[-1] >= _NEWER_TAGS:
        raise schema.DataError(f"{where}: tag {known[-1]} is none of CARLA's up to 0.9.16; they end with "
                               f"{_NEWER_TAGS - 1}.")
    if known.size and known[-1] >= _OLDER_TAGS:
        return NEWER
    shares = {name: below[list(tags)].sum() / max(below.sum(), 1) for name, tags in _GROUND.items()}
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] > _GROUND_SHARE else None


def undecided(where: str) -> schema.DataError:
    """The error for tags that are needed and do not tell what they mean."""
    return schema.DataError(f"{where}: its semantic tags may be those of CARLA up to 0.9.13 or of 0.9.14 and later, "
                            f"which number them differently. Say tags = \"{OLDER}\" or tags = \"{NEWER}\" in "
                            f"sensors.toml.")


def to_layout(tags: np.ndarray, tag_set: TagSet | None, path: pathlib.Path) -> np.ndarray:
    """Tags of a file as the layout's, uint8; 255 for those that it does not know.

    Args:
      tag_set: None where it is not known; the tags are then taken as they are where both sets leave the same out.

    Raises:
      DataError: where that would be a guess.
    """
    if tag_set == NEWER:
        return np.where(tags < _NEWER_TAGS, muvo_files.LAYOUT_TAGS[np.minimum(tags, 255)], muvo_files.UNKNOWN_TAG
                        ).astype(np.uint8)
    if tag_set is None and np.isin(tags, _SKIES).any():
        raise undecided(str(path))
    return muvo_files.known_classes(tags)
