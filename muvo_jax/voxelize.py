"""python -m muvo_jax.voxelize PATH: occupancy from depth and lidar, empty told from unknown."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
import time
from typing import Annotated, Literal

import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax.data import voxelizing, words
    from muvo_jax.training import screen

_EXAMPLES = """
python -m muvo_jax.voxelize recordings/my_car
python -m muvo_jax.voxelize muvo_data/trainval --rule=reference --workers=8
python -m muvo_jax.voxelize recordings/my_car --overwrite
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """Make the occupancy of a recording (plain format or MUVO layout) from its depth maps and lidar scans; a command
    that was interrupted goes on. docs/data.md says where the files go.
    """

    path: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """The recording; in the MUVO layout any folder down to a run."""
    rule: Literal["carved", "reference"] = "carved"
    """carved tells empty (a ray passed) from unknown; reference is the authors' generate_voxels, where all that is not
    hit counts as empty."""
    overwrite: bool = False
    """Remove the files that are there and make all anew; otherwise they are kept."""
    workers: Annotated[int | None, command_line.shown("N", "one a processor")] = None
    """How many frames are made side by side, each by a process."""


def voxelize(options: Options, show: screen.Screen) -> None:
    """Makes what is missing and says how much that was."""
    start_s = time.perf_counter()
    with show.counter("voxelizing", "frames") as progress:
        result = voxelizing.voxelize(options.path.expanduser(), rule=options.rule, overwrite=options.overwrite,
                                     workers=options.workers, progress=progress)
    show.line(f"{words.counted(result.made, 'frame')} made, {result.kept} were there and are kept, after "
              f"{time.perf_counter() - start_s:.1f} s: {options.path}")


def main() -> int:
    return command_line.run(Options, voxelize, program="voxelize", examples=_EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
