"""Writes small recordings for the tests of this folder: synthetic KITTI raw drives and plain recordings."""

import csv
import pathlib

import numpy as np
from PIL import Image

DRIVE = "2011_09_26_drive_0099_sync"
FRAMES = 12
# A level camera 0.3 m ahead of the lidar and 0.08 m below it, looking forward: camera x = -lidar y, y = -z, z = x.
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.3\ndelta_f: 0 0\n"
COLUMNS = ("frame_id", "timestamp_s", "x_m", "y_m", "yaw_rad", "speed_mps", "acceleration", "steering", "reward",
           "is_terminal", "weather")
WIDTH, HEIGHT, FOCAL = 128, 48, 70.0


def write_kitti(root: pathlib.Path, frames: int = FRAMES) -> pathlib.Path:
    """Writes one drive under root/<date> and returns the drive folder; frame k is uniformly grey 10 * k."""
    date = root / "2011_09_26"
    drive = date / DRIVE
    rng = np.random.default_rng(0)
    for sensor in ("image_02", "velodyne_points", "oxts"):
        (drive / sensor / "data").mkdir(parents=True)
    identity = "1 0 0 0 1 0 0 0 1"
    cameras = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    for number, shift in (("00", 0.0), ("02", 7.0)):  # camera 02 sits 7 / 70 = 0.1 m to the left of camera 00
        cameras += [f"S_rect_{number}: {WIDTH:.6e} {HEIGHT:.6e}", f"R_rect_{number}: {identity}",
                    f"P_rect_{number}: {FOCAL} 0 64 {shift} 0 {FOCAL} 24 0 0 0 1 0"]
    (date / "calib_cam_to_cam.txt").write_text("\n".join(cameras) + "\n")
    (date / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012 11:37:16\n" + VELO_TO_CAM)
    for frame in range(frames):
        Image.new("RGB", (WIDTH, HEIGHT), (10 * frame,) * 3).save(drive / f"image_02/data/{frame:010d}.png")
        points = rng.uniform((3, -10, -1.73, 0), (30, 10, 3, 1), (200, 4)).astype(np.float32)
        points.tofile(drive / f"velodyne_points/data/{frame:010d}.bin")
        oxts = np.zeros(30)
        oxts[[8, 14, 19, 22]] = 10.0, -1.2, -0.1, -0.1  # 10 m/s, braking, turning right
        (drive / f"oxts/data/{frame:010d}.txt").write_text(" ".join(map(str, oxts)))
    times = [f"2011-09-26 13:02:{25 + frame / 10:012.9f}" for frame in range(frames)]
    (drive / "image_02/timestamps.txt").write_text("\n".join(times) + "\n")
    return drive


def plain_header(**changes: str) -> str:
    """A recording.toml; `changes` replace whole lines by their key."""
    lines = {
        "schema_version": "1", "name": '"test"', "rate_hz": "10", "splits": '["train", "val_rl"]',
        "[action]": "", "accel_full_mps2": "3", "source": '"recorded"',
        "[camera]": "", "width_px": "64", "height_px": "32",
        "intrinsics": "[[32, 0, 32], [0, 32, 16], [0, 0, 1]]",
        "camera_to_ego": "[[0, 0, 1, 1], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]]",
        "[lidar]": "", "rows": "64", "columns": "512", "elevation_min_rad": "-0.4", "elevation_max_rad": "0.1",
        "position_m": "[0.5, 0, 2]",
        "[voxels]": "", "shape": "[16, 16, 16]", "voxel_size_m": "1", "origin_m": "[-8, -8, -2]",
    } | changes
    return "\n".join(key if key.startswith("[") else f"{key} = {value}" for key, value in lines.items()) + "\n"


def write_plain(root: pathlib.Path, runs: dict[str, int] | None = None, **header: str) -> pathlib.Path:
    """Writes a plain recording with `runs` ("split/run" -> frames); frame k is uniformly grey k."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "recording.toml").write_text(plain_header(**header))
    for name, frames in (runs or {"train/a": 10, "train/b": 6, "val_rl/c": 8}).items():
        folder = root / name
        for sensor in ("image", "lidar", "occupancy", "route_map"):
            (folder / sensor).mkdir(parents=True)
        for frame in range(frames):
            Image.new("RGB", (64, 32), (frame,) * 3).save(folder / f"image/{frame:06d}.png")
            Image.new("L", (64, 64), frame).save(folder / f"route_map/{frame:06d}.png")
            np.savez(folder / f"lidar/{frame:06d}.npz", points_m=np.full((5, 3), 2.0 + frame, np.float32))
            np.savez(folder / f"occupancy/{frame:06d}.npz", occupancy=np.full((16, 16, 16), 255, np.uint8))
        with (folder / "frames.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for frame in range(frames):
                terminal = int(frame == frames - 1)
                writer.writerow([frame, 0.1 * frame, frame, 0, 0, 5.5, 0.25, -0.5, 1.0, terminal, "noon"])
    return root
