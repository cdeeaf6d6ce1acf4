"""Compares the nuScenes reader with the public devkit, on a synthetic set in that format.

tests/data/nuscenes_writer.py writes the set. The devkit needs NumPy 1 and muvo_jax NumPy 2, so that each runs in an
environment of its own:

    python experiments/nuscenes/compare.py read FOLDER               # writes the set and what our reader makes of it
    python -m venv devkit && devkit/bin/pip install nuscenes-devkit==1.2.0
    devkit/bin/python experiments/nuscenes/compare.py judge FOLDER   # prints the table of README.md
"""

from __future__ import annotations

import argparse
import pathlib
import shutil
import sys
import warnings

import numpy as np

REPOSITORY = pathlib.Path(__file__).parents[2]
CASES = {f"{camera}, {'key frames' if key_frames else 'sweeps'}": (camera, key_frames)
         for camera in ("CAM_FRONT", "CAM_BACK") for key_frames in (False, True)}
VERSION = "v1.0-mini"
LIMITS = {"scan (m)": 1e-4, "place (m)": 1e-9, "yaw (rad)": 1e-9, "intrinsics (px)": 1e-5, "pixel (px)": 0.05,
          "picture": 0.0}
OWN_CAR_M = ((-0.9, 3.7), (-1.0, 1.0))  # points in it are left out; muvo_jax.data.nuscenes.scans


def read(folder: pathlib.Path) -> None:
    """Writes the set, and the frames that our reader makes of it."""
    sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests/data")]
    import nuscenes_writer

    from muvo_jax.data import sources
    from muvo_jax.data.nuscenes import scene_splits
    shutil.rmtree(folder, ignore_errors=True)
    nuscenes_writer.write(folder / "set")
    for case, (camera, key_frames) in CASES.items():
        recording = sources.open_recording(folder / "set", camera=camera, key_frames=key_frames)
        arrays = {"scenes": np.array([sequence.name for sequence in recording.sequences])}
        for sequence in recording.sequences:
            for index in range(sequence.length):
                for name, value in recording.read(sequence, index).items():
                    arrays[f"{sequence.name}/{index}/{name}"] = value
        np.savez(folder / f"{case}.npz", **arrays)
    np.savez(folder / "splits.npz", **{f"{version}/{split}": sorted(names) for version, splits in
                                       scene_splits.OF_VERSION.items() for split, names in splits.items()})


def judge(folder: pathlib.Path) -> int:
    """Prints the largest differences; returns how many are too large."""
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.splits import create_splits_scenes
    warnings.simplefilter("ignore")
    splits = create_splits_scenes()
    ours = np.load(folder / "splits.npz")
    failed = 0
    for name, official in (("v1.0-mini/train", "mini_train"), ("v1.0-mini/val", "mini_val"),
                           ("v1.0-trainval/train", "train"), ("v1.0-trainval/val", "val")):
        same = sorted(splits[official]) == ours[name].tolist()
        print(f"split {official}: {len(ours[name])} scenes, {'the same' if same else 'OTHERS'}")
        failed += not same
    kit = NuScenes(VERSION, str(folder / "set"), verbose=False)
    columns = ("largest difference", "frames", "points", "pixels", *LIMITS, "pixel, as calibrated (px)")
    print(f"\n| {' | '.join(columns)} |\n|---|{'---:|' * (len(columns) - 1)}")
    for case, (camera, key_frames) in CASES.items():
        rows = list(_differences(kit, np.load(folder / f"{case}.npz"), camera, key_frames))
        worst = {name: max(row[name] for row in rows) for name in LIMITS}
        cells = [case, str(len(rows)), *(str(sum(row[name] for row in rows)) for name in ("points", "pixels")),
                 *(f"{value:.1e}" for value in worst.values()), f"{max(row['as calibrated'] for row in rows):.1f}"]
        print(f"| {' | '.join(cells)} |")
        failed += sum(value > LIMITS[name] for name, value in worst.items())
    return int(failed)


