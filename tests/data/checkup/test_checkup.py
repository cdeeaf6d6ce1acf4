"""What the doctor finds: each fault is found where it is, and named by nothing else."""

import dataclasses
import re
import tracemalloc
import types

import numpy as np
import pytest
import recording_samples as samples
import recording_writers as writers
import street_scene

from muvo_jax import config as config_lib
from muvo_jax.data.checkup import alignment, examination, figures, judgements
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.ops import camera as camera_ops

CONTRACT = config_lib.ActionContract()
LIDAR = config_lib.RangeViewGeometry(rows=64, columns=512, elevation_min_rad=-0.4, elevation_max_rad=0.2)


def drive(**changes):
    """A hundred frames of a bicycle that does what the contract says."""
    rng = np.random.default_rng(0)
    action = np.clip(np.cumsum(rng.normal(0, 0.1, (100, 2)), axis=0), -0.9, 0.9)
    full = np.where(action[:, 0] > 0, CONTRACT.accel_full_mps2, CONTRACT.brake_full_mps2)
    speed_mps = 12 + np.cumsum(np.append(0, full * action[:, 0] * 0.1)[:-1])
    yaw_rate_radps = -speed_mps * np.tan(CONTRACT.steer_full_rad * action[:, 1]) / CONTRACT.wheelbase_m
    fields = {"stretch": np.arange(100) // 50, "action": action, "speed_mps": speed_mps,
              "yaw_rate_radps": yaw_rate_radps, "timestamp_s": np.arange(100) / 10} | changes
    return judgements.DrivingLog(**fields)


def problems(motion, contract=CONTRACT):
    return [finding.text for finding in judgements.of_actions(motion, contract) if finding.level == "problem"]


def test_a_sound_drive_has_no_problem():
    assert problems(drive()) == []
    assert judgements.of_time(drive(), 10.0) == []


@pytest.mark.parametrize(("change", "message"), [
    (lambda motion: {"yaw_rate_radps": -motion.yaw_rate_radps}, "steering has the wrong sign"),
    (lambda motion: {"action": motion.action * [-1, 1]}, "acceleration has the wrong sign"),
    (lambda motion: {"action": motion.action * [1, 57.3]}, r"steering leaves \[-1, 1\] in \d+ of 100 frames"),
    (lambda motion: {"action": np.where(np.arange(100)[:, None] == 3, np.nan, motion.action)},
     "steering is not finite in 1"),
])
def test_faults_of_actions(change, message):
    motion = drive()
    with np.errstate(invalid="ignore"):
        found = problems(drive(**change(motion)))
    assert len([text for text in found if re.search(message, text)]) == 1, found


def test_accelerations_of_another_scale_are_found():
    other = config_lib.ActionContract(accel_full_mps2=10.0, brake_full_mps2=20.0)
    assert any("0.30 times what the action contract says" in text for text in problems(drive(), other))


def test_steering_of_another_scale_is_found():
    of_the_steering_wheel = dataclasses.replace(CONTRACT, steer_full_rad=CONTRACT.steer_full_rad / 10)
    (found,) = problems(drive(), of_the_steering_wheel)
    assert re.search(r"the car turns 1\d\.\d+ times as fast as the action contract says; correct steer_full_rad", found)
    degrees = np.degrees(drive().yaw_rate_radps)
    (found,) = problems(drive(yaw_rate_radps=degrees))
    assert "is yaw_rate_radps in degrees per second?" in found
    assert problems(driven(yaw_rate_radps=degrees)) == []  # named by of_units, which knows better
    assert problems(drive(), dataclasses.replace(of_the_steering_wheel, kinematics="none")) == []


@pytest.mark.parametrize(("times_s", "message"), [
    (np.arange(100) / 5, "0.200 s apart, but the description says 10 Hz"),
    (np.where(np.arange(100) == 7, 0.6, np.arange(100) / 10), "time does not advance at 1 of 98"),
])
def test_faults_of_time(times_s, message):
    assert [message in finding.text for finding in judgements.of_time(drive(timestamp_s=times_s), 10.0)] == [True]


