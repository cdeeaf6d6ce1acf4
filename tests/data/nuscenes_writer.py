"""Writes small synthetic sets in the format of nuScenes v1.0, with its clocks: a lidar at 20 Hz, pictures at 12 of 20
turns, key frames at 2 Hz, a pose for every file. The public devkit reads them too (experiments/nuscenes/compare.py).
"""

import hashlib
import json
import pathlib

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 64, 36, 50.0
START_US = 1_532_402_927_647_951
TURN_US, KEY_TURNS = 50_000, 10
PICTURE_TURNS = (0, 2, 4, 5, 7, 9)  # of ten
SHUTTER_US = {"CAM_FRONT": -35_491, "CAM_BACK": -10_033}  # before the end of the turn
SPEED_MPS, ACCELERATION_MPS2, YAW_RATE_RADPS = 6.0, 1.5, 0.2
MAP_XY_M, MAP_YAW_RAD = (600.0, 1650.0), 2.0
SCENES = ("scene-0061", "scene-0103")  # of mini_train and mini_val
# Of each scene's car: lidar, front and back camera in the ego frame (m).
PLACES_M = (((0.94, 0.0, 1.84), (1.72, 0.0, 1.49), (0.05, 0.0, 1.57)),
            ((0.99, 0.0, 1.84), (1.70, 0.02, 1.51), (0.03, 0.01, 1.57)))
# Axes of lidar (x right, y forward) and cameras (x right, y down, z forward) in the ego frame: quaternions w, x, y, z.
TURNS = {"LIDAR_TOP": (0.5**0.5, 0.0, 0.0, -(0.5**0.5)), "CAM_FRONT": (0.5, -0.5, 0.5, -0.5),
         "CAM_BACK": (0.5, -0.5, -0.5, 0.5), "RADAR_FRONT": (1.0, 0.0, 0.0, 0.0)}
TABLES = ("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
          "sample_annotation", "sample_data", "scene", "sensor", "visibility")


def token(*parts) -> str:
    return hashlib.md5("/".join(map(str, parts)).encode()).hexdigest()


def pose_at(time_us: int) -> np.ndarray:
    """float64 [3]: x, y (m) and yaw (rad) on the map; constant acceleration and yaw rate."""
    t, w, a = (time_us - START_US) / 1e6, YAW_RATE_RADPS, ACCELERATION_MPS2
    speed = SPEED_MPS + a * t
    ahead = speed * np.sin(w * t) / w + a * (np.cos(w * t) - 1) / w**2
    left = (SPEED_MPS - speed * np.cos(w * t)) / w + a * np.sin(w * t) / w**2
    cosine, sine = np.cos(MAP_YAW_RAD), np.sin(MAP_YAW_RAD)
    return np.array([MAP_XY_M[0] + cosine * ahead - sine * left, MAP_XY_M[1] + sine * ahead + cosine * left,
                     MAP_YAW_RAD + w * t])


