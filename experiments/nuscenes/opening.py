"""What opening tables of v1.0-trainval's size costs: python experiments/nuscenes/opening.py FOLDER [--scenes=850]

Writes synthetic tables with as many rows as the original's (850 scenes of 20 s; a lidar at 20 Hz, six cameras at 12 Hz,
five radars at 13 Hz: about 2.6 million files) and, as after unpacking one archive of ten, empty files for every tenth
scene's lidar and front camera. Opens them in a process of its own and prints its time and largest memory.
"""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import resource
import shutil
import subprocess
import sys
import time

SECONDS, VERSION = 20, "v1.0-trainval"
CAMERAS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
RADARS = ("RADAR_FRONT", "RADAR_FRONT_LEFT", "RADAR_FRONT_RIGHT", "RADAR_BACK_LEFT", "RADAR_BACK_RIGHT")
RATES_HZ = {"LIDAR_TOP": 20} | dict.fromkeys(CAMERAS, 12) | dict.fromkeys(RADARS, 13)
START_US = 1_532_402_927_000_000


def write(root: pathlib.Path, names: list[str]) -> None:
    """Writes the tables row by row, and the files."""
    folder = root / VERSION
    folder.mkdir(parents=True)
    number = itertools.count()
    token = lambda: f"{next(number):032x}"
    sensors = {channel: token() for channel in RATES_HZ}
    _table(folder, "sensor", ({"token": key, "channel": channel, "modality": "camera"}
                              for channel, key in sensors.items()))
    calibrated = {channel: token() for channel in RATES_HZ}
    _table(folder, "calibrated_sensor", ({
        "token": key, "sensor_token": sensors[channel], "translation": [0.9, 0.0, 1.8],
        "rotation": [0.5, -0.5, 0.5, -0.5], "camera_intrinsic": [[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5],
                                                                 [0.0, 0.0, 1.0]] if channel in CAMERAS else []}
        for channel, key in calibrated.items()))
    scenes = {name: token() for name in names}
    _table(folder, "scene", ({"token": key, "name": name} for name, key in scenes.items()))
    samples = {name: [token() for _ in range(2 * SECONDS)] for name in names}
    _table(folder, "sample", ({"token": key, "timestamp": START_US, "scene_token": scenes[name]}
                              for name, keys in samples.items() for key in keys))
    rows = ((place, name, channel, index) for place, name in enumerate(names) for channel, rate_hz in RATES_HZ.items()
            for index in range(SECONDS * rate_hz))
    with (folder / "sample_data.json").open("w") as data, (folder / "ego_pose.json").open("w") as poses:
        separators = itertools.chain("[", itertools.repeat(","))
        for separator, (place, name, channel, index) in zip(separators, rows, strict=False):
            time_us = START_US + place + index * 1_000_000 // RATES_HZ[channel]
            sample, is_key = divmod(index * 2, RATES_HZ[channel])
            kind = "samples" if is_key == 0 else "sweeps"
            path = f"{kind}/{channel}/n015-2018-07-24-11-22-45+0800__{name}__{channel}__{time_us}.pcd.bin"
            key, is_camera = token(), channel in CAMERAS
            data.write(separator + "\n" + json.dumps({
                "token": key, "sample_token": samples[name][sample], "ego_pose_token": key,
                "calibrated_sensor_token": calibrated[channel], "timestamp": time_us, "fileformat": "jpg",
                "is_key_frame": is_key == 0, "height": 900 * is_camera, "width": 1600 * is_camera, "filename": path,
                "prev": key, "next": key}, indent=0))
            poses.write(separator + "\n" + json.dumps({
                "token": key, "timestamp": time_us, "rotation": [0.5720320396729045, -0.0016977771610471074,
                                                                 0.011798001930183783, -0.8201446642457809],
                "translation": [411.3039349319818 + 6e-6 * (time_us - START_US), 1180.8903791765097, 0.0]}, indent=0))
            if channel in ("LIDAR_TOP", "CAM_FRONT") and place % 10 == 0:
                (root / path).parent.mkdir(parents=True, exist_ok=True)
                (root / path).touch()
        data.write("]")
        poses.write("]")


def _table(folder: pathlib.Path, name: str, rows) -> None:
    (folder / f"{name}.json").write_text(json.dumps(list(rows), indent=0))


def open_it(root: pathlib.Path, key_frames: bool) -> None:
    """Opens the set and prints what that cost."""
    from muvo_jax.data import sources
    before_s, before_kib = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    recording = sources.open_recording(root, key_frames=key_frames)
    spent_s, most_kib = time.process_time() - before_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    frames = sum(sequence.length for sequence in recording.sequences)
    print(f"{'key frames' if key_frames else 'sweeps'}: {len(recording.sequences)} sequences, {frames} frames; "
          f"{spent_s:.0f} processor seconds, at most {most_kib / 1024:.0f} MiB, of which {before_kib / 1024:.0f} MiB "
          f"before opening")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--scenes", type=int, default=850)
    parser.add_argument("--open", choices=("sweeps", "key_frames"), help="only opens what is there, in this process")
    chosen = parser.parse_args()
    if chosen.open:
        open_it(chosen.folder, chosen.open == "key_frames")
        return
    from muvo_jax.data.nuscenes import scene_splits
    names = sorted(scene_splits.of(VERSION))[:chosen.scenes]
    shutil.rmtree(chosen.folder, ignore_errors=True)
    write(chosen.folder, names)
    sizes = {path.stem: path.stat().st_size / 1e9 for path in (chosen.folder / VERSION).iterdir()}
    print(f"sample_data {sizes['sample_data']:.2f} GB, ego_pose {sizes['ego_pose']:.2f} GB")
    for what in ("sweeps", "key_frames"):
        subprocess.run([sys.executable, __file__, str(chosen.folder), f"--open={what}"], check=True)


if __name__ == "__main__":
    main()
