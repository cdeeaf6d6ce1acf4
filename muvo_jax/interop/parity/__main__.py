"""python -m muvo_jax.interop.parity DIR: every number of the reference in DIR against ours."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated

import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax.interop.parity import registry, runner
    from muvo_jax.training import screen


@dataclasses.dataclass(frozen=True)
class Options:
    """Compares this library with numbers that the authors' PyTorch code gave, on the same weights and inputs.

    DIR holds golden files (npz) and pack.json with their seed and sizes; nothing in it is executed. Prints a line for
    each entry, then how many were checked and left out, and ends with 0 only where all passed.
    """

    folder: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The golden files."""
    only: Annotated[str, command_line.shown("P1,P2", "all")] = ""
    """Which golden files, by the beginnings of their names: p1, p2, p3 (or p3_1d, p3_2d), p4, p5, p6."""
    recordings: Annotated[pathlib.Path | None, command_line.shown("PATH", "none")] = None
    """Recordings, for the golden files that need some (p6)."""


_EXAMPLES = """
python -m muvo_jax.interop.parity tests/golden
python -m muvo_jax.interop.parity PACKS --only=p1,p3
"""


def compare(options: Options, show: screen.Screen) -> runner.Report:
    """Does what the command line asks for."""
    only = [name for name in options.only.lower().split(",") if name]
    report = runner.run_folder(options.folder, registry.FILES, only=only, recordings=options.recordings,
                               write=show.line)
    for line in report.lines():
        show.line(line)
    return report


def main() -> int:
    return command_line.run(Options, compare, program="interop.parity", examples=_EXAMPLES,
                            status=lambda report: int(not report.ok))


if __name__ == "__main__":
    sys.exit(main())
