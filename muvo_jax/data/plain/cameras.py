"""The camera of each frame of a plain recording, where frames.csv says it: one that was turned, moved or exchanged."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping

import numpy as np

from muvo_jax.data import fields, schema
from muvo_jax.data.plain import frames_table

FIELDS = tuple(fields.FIELDS[name] for name in ("intrinsics", "camera_to_ego"))


def of_frame(columns: Mapping[str, np.ndarray], position: int, described: schema.Camera) -> schema.RawFrame:
    """intrinsics and camera_to_ego of a frame: those of its row where there are such columns, else the described ones.

    Args:
      columns: of frames.csv.
      position: the frame's row.
      described: by recording.toml.
    """
    return {field.name: field.of_cells([columns[column][position] for column in field.columns])  # type: ignore
            if field.columns[0] in columns else np.asarray(getattr(described, field.name), field.dtype)
            for field in FIELDS}


def check(columns: Mapping[str, np.ndarray], described: schema.Camera, path: pathlib.Path) -> None:
    """Looks at the cameras of all frames.

    Raises:
      DataError: where a column of a matrix lacks, or a row makes no camera; names the line.
    """
    present = [column for field in FIELDS for column in field.columns if column in columns]
    lacking = [column for field in FIELDS for column in field.columns
               if column not in columns and not set(field.columns).isdisjoint(present)]
    if lacking:
        raise schema.DataError(f"{path}: column {', '.join(lacking)} is missing; it belongs to {present[0]}. Write the "
                               f"whole matrix, row by row but for its last row, or leave it out.")
    if not present:
        return
    _, firsts = np.unique(np.stack([columns[column] for column in present], axis=1), axis=0, return_index=True)
    for row in sorted(firsts.tolist()):
        try:
            frame = of_frame(columns, row, described)
            schema.Camera.of(described.width_px, described.height_px, frame["intrinsics"], frame["camera_to_ego"])
        except ValueError as error:
            raise schema.DataError(f"{path}, line {frames_table.line_of(path, row)}: {error}") from error
