"""python -m muvo_jax.pack SRC OUT: a recording as ArrayRecord shards."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
import time
from typing import Annotated

import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax.data import records, shards
    from muvo_jax.training import screen

_EXAMPLES = """
python -m muvo_jax.pack ~/recordings/town ~/packed/town
python -m muvo_jax.pack SRC OUT --jpeg-quality=95
python -m muvo_jax.pack SRC OUT --machines=4 --machine=0
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """Pack a recording of any known kind into shards that stream fast; a command that was interrupted goes on.

    Attributes:
      source: the recording.
      out: the folder for the shards; read it as any other recording.
      jpeg_quality: of images, 1 to 95; without it nothing is lost.
      half_points: points in float16.
      frames_per_shard: frames in one file.
      machine: number of this machine, if several pack into one folder.
      machines: how many do.
      workers: processes.
    """

    source: tyro.conf.Positional[pathlib.Path]
    out: tyro.conf.Positional[pathlib.Path]
    jpeg_quality: Annotated[int | None, command_line.shown("INT", "PNG")] = None
    half_points: bool = False
    frames_per_shard: int = shards.FRAMES_PER_SHARD
    machine: int = 0
    machines: int = 1
    workers: Annotated[int | None, command_line.shown("INT", "one a processor")] = None


def pack(options: Options, show: screen.Screen) -> None:
    """Packs and says what there is."""
    start_s = time.perf_counter()
    with show.counter("packing", "frames") as progress:
        complete = shards.pack(
            options.source.expanduser(), options.out, frames_per_shard=options.frames_per_shard,
            encoding=records.Encoding(options.jpeg_quality, options.half_points), machine=options.machine,
            machines=options.machines, workers=options.workers, progress=progress)
    seconds = time.perf_counter() - start_s
    if not complete:
        print(f"this machine's shards are complete after {seconds:.1f} s; {records.MANIFEST_FILE} is written once the "
              f"other machines' are (run any of the commands again).")
        return
    manifest = records.read_manifest(options.out)
    size_mb = sum(shard["bytes"] for shard in manifest["shards"]) / 1e6
    print(f"{manifest['frames']} frames in {len(manifest['shards'])} shards, {size_mb:.1f} MB, after {seconds:.1f} s: "
          f"{options.out}")


def main() -> int:
    return command_line.run(Options, pack, program="pack", examples=_EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