def scene(seed):
    """A dark box before a pale wall, as a camera and a lidar at the same place see it."""
    rng = np.random.default_rng(seed)
    intrinsics = camera_ops.intrinsics_from_fov(320, 120, np.pi / 2)
    pose = camera_ops.level_camera_to_ego((1.0, 0.0, 2.0))
    left_m, top_m, width_m = rng.uniform(-2, 4), rng.uniform(-0.5, 0.5), rng.uniform(1.5, 3)
    yaw, elevation = np.meshgrid(np.linspace(-0.9, 0.9, 250), np.linspace(-0.35, 0.15, 60))
    rays = np.stack([np.ones(yaw.size), np.tan(yaw).ravel(), (np.tan(elevation) / np.cos(yaw)).ravel()], axis=1)
    near = rays * 8.0
    in_box = (near[:, 1] < left_m) & (near[:, 1] > left_m - width_m) & (near[:, 2] < top_m)
    points_m = np.where(in_box[:, None], near, rays * 25.0) + np.array([1.0, 0.0, 2.0])
    corners, _ = camera_ops.project_to_image(
        np.array([[9.0, left_m, 2 + top_m], [9.0, left_m - width_m, 2 + top_m]], np.float32), intrinsics, pose)
    image = np.full((120, 320, 3), 200, np.uint8) + rng.integers(0, 8, (120, 320, 1), np.uint8)
    (first, top), (last, _) = np.clip(corners.round().astype(int), 0, [319, 119])
    image[top:, first:last] //= 4
    return {"image": image, "points_m": points_m.astype(np.float32), "intrinsics": intrinsics, "camera_to_ego": pose}


@pytest.mark.parametrize("shift_px", [(0, 0), (8, 0), (-6, 3)])
def test_a_camera_that_is_off_is_measured(shift_px):
    frames = [scene(seed) for seed in range(14)]
    for frame in frames:
        frame["image"] = np.roll(frame["image"], shift_px[::-1], axis=(0, 1))
    found = alignment.measure(frames, LIDAR)
    assert found.is_known
    assert abs(found.right_px - shift_px[0]) <= 2 and abs(found.down_px - shift_px[1]) <= 2
    assert (found.gain > 1.03) == (shift_px != (0, 0))


@pytest.mark.parametrize("error_rad", [(0.0, 0.0), (0.05, 0.0), (-0.04, 0.03)])
@pytest.mark.parametrize("rows", [16, 32, 64, 128])
def test_a_turned_camera_is_measured_within_a_row_on_a_street_with_ground(rows, error_rad):
    frames = [street_scene.frame(seed, rows, right_rad=error_rad[0], down_rad=error_rad[1]) for seed in range(6)]
    found = alignment.measure(frames, street_scene.lidar(rows))
    true_px = np.tan(error_rad) * street_scene.INTRINSICS[0, 0]
    row_px = street_scene.INTRINSICS[0, 0] * np.radians(30.0) / rows
    assert found.is_known and found.row_px == pytest.approx(row_px, rel=0.1)
    assert max(abs(found.right_px - true_px[0]), abs(found.down_px - true_px[1])) <= row_px
    recording = types.SimpleNamespace(description=types.SimpleNamespace(
        camera=types.SimpleNamespace(intrinsics=street_scene.INTRINSICS.tolist()), lidar=street_scene.lidar(rows)))
    (finding,) = judgements.of_alignment(found, recording)
    assert finding.level == ("remark" if error_rad == (0.0, 0.0) else "problem")


@pytest.mark.parametrize("slope", [0.05, -0.04])
def test_a_road_that_rises_is_no_edge(slope):
    frames = [street_scene.frame(seed, 16, slope=slope) for seed in range(6)]
    found = alignment.measure(frames, street_scene.lidar(16))
    assert found.is_known and max(abs(found.right_px), abs(found.down_px)) <= 2


