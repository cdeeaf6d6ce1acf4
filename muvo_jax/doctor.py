"""python -m muvo_jax.doctor PATH: what a recording holds, what is wrong with it, and pictures to see for oneself."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
import warnings
from typing import Annotated

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax import config as config_lib
    from muvo_jax import presets
    from muvo_jax.data import fitting, prepare, schema, sequences, sources, words
    from muvo_jax.data.checkup import examination, judgements
    from muvo_jax.ops import voxels as voxel_ops
    from muvo_jax.training import screen
    from muvo_jax.viz import canvas, checks, panels


@dataclasses.dataclass(frozen=True)
class Options:
    """Looks a recording over before anything is trained on it: sensors, gaps, damaged files, actions, alignment.

    Works on every format that training does, and opens labels too. Writes report.md and pictures; ends with 0 where all
    is well, with 1 where something should be mended and with 2 where it could not look.
    """

    path: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of a recording."""
    out: Annotated[pathlib.Path | None, command_line.shown("FOLDER", "doctor/NAME")] = None
    """Where the report goes; NAME is that of the folder."""
    camera: Annotated[str, command_line.shown("NAME", "the reader's choice")] = ""
    """Which camera, where the recording has several (KITTI: image_00 to image_03; nuScenes: CAM_FRONT, ...)."""
    key_frames: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only key frames, where the recording has them (nuScenes: 2 a second instead of 10)."""
    frames: int = 600
    """How many frames to read, spread over the recording; 0 reads all."""
    workers: Annotated[int | None, command_line.shown("N", "one a processor")] = None
    """How many stretches of frames are read side by side, each by a thread."""


EXAMPLES = """
python -m muvo_jax.doctor /data/kitti_raw
python -m muvo_jax.doctor /data/muvo --frames=0  (reads every file)
python -m muvo_jax.doctor recordings/mine --out=look
"""


def examine(options: Options, show: screen.Screen) -> examination.Checkup:
    """Does what the command line asks for.

    Raises:
      DataError: where the folder is no recording.
    """
    kind = sources.recognise(options.path, camera=options.camera, key_frames=options.key_frames)
    name = options.path.expanduser().resolve().name or "recording"
    try:
        recording, warned = open_recording(options.path, options.camera, key_frames=options.key_frames)
    except schema.DataError as error:
        described, result = None, examination.refused(f"{name} ({kind.name})", error)
    else:
        described = recording.description
        problems, gaps = ([text for category, text in warned if issubclass(category, sequences.GapWarning) == is_gap]
                          for is_gap in (False, True))
        with show.counter("looking at", "frames") as progress:
            result = examination.examine(recording, problems, frames=options.frames, workers=options.workers, gaps=gaps,
                                         progress=progress)
        result = result.with_problems(refusals(recording, result))
    out = (options.out or pathlib.Path("doctor") / name).expanduser()
    for fact, value in result.facts.items():
        show.field(fact, value)
    for finding in result.findings:
        show.line(f"{finding.level}: {finding.text}", style="bold red" if finding.level == "problem" else "")
    pictures = draw(described, result, out) if described is not None else []
    for path in (write_report(out, result, pictures), *pictures):
        show.line(f"wrote {path}")
    show.line(f"{words.counted(result.problems, 'problem')} found in {options.path}; see {out / 'report.md'}."
              if result.problems else "no problem found.", style="bold")
    return result


def open_recording(path: pathlib.Path, camera: str = "", *,
                   key_frames: bool = False) -> tuple[schema.Recording, list[tuple[type[Warning], str]]]:
    """The recording with every label it holds, and what opening it warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        recording = sources.open_recording(path, camera=camera, key_frames=key_frames, labels=schema.LABELS)
    return recording, [(warning.category, str(warning.message)) for warning in caught
                       if issubclass(warning.category, schema.DataWarning)]


def refusals(recording: schema.Recording, result: examination.Checkup) -> list[str]:
    """Why training would not take the recording as it is; empty where it would."""
    try:
        config = fitting.adapt(presets.get("town"), recording).config
        fitting.check_targets(config, recording.description)
        for sample in result.pictures:
            prepare.prepare_frame(sample.frame, config)
    except ValueError as error:  # DataError too
        return [f"python -m muvo_jax.train --data refuses it: {error}"]
    return []


def draw(described: schema.RecordingDescription, result: examination.Checkup, out: pathlib.Path) -> list[pathlib.Path]:
    """Writes overlays of a few frames, and the actions beside the motion of the first stretch that moves."""
    written = []
    every = len(result.pictures)
    for number in sorted({every // 6, every // 2, every * 5 // 6}) if every else []:
        sample = result.pictures[number]
        frame = sample.frame
        parts = []
        if "points_m" in frame and "image" in frame:
            overlay = checks.lidar_in_image(frame["image"], frame["points_m"], frame["intrinsics"],
                                            frame["camera_to_ego"])
            parts.append(canvas.caption(overlay, "lidar in the image: pale is near"))
        elif "image" in frame:
            parts.append(canvas.caption(frame["image"], "image"))
        if "points_m" in frame:
            parts.append(checks.above(frame["points_m"], *_voxels(frame, described),
                                      ego_m=panels.ego_of(described.contract)))
        if parts:
            title = f"{sample.sequence.name}, frame {int(frame['frame_id'])}"
            page = canvas.margin(canvas.caption(canvas.stack(parts, axis=0), title, size_px=17))
            written.append(canvas.save_png(out / f"overlay_{number:02d}.png", page))
    motion = result.motion
    if len(motion.stretch):
        number = _liveliest(motion)
        chosen = motion.stretch == number
        time_s = motion.timestamp_s[chosen] - motion.timestamp_s[chosen][0]
        page = checks.action_against_motion(time_s, motion.action[chosen, 1], motion.yaw_rate_radps[chosen],
                                            motion.action[chosen, 0], motion.acceleration_mps2[chosen])
        page = canvas.margin(canvas.caption(page, "actions beside measured motion (s)", size_px=17))
        written.append(canvas.save_png(out / "actions.png", page))
    return written


def _voxels(frame: schema.RawFrame, described: schema.RecordingDescription):
    """Occupancy and its grid: as recorded, else what the frame's own scan gives for a target."""
    if "occupancy" in frame or described.lidar is None:
        return frame.get("occupancy"), described.voxels
    grid = config_lib.VoxelGrid()
    lidar_m = np.array(described.lidar.position_m, np.float32)
    return voxel_ops.occupancy_target(frame["points_m"], lidar_m, grid), grid


def _liveliest(motion: judgements.DrivingLog) -> int:
    """The stretch that steers most."""
    numbers = np.unique(motion.stretch)
    return int(max(numbers, key=lambda number: motion.action[motion.stretch == number, 1].std()))


def write_report(out: pathlib.Path, result: examination.Checkup, pictures: list[pathlib.Path]) -> pathlib.Path:
    """OUT/report.md."""
    lines = ["# What is there", "", "| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in
                                                            result.facts.items()), ""]
    for level, title in (("problem", "# What should be mended"), ("remark", "# What should be known")):
        texts = [finding.text for finding in result.findings if finding.level == level]
        lines += [title, "", *(f"* {text}" for text in texts or ["nothing"]), ""]
    lines += [f"![{path.stem}]({path.name})" for path in pictures]
    out.mkdir(parents=True, exist_ok=True)
    (out / "report.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return out / "report.md"


def main() -> int:
    return command_line.run(Options, examine, program="doctor", examples=EXAMPLES, failed=2,
                            status=lambda result: int(bool(result.problems)))


if __name__ == "__main__":
    sys.exit(main())