def ego_to_map(time_us: int) -> np.ndarray:
    """float64 [4, 4]."""
    x, y, yaw = pose_at(time_us)
    return np.array([[np.cos(yaw), -np.sin(yaw), 0, x], [np.sin(yaw), np.cos(yaw), 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def turned(quaternion) -> np.ndarray:
    """float64 [3, 3]."""
    w, x, y, z = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def sensor_to_ego(channel: str, scene: int) -> np.ndarray:
    """float64 [4, 4]."""
    places_m = dict(zip(("LIDAR_TOP", "CAM_FRONT", "CAM_BACK"), PLACES_M[scene % 2], strict=True))
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turned(TURNS[channel]), places_m.get(channel, (3.4, 0.0, 0.5))
    return found


def landmarks() -> np.ndarray:
    """float64 [P, 3], what stands still on the map; all of it more than 8 m from where the car drives."""
    rng = np.random.default_rng(0)
    around = rng.uniform((-40, -40, 0), (40, 40, 4), (400, 3))
    path = np.array([pose_at(START_US + step * 250_000)[:2] for step in range(13)])
    middle = path.mean(axis=0)
    points = around + np.append(middle, 0.0)
    return points[np.linalg.norm(points[:, None, :2] - path, axis=2).min(axis=1) > 8]


def write(root: pathlib.Path, *, version: str = "v1.0-mini", scenes=SCENES, turns: int = 41,
          cameras=("CAM_FRONT", "CAM_BACK"), files: bool = True) -> pathlib.Path:
    """Writes a set and returns its root; the picture taken in turn k is uniformly grey 5 * k.

    Args:
      turns: scans of each scene, the first and every tenth of them in a key frame.
      files: whether to write pictures and scans, beside the tables.
    """
    tables = {name: [] for name in TABLES}
    channels = ("LIDAR_TOP", *cameras, "RADAR_FRONT")
    for channel in channels:
        modality = "lidar" if channel == "LIDAR_TOP" else channel.split("_")[0].lower().replace("cam", "camera")
        tables["sensor"].append({"token": token(channel), "channel": channel, "modality": modality})
    for number, name in enumerate(scenes):
        _add_scene(root, tables, number, name, channels, turns, files=files)
    (root / "maps").mkdir(parents=True, exist_ok=True)
    Image.new("L", (8, 8), 255).save(root / "maps/mask.png")
    tables["map"].append({"token": token("map"), "category": "semantic_prior", "filename": "maps/mask.png",
                          "log_tokens": [row["token"] for row in tables["log"]]})
    (root / version).mkdir()
    for name, rows in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows, indent=0))
    return root


def _add_scene(root, tables, number, name, channels, turns, *, files):
    tables["log"].append({"token": token("log", name), "logfile": f"n{number:03d}", "vehicle": f"n{number:03d}",
                          "date_captured": "2018-07-24", "location": "singapore-onenorth"})
    intrinsics = [[FOCAL + number, 0.0, WIDTH / 2], [0.0, FOCAL + number, HEIGHT / 2], [0.0, 0.0, 1.0]]
    for channel in channels:
        tables["calibrated_sensor"].append({
            "token": token(channel, name), "sensor_token": token(channel), "rotation": list(TURNS[channel]),
            "translation": sensor_to_ego(channel, number)[:3, 3].tolist(),
            "camera_intrinsic": intrinsics if channel.startswith("CAM") else []})
    keys = [START_US + turn * TURN_US for turn in range(0, turns, KEY_TURNS)]
    samples = _chained([{"token": token("sample", name, time_us), "timestamp": time_us,
                         "scene_token": token("scene", name)} for time_us in keys])
    tables["sample"] += samples
    tables["scene"].append({"token": token("scene", name), "name": name, "description": "synthetic",
                            "log_token": token("log", name), "nbr_samples": len(samples),
                            "first_sample_token": samples[0]["token"], "last_sample_token": samples[-1]["token"]})
    for channel in channels:
        rows = [_sample_data(root, tables, number, name, channel, turn, samples, files=files)
                for turn in range(turns) if channel == "LIDAR_TOP" or turn % 10 in PICTURE_TURNS]
        tables["sample_data"] += _chained(rows)


def _sample_data(root, tables, number, name, channel, turn, samples, *, files):
    time_us = START_US + turn * TURN_US + SHUTTER_US.get(channel, 0)
    is_camera, is_key_frame = channel.startswith("CAM"), turn % KEY_TURNS == 0
    suffix = "jpg" if is_camera else "pcd.bin" if channel == "LIDAR_TOP" else "pcd"
    path = f"{'samples' if is_key_frame else 'sweeps'}/{channel}/n{number:03d}__{channel}__{time_us}.{suffix}"
    x, y, yaw = pose_at(time_us)
    pose = token("pose", name, channel, time_us)
    tables["ego_pose"].append({"token": pose, "timestamp": time_us, "translation": [x, y, 0.0],
                               "rotation": [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]})
    if files and channel != "RADAR_FRONT":
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        if is_camera:
            Image.new("RGB", (WIDTH, HEIGHT), (5 * turn,) * 3).save(root / path, quality=95)
        else:
            scan(time_us, number).tofile(root / path)
    sample = samples[min(-(-turn // KEY_TURNS), len(samples) - 1)]  # the one that follows
    return {"token": token("data", name, channel, time_us), "sample_token": sample["token"], "ego_pose_token": pose,
            "calibrated_sensor_token": token(channel, name), "filename": path, "fileformat": suffix.split(".")[0],
            "width": WIDTH * is_camera, "height": HEIGHT * is_camera, "timestamp": time_us,
            "is_key_frame": is_key_frame}


def scan(time_us: int, scene: int) -> np.ndarray:
    """float32 [P, 5], the landmarks as the lidar sees them, with intensity and beam."""
    to_map = ego_to_map(time_us) @ sensor_to_ego("LIDAR_TOP", scene)
    points = (landmarks() - to_map[:3, 3]) @ to_map[:3, :3]
    beams = np.arange(len(points)) % 32
    return np.concatenate([points, np.full((len(points), 1), 17.0), beams[:, None]], axis=1).astype(np.float32)


def _chained(rows):
    """The rows with the tokens of those before and after them."""
    for index, row in enumerate(rows):
        row["prev"] = rows[index - 1]["token"] if index else ""
        row["next"] = rows[index + 1]["token"] if index + 1 < len(rows) else ""
    return rows


def change(root: pathlib.Path, table: str, alter, version: str = "v1.0-mini") -> None:
    """Rewrites a table: `alter` gets its rows and may change them, or returns others."""
    path = root / version / f"{table}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(alter(rows) or rows))