def _differences(kit, frames, camera: str, key_frames: bool):
    """Of every frame, by the names of LIMITS; beside them how much was compared, and what pixels would differ by if the
    camera's place were the calibrated one, although the car moved between scan and picture.
    """
    for scene_name in frames["scenes"].tolist():
        scene = next(scene for scene in kit.scene if scene["name"] == scene_name)
        scans, pictures = (_chain(kit, scene, channel) for channel in ("LIDAR_TOP", camera))
        if key_frames:
            samples = [kit.get("sample", scan["sample_token"]) for scan in scans if scan["is_key_frame"]]
            pairs = [tuple(kit.get("sample_data", sample["data"][channel]) for channel in ("LIDAR_TOP", camera))
                     for sample in samples]
        else:
            nearest = lambda scan, among: min(among, key=lambda row: abs(row["timestamp"] - scan["timestamp"]))
            pairs = [(scan, nearest(scan, pictures)) for scan in scans[::2]]
        count = sum(name.startswith(f"{scene_name}/") and name.endswith("/frame_id") for name in frames.files)
        assert count == len(pairs), f"{scene_name}: {count} frames, expected {len(pairs)}"
        for index, (scan, picture) in enumerate(pairs):
            frame = {name: frames[f"{scene_name}/{index}/{name}"] for name in (
                "frame_id", "timestamp_s", "points_m", "pose", "image", "intrinsics", "camera_to_ego")}
            assert frame["frame_id"] == scan["timestamp"] and frame["timestamp_s"] == scan["timestamp"] / 1e6
            yield _difference(kit, frame, scan, picture)


def _chain(kit, scene, channel: str) -> list[dict]:
    """The rows of a sensor in a scene, along their tokens."""
    first = kit.get("sample", scene["first_sample_token"])["data"][channel]
    row = kit.get("sample_data", first)
    while row["prev"]:
        row = kit.get("sample_data", row["prev"])
    found = [row]
    while found[-1]["next"]:
        found.append(kit.get("sample_data", found[-1]["next"]))
    return found


def _difference(kit, frame, scan: dict, picture: dict) -> dict[str, float]:
    from nuscenes.utils.data_classes import LidarPointCloud
    from PIL import Image
    from pyquaternion import Quaternion
    mounted, pose = kit.get("calibrated_sensor", scan["calibrated_sensor_token"]), kit.get("ego_pose",
                                                                                             scan["ego_pose_token"])
    cloud = LidarPointCloud.from_file(kit.get_sample_data_path(scan["token"]))
    cloud.rotate(Quaternion(mounted["rotation"]).rotation_matrix)
    cloud.translate(np.array(mounted["translation"]))
    points = cloud.points[:3].T
    points = points[~np.logical_and.reduce([(points[:, axis] > low) & (points[:, axis] < high)
                                            for axis, (low, high) in enumerate(OWN_CAR_M)])]
    camera = kit.get("calibrated_sensor", picture["calibrated_sensor_token"])
    yaw = Quaternion(pose["rotation"]).yaw_pitch_roll[0]
    seen, _, image = kit.explorer.map_pointcloud_to_image(scan["token"], picture["token"])
    u, v, inside = _project(frame, image.size)
    missing = np.inf if seen.shape[1] != inside.sum() else 0.0
    still = frame | {"camera_to_ego": _matrix(Quaternion(camera["rotation"]).rotation_matrix, camera["translation"])}
    at_calibration = np.stack(_project(still, image.size)[:2], axis=1)
    return {"points": len(points), "pixels": int(inside.sum()),
            "as calibrated": _largest(seen[:2].T - at_calibration[inside]) if not missing else np.inf,
            "scan (m)": _largest(points - frame["points_m"]),
            "place (m)": _largest(np.array(pose["translation"][:2]) - frame["pose"][:2]),
            "yaw (rad)": abs((yaw - frame["pose"][2] + np.pi) % (2 * np.pi) - np.pi),
            "intrinsics (px)": _largest(np.array(camera["camera_intrinsic"]) - frame["intrinsics"]),
            "pixel (px)": missing or _largest(seen[:2].T - np.stack([u, v], axis=1)[inside]),
            "picture": _largest(np.asarray(Image.open(kit.get_sample_data_path(picture["token"]))).astype(float)
                                - frame["image"])}


def _project(frame, size) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of the points, and which the devkit draws: more than 1 m ahead, a pixel inside of the picture."""
    to_ego = frame["camera_to_ego"].astype(np.float64)
    x, y, z = ((frame["points_m"] - to_ego[:3, 3]) @ to_ego[:3, :3]).T
    k = frame["intrinsics"].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]
    return u, v, (z > 1.0) & (u > 1) & (u < size[0] - 1) & (v > 1) & (v < size[1] - 1)


def _matrix(rotation: np.ndarray, translation: list[float]) -> np.ndarray:
    return np.block([[rotation, np.array(translation)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("read", "judge"))
    parser.add_argument("folder", type=pathlib.Path)
    chosen = parser.parse_args()
    sys.exit(read(chosen.folder) if chosen.step == "read" else judge(chosen.folder))