def test_flat_ground_alone_has_no_gaps():
    flat = street_scene.scan(0, 32, 0.0)
    flat = flat[np.abs(flat[:, 2]) < 0.1]
    assert len(flat) > 5000
    gaps = alignment.find_gaps(flat, street_scene.lidar(32))
    assert len(gaps.above) + len(gaps.beside) == 0


def row_rad(lidar):
    return (lidar.elevation_max_rad - lidar.elevation_min_rad) / lidar.rows


@pytest.mark.skipif(samples.KITTI is None, reason="no KITTI recording here")
@pytest.mark.parametrize("error_rad", [(0.0, 0.0), (0.05, 0.0), (-0.035, 0.03)])
@pytest.mark.parametrize("keep_every", [1, 2, 4])
def test_thinned_kitti_is_measured_within_a_row(keep_every, error_rad):
    recording = kitti_reader.KittiRecording(samples.KITTI)
    frames = [recording.read(sequence, index) for sequence in recording.sequences for index in range(0, 30, 5)
              if index < sequence.length]
    thinned = dataclasses.replace(kitti_reader.LIDAR, rows=64 // keep_every)
    for frame in frames:
        relative_m = frame["points_m"] - np.array(kitti_reader.LIDAR.position_m)
        elevation_rad = np.arctan2(relative_m[:, 2], np.hypot(relative_m[:, 0], relative_m[:, 1]))
        image_row = ((kitti_reader.LIDAR.elevation_max_rad - elevation_rad) / row_rad(kitti_reader.LIDAR)).astype(int)
        frame["points_m"] = frame["points_m"][image_row % keep_every == keep_every // 2]
        turned = street_scene.turn(-error_rad[0], error_rad[1]) @ frame["camera_to_ego"][:3, :3]
        frame["camera_to_ego"] = np.block([[turned, frame["camera_to_ego"][:3, 3:]], [np.eye(4)[3:]]])
    found = alignment.measure(frames, thinned)
    focal_px = frames[0]["intrinsics"][0, 0]
    assert found.is_known
    assert abs(np.arctan(found.right_px / focal_px) - error_rad[0]) <= row_rad(thinned)
    assert abs(np.arctan(found.down_px / focal_px) - error_rad[1]) <= row_rad(thinned)


def test_nothing_is_said_about_pictures_without_edges():
    frames = [scene(seed) for seed in range(4)]
    for frame in frames:
        frame["image"] = np.random.default_rng(0).integers(0, 255, frame["image"].shape, np.uint8)
    assert not alignment.measure(frames, LIDAR).is_known


def test_damaged_and_faulty_frames_are_counted(tmp_path):
    root = writers.write_plain(tmp_path / "rec")
    (root / "train/a/image/000004.png").write_bytes(b"")
    np.savez(root / "train/a/lidar/000005.npz", points_m=np.zeros((0, 3), np.float32))
    result = examination.examine(plain_reader.PlainRecording(root), ["a gap"], frames=0)
    texts = [finding.text for finding in result.findings if finding.level == "problem"]
    assert result.problems == len(texts)
    for part in ("a gap", "1 of 24 frames cannot be read: ", "000004.png", "1 of 23 scans are empty",
                 "23 of 23 images are of one colour"):
        assert any(part in text for text in texts), part
    assert result.facts["split train"] == "16 frames in 2 sequences, the longest 10"
    assert "90 degrees wide" in result.facts["camera"]


def test_stretches_are_spread_and_limited(tmp_path):
    recording = plain_reader.PlainRecording(writers.write_plain(tmp_path / "rec", {"train/a": 200, "val/b": 5},
                                                                splits='["train", "val"]'))
    result = examination.examine(recording, frames=120)
    assert result.facts["read"] == "65 of 65 frames looked at"
    assert set(result.motion.stretch) == {0, 1}


def driven(**changes):
    """The drive with the poses that its speed and yaw rate lead to."""
    motion = drive()
    yaw_rad = np.cumsum(np.append(0, motion.yaw_rate_radps[:-1] * 0.1))
    step_m = motion.speed_mps[:, None] * np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1) * 0.1
    place_m = np.cumsum(np.concatenate([np.zeros((1, 2)), step_m[:-1]]), axis=0)
    return dataclasses.replace(motion, pose=np.column_stack([place_m, yaw_rad]), **changes)


@pytest.mark.parametrize(("change", "message"), [
    (lambda motion: {}, None),
    (lambda motion: {"speed_mps": motion.speed_mps * 3.6}, r"speed_mps is 3\.\d+ times .*km/h"),
    (lambda motion: {"pose": motion.pose * [1000, 1000, 1]}, r"speed_mps is 0\.00 times .*km/s"),
    (lambda motion: {"pose": motion.pose * [1, 1, 57.2958]}, "must be in radians"),
    (lambda motion: {"yaw_rate_radps": np.degrees(motion.yaw_rate_radps)},
     r"yaw_rate_radps is 5\d\.\d+ times what yaw turns .* \(degrees\?\)"),
    (lambda motion: {"yaw_rate_radps": -motion.yaw_rate_radps}, r"yaw_rate_radps is -1\.\d+ times what yaw"),
])
def test_units_are_compared_with_the_motion(change, message):
    motion = driven()
    found = judgements.of_units(dataclasses.replace(motion, **change(motion)))
    assert len(found) == (message is not None)
    assert all(re.search(message, finding.text) and finding.level == "problem" for finding in found)


def test_points_in_centimetres_are_found(tmp_path):
    root = writers.write_plain(tmp_path / "rec")
    for path in root.glob("*/*/lidar/*.npz"):
        np.savez(path, points_m=np.random.default_rng(0).uniform(-4000, 4000, (100, 3)).astype(np.float32))
    texts = [finding.text for finding in examination.examine(plain_reader.PlainRecording(root)).findings]
    assert any("are they in metres?" in text for text in texts)


def test_points_in_millimetres_are_found_in_little_memory():
    points_mm = np.random.default_rng(0).uniform(-50_000, 50_000, (500, 3)).astype(np.float32)
    tracemalloc.start()
    alignment.find_gaps(points_mm, LIDAR)  # a table of the ground of 50 km would take gigabytes
    assert tracemalloc.get_traced_memory()[1] < 100_000_000
    tracemalloc.stop()


def test_pixels_and_points_of_unknown_class_are_no_problem(tmp_path):
    described = dataclasses.replace(plain_reader.PlainRecording(writers.write_plain(tmp_path / "rec")).description,
                                    classes=("sky", "road"))
    for classes, said in (([0, 1, 255], False), ([0, 2, 255], True)):
        counted = figures.Figures(described)
        counted.add({"frame_id": 7, "image_classes": np.array([classes], np.uint8),
                     "point_classes": np.array(classes, np.uint8)})
        texts = [finding.text for finding in counted.findings() if "recording names 2 classes" in finding.text]
        assert len(texts) == 2 * said and all("class 2, but" in text for text in texts)


def test_nothing_to_look_at_is_a_problem(tmp_path):
    described = plain_reader.PlainRecording(writers.write_plain(tmp_path / "rec")).description
    empty = types.SimpleNamespace(sequences=(), description=described)
    assert any("not one frame" in finding.text and finding.level == "problem"
               for finding in examination.examine(empty).findings)


AHEAD = np.array(camera_ops.level_camera_to_ego((1.5, 0.0, 1.6)), np.float64)
MIDDLE = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])


