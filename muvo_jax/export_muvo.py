"""python -m muvo_jax.export_muvo SOURCE OUT: a plain recording in the layout that the authors' code reads."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated

import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax.data import words
    from muvo_jax.data.muvo import exporter as muvo_exporter
    from muvo_jax.training import screen


@dataclasses.dataclass(frozen=True)
class Options:
    """Writes a plain recording in the MUVO / MILE CARLA layout, which the authors' code reads; docs/data.md says what
    the plain format does not know and what stands in its place. Runs that are there already are kept.
    """

    source: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Folder of a plain recording."""
    out: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder of the new one."""
    town: str = "Town01"
    """Name of the town's folder, Town and a number."""


EXAMPLES = """
python -m muvo_jax.export_muvo recordings/carla muvo_data
python -m muvo_jax.export_muvo ~/.cache/muvo_jax/town-tiny-0123456789ab town_as_muvo
python -m muvo_jax.export_muvo recordings/carla muvo_data --town=Town05
"""


def export(options: Options, show: screen.Screen) -> None:
    """Does what the command line asks for."""
    with show.counter("writing", "frames") as progress:
        count = muvo_exporter.export(options.source, options.out, town=options.town, progress=progress)
    show.line(f"wrote {words.counted(count, 'frame')} to {options.out}.")


def main() -> int:
    return command_line.run(Options, export, program="export_muvo", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
