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
    from muvo_jax.data import words
    from muvo_jax.data.packed import manifest, records
    from muvo_jax.data.packed import writer as packed_writer
    from muvo_jax.training import screen

_EXAMPLES = """
python -m muvo_jax.pack ~/recordings/town ~/packed/town
python -m muvo_jax.pack SRC OUT --jpeg-quality=95
python -m muvo_jax.pack SRC OUT --machines=4 --machine=0
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """Pack a recording of any known kind, labels too, into shards that stream fast; a command that was interrupted goes
    on, and one whose source was corrected since packs anew what that touches.
    """

    source: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The recording."""
    out: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder for the shards; read it as any other recording."""
    camera: Annotated[str, command_line.shown("NAME", "the reader's choice")] = ""
    """Which camera, where the recording has several (KITTI: image_00 to image_03; nuScenes: CAM_FRONT, ...)."""
    key_frames: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only key frames, where the recording has them (nuScenes: 2 a second instead of 10)."""
    labels: bool = True
    """Pack depth, classes and other labels too, as far as they are recorded."""
    jpeg_quality: Annotated[int | None, command_line.shown("N", "PNG")] = None
    """Of images, 1 to 95; without it nothing is lost."""
    half_points: bool = False
    """Points in float16."""
    frames_per_shard: int = manifest.FRAMES_PER_SHARD
    """Frames in one file."""
    machine: int = 0
    """Number of this machine, if several pack into one folder."""
    machines: int = 1
    """How many do."""
    workers: Annotated[int | None, command_line.shown("N", "one a processor")] = None
    """How many shards are packed side by side, each by a process."""


def pack(options: Options, show: screen.Screen) -> None:
    """Packs and says what there is."""
    start_s = time.perf_counter()
    with show.counter("packing", "frames") as progress:
        complete = packed_writer.pack(
            options.source, options.out, frames_per_shard=options.frames_per_shard, camera=options.camera,
            key_frames=options.key_frames, labels=options.labels,
            encoding=records.Encoding(options.jpeg_quality, options.half_points),
            machine=options.machine, machines=options.machines, workers=options.workers, progress=progress)
    seconds = time.perf_counter() - start_s
    if not complete:
        show.line(f"this machine's shards are complete after {seconds:.1f} s; {manifest.MANIFEST_FILE} is written once "
                  f"the other machines' are (run any of the commands again).")
        return
    packed = manifest.read_manifest(options.out.expanduser())
    size_mb = sum(shard["bytes"] for shard in packed["shards"]) / 1e6
    show.line(f"{words.counted(packed['frames'], 'frame')} in {words.counted(len(packed['shards']), 'shard')}, "
              f"{size_mb:.1f} MB, after {seconds:.1f} s: {options.out}")


def main() -> int:
    return command_line.run(Options, pack, program="pack", examples=_EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