def pitched(degrees):
    """The camera, looking down by so much."""
    pose = AHEAD.copy()
    pose[:3, :3] = street_scene.turn(0.0, np.radians(degrees)) @ pose[:3, :3]
    return pose


@pytest.mark.parametrize(("pose", "intrinsics", "level", "message"), [
    (AHEAD, MIDDLE, None, None),
    (pitched(30.0), MIDDLE, None, None),
    (np.eye(4), MIDDLE, "problem", r"down axis, .* is \(0\.00, 1\.00, 0\.00\) in the ego frame"),
    (np.linalg.inv(AHEAD), MIDDLE, "problem", "down axis, .*is camera_to_ego inverted"),
    (pitched(50.0), MIDDLE, "problem", "the camera looks 50 degrees down"),
    (np.diag([-1.0, -1.0, 1.0, 1.0]) @ AHEAD, MIDDLE, "remark", "looks backwards"),
    (AHEAD, MIDDLE * [[1, 1, 2.2], [1, 1, 1], [1, 1, 1]], "problem", "cx = 105.6 lies outside of 96 pixels"),
    (AHEAD, MIDDLE * [[1, 1, 1], [1, 1, 0.3], [1, 1, 1]], "remark", "cy = 9.6 lies far from the middle of 64 pixels"),
])
def test_cameras_that_no_car_has_are_found(pose, intrinsics, level, message):
    found = judgements.of_cameras([(intrinsics, pose)] * 2, 96, 64)
    assert [finding.level for finding in found] == [level] * (level is not None)
    assert all(re.search(message, finding.text) for finding in found)


def street(seed, **changes):
    """A frame of the street with the depth of what the scan hits, else infinite."""
    frame = street_scene.frame(seed, 32)
    place_px, ahead_m = camera_ops.project_to_image(frame["points_m"], frame["intrinsics"], frame["camera_to_ego"])
    height_px, width_px = frame["image"].shape[:2]
    depth_m = np.full((height_px, width_px), np.inf, np.float32)
    inside = ((place_px >= 0) & (place_px < [width_px, height_px])).all(axis=1)
    column, row = place_px[inside].astype(int).T
    depth_m[row, column] = ahead_m[inside]
    return frame | {"frame_id": seed, "speed_mps": 8.0, "depth_m": depth_m} | changes


@pytest.mark.parametrize(("change", "level", "message"), [
    (lambda frame: {}, None, None),
    (lambda frame: {"depth_m": frame["depth_m"] * 10}, "problem", r"depth_m is 10 times .*written in millimetres\?"),
    (lambda frame: {"depth_m": frame["depth_m"] / 100}, "problem", r"depth_m is 0\.01 times .*written in metres\?"),
    (lambda frame: {"depth_m": np.where(np.arange(frame["depth_m"].shape[1]) % 4, frame["depth_m"], 0)}, "remark",
     r"depth is 0 in 25% of the pixels: they count as not measured"),
    (lambda frame: {"points_m": street(0)["points_m"]}, "problem", r"2 of 3 scans are copies of the one before"),
    (lambda frame: {"points_m": street(0)["points_m"], "speed_mps": 0.0}, None, None),
    (lambda frame: {"points_m": frame["points_m"][frame["points_m"][:, 0] > 0] * np.float32([-1, -1, 1])}, "problem",
     "hardly a return of the lidar falls into the picture"),
])
def test_scans_are_compared_with_depth_the_picture_and_the_scan_before(tmp_path, change, level, message):
    described = plain_reader.PlainRecording(writers.write_plain(tmp_path / "rec")).description
    counted = figures.Figures(dataclasses.replace(described, lidar=street_scene.lidar(32)))
    for seed in range(3):
        counted.add(street(seed, **change(street(seed))))
    about = [finding for finding in counted.findings()
             if re.search("depth|copies|falls into", finding.text)]
    assert [finding.level for finding in about] == [level] * (level is not None), about
    assert all(re.search(message, finding.text) for finding in about)
