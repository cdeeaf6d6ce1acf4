"""The KITTI raw reader on a synthetic drive; the real excerpt where it is present."""

import math
import shutil
import types
import warnings

import numpy as np
import pytest
import recording_samples as samples
import recording_writers as writers
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import ego_motion, fitting, pipeline, prepare, schema, sources, windows
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.metrics import cards, protocol
from muvo_jax.ops import camera as camera_ops
from muvo_jax.training import validation


@pytest.fixture
def drive(tmp_path):
    return writers.write_kitti(tmp_path)


def test_the_path_may_be_the_root_the_date_or_the_drive(drive):
    for path in (drive.parent.parent, drive.parent, drive):
        recording = sources.open_recording(path)
        assert recording.description.kind == "KITTI raw"
        assert recording.description.name == writers.DRIVE


def test_two_thirds_train_and_the_rest_validates(drive):
    recording = kitti_reader.KittiRecording(drive)
    assert [(s.split, s.start, s.length) for s in recording.sequences] == [("train", 0, 8), ("val", 8, 4)]
    assert recording.description.splits == ("train", "val")
    assert any("no domain-shift" in note for note in recording.description.notes)
    assert recording.description.rate_hz == 10.0


def test_drives_of_the_odometry_benchmark_test_as_the_card_of_4d_occ_lists_them(drive, monkeypatch):
    name = "2011_09_30_drive_0034_sync"
    shutil.copytree(drive, drive.parent / name)
    monkeypatch.setitem(kitti_reader.TEST, name, (3, 9))
    both = kitti_reader.KittiRecording(drive.parent)
    assert [(s.split, s.name, s.start, s.length) for s in both.sequences] == [
        ("train", writers.DRIVE, 0, 8), ("val", writers.DRIVE, 8, 4), ("test", name, 3, 7)]
    assert both.description.splits == ("train", "val", "test")
    assert any("08 to 10" in note for note in both.description.notes)
    alone = kitti_reader.KittiRecording(drive.parent / name)
    assert alone.description.splits == ("test",) and [s.split for s in alone.sequences] == ["test"]
    assert not any("two thirds" in note for note in alone.description.notes)


def test_the_card_of_4d_occ_has_the_samples_of_the_whole_drives():
    class Whole:  # frames are numbered from 0
        sequences = tuple(schema.Sequence("test", name, first, last - first + 1)
                          for name, (first, last) in kitti_reader.TEST.items())
        description = types.SimpleNamespace(splits=("test",))

    card = cards.load("kitti-4docc-1s")
    length = card.settings["data.context"] + card.settings["data.horizon"]
    found = windows.find_windows(Whole, "test", frames=length, stride=card.requires["data.stride"])
    assert card.samples["test"] == cards.Samples(len(found), windows.fingerprint(found))
    assert card.samples["test"].fingerprint != windows.fingerprint(found[1:])


def test_a_frame_in_the_ego_frame(drive):
    recording = kitti_reader.KittiRecording(drive)
    frame = recording.read(recording.sequences[1], 1)
    assert frame["frame_id"] == 9
    assert frame["image"].shape == (48, 128, 3) and (frame["image"] == 90).all()
    scan = np.fromfile(drive / "velodyne_points/data/0000000009.bin", np.float32).reshape(-1, 4)
    np.testing.assert_allclose(frame["points_m"], scan[:, :3] + [0, 0, 1.73], rtol=1e-6)
    times = [recording.read(recording.sequences[0], index)["timestamp_s"] for index in (2, 3)]
    assert times[1] - times[0] == pytest.approx(0.1, abs=1e-6)
    assert frame["speed_mps"] == 10.0
    assert "occupancy" not in frame and "route_map" not in frame and "reward" not in frame


def test_the_camera_sits_where_the_calibration_says(drive):
    camera = kitti_reader.KittiRecording(drive).description.camera
    # 0.3 m ahead of and 0.08 m below a lidar at 1.73 m; a shift of 7 px at focal length 70 is 0.1 m to the left.
    np.testing.assert_allclose(np.array(camera.camera_to_ego)[:3, 3], [0.3, 0.1, 1.65], atol=1e-6)
    point_m = np.array([[10.3, 2.1, 0.65]], np.float32)  # 10 m ahead of, 2 m left of and 1 m below the camera
    uv_px, depth_m = camera_ops.project_to_image(point_m, np.array(camera.intrinsics), np.array(camera.camera_to_ego))
    np.testing.assert_allclose(uv_px, [[64 - 70 * 2 / 10, 24 + 70 * 1 / 10]], rtol=1e-5)
    assert depth_m[0] == pytest.approx(10.0, rel=1e-6)


def test_actions_are_derived_from_the_motion(drive):
    recording = kitti_reader.KittiRecording(drive)
    contract = recording.description.contract
    assert (contract.source, contract.kinematics, contract.wheelbase_m) == ("derived", "bicycle", 2.71)
    action = recording.read(recording.sequences[0], 0)["action"]
    np.testing.assert_array_equal(recording.action(recording.sequences[0], 0), action)
    # -1.2 m/s2 of 6 is a brake of 0.2; turning right (yaw rate -0.1 at 10 m/s) is steering to the right, > 0.
    np.testing.assert_allclose(action, [-0.2, math.atan(2.71 * 0.1 / 10) / 0.6], rtol=1e-6)
    np.testing.assert_array_equal(ego_motion.derive_action(0.1, 99.0, 9.0, contract), [1.0, -1.0])
    assert ego_motion.derive_action(5.0, 1.5, 0.0, contract)[0] == pytest.approx(0.5)


def test_returns_of_the_own_car_are_left_out(drive):
    path = drive / "velodyne_points/data/0000000000.bin"
    np.array([[-0.9, 1.1, -0.5, 0], [5, 1, 0, 0]], np.float32).tofile(path)
    np.testing.assert_allclose(kitti_reader.read_scan(path), [[5, 1, 1.73]])


@pytest.mark.parametrize("sensor", ["image_02/data/0000000004.png", "velodyne_points/data/0000000004.bin",
                                    "oxts/data/0000000004.txt"])
def test_a_missing_frame_splits_the_sequence_and_is_counted(drive, sensor):
    (drive / sensor).unlink()
    message = rf"1 of 12 frames are left out .*1 in {sensor.split('/')[0]}.* 3 gap-free"
    with pytest.warns(schema.DataWarning, match=message):
        recording = kitti_reader.KittiRecording(drive)
    pieces = [(s.split, s.start, s.length) for s in recording.sequences]
    assert pieces == [("train", 0, 4), ("train", 5, 3), ("val", 8, 4)]
    assert recording.read(recording.sequences[1], 0)["frame_id"] == 5


def test_a_jump_in_time_splits_the_sequence(drive):
    path = drive / "image_02/timestamps.txt"
    lines = path.read_text().splitlines()
    late = [line.replace("13:02:25", "13:02:35").replace("13:02:26", "13:02:36") for line in lines[5:]]
    path.write_text("\n".join(lines[:5] + late))
    with pytest.warns(schema.DataWarning, match="time jumps by more than 1.5 periods at 1 of 12 frames"):
        recording = kitti_reader.KittiRecording(drive)
    assert [(s.start, s.length) for s in recording.sequences] == [(0, 5), (5, 3), (8, 4)]


def without(drive, *sensors):
    for sensor in sensors:
        shutil.rmtree(drive / sensor)


@pytest.mark.parametrize(("absent", "modality"), [("velodyne_points", "points_m"), ("image_02", "image")])
def test_a_sensor_may_be_missing_altogether(drive, absent, modality):
    shutil.copy(drive / "image_02/timestamps.txt", drive / "velodyne_points/timestamps.txt")
    without(drive, absent)
    recording = sources.open_recording(drive)
    assert modality not in recording.description.modalities
    assert modality not in recording.read(recording.sequences[0], 0)
    assert (recording.description.lidar is None) == (absent == "velodyne_points")
    assert (recording.description.camera is None) == (absent == "image_02")
    model = fitting.adapt(config_lib.override(presets.get("tiny"), "data.stride", 1), recording).config.model
    assert (model.camera is None, model.lidar is None) == (absent == "image_02", absent == "velodyne_points")
    assert model.heads == (("range_view", "occupancy", "action") if model.camera is None else ("image", "action"))


def test_a_drive_without_image_and_scan_is_refused(drive):
    without(drive, "image_02", "velodyne_points")
    with pytest.raises(schema.DataError, match="no drive has frames of image_02"):
        kitti_reader.KittiRecording(drive)


def test_every_camera_can_be_chosen(drive):
    for number in ("00", "01", "03"):
        shutil.copytree(drive / "image_02", drive / f"image_{number}")
        for path in (drive / f"image_{number}/data").iterdir():
            Image.open(path).convert("L").save(path)  # 00 and 01 are grey
    calibration = drive.parent / "calib_cam_to_cam.txt"
    lines = calibration.read_text()
    for number, shift in (("01", -38.0), ("03", -30.0)):
        lines += f"S_rect_{number}: 128 48\nP_rect_{number}: 70 0 64 {shift} 0 70 24 0 0 0 1 0\n"
    calibration.write_text(lines)
    places = []
    for camera in kitti_reader.CAMERAS:
        recording = sources.open_recording(drive, camera=camera)
        frame = recording.read(recording.sequences[0], 3)
        assert frame["image"].shape == (48, 128, 3) and (frame["image"] == 30).all()
        places.append(float(frame["camera_to_ego"][1, 3]))
    np.testing.assert_allclose(places, [0.0, -38 / 70, 0.1, -30 / 70], atol=1e-6)  # to the left of camera 00
    with pytest.raises(schema.DataError, match="has no camera 'image_04' but image_00"):
        sources.open_recording(drive, camera="image_04")


def test_a_camera_that_was_not_unpacked_is_named(drive):
    with pytest.raises(schema.DataError, match="no drive has frames of image_03; there are image_02"):
        sources.open_recording(drive, camera="image_03")


def test_several_drives_are_one_recording(drive, tmp_path):
    second = drive.parent / "2011_09_26_drive_0100_sync"
    shutil.copytree(drive, second)
    recording = sources.open_recording(tmp_path)
    assert [(s.split, s.name, s.length) for s in recording.sequences] == [
        (split, name, length) for name in (drive.name, second.name) for split, length in (("train", 8), ("val", 4))]
    without(second, "velodyne_points")
    with pytest.warns(schema.DataWarning, match=r"0100_sync.*velodyne_points.* The drive is left out"):
        recording = sources.open_recording(tmp_path)
    assert {sequence.name for sequence in recording.sequences} == {drive.name}


def break_file(name, content):
    def apply(drive):
        path = drive / name
        path.write_bytes(content(path.read_bytes()))
    return apply


def remove(name):
    def apply(drive):
        path = drive / name
        for child in path.iterdir() if path.is_dir() else ():
            child.unlink()
        path.rmdir() if path.is_dir() else path.unlink()
    return apply


def swap_lines(content):
    lines = content.splitlines()
    return b"\n".join([lines[1], lines[0], *lines[2:]])


def points(*rows):
    return lambda _: np.array(rows, np.float32).tobytes()


GOOD, BAD = (5.0, 1.0, 0.0, 0.0), (float("nan"), 1.0, 0.0, 0.0)


@pytest.mark.parametrize(("damage", "message"), [
    (remove("image_02/timestamps.txt"), "timestamps.txt is missing.*time stamps of image_02"),
    (break_file("image_02/timestamps.txt", lambda c: b"\n".join(c.splitlines()[:7])), "line 8 .*only 7 lines"),
    (break_file("image_02/timestamps.txt", lambda c: c.replace(b"2011", b"soon", 1)), "line 1 .*not like 2011-09-26"),
    (break_file("image_02/timestamps.txt", swap_lines), "timestamps.txt, line 2: .*must increase"),
    (remove("oxts/data"), "0000000000.txt is missing .*the oxts frames"),
    (remove("../calib_velo_to_cam.txt"), "calib_velo_to_cam.txt is missing.*calibration"),
    (break_file("../calib_cam_to_cam.txt", lambda c: c.replace(b"P_rect_02", b"P_rect_07")), "\"P_rect_02:\" with 12"),
    (break_file("../calib_velo_to_cam.txt", lambda c: c + b"T: 0 -0.08 -0.9\n"),
     "calib_velo_to_cam.txt: \"T:\" is there twice, as 0 -0.08 -0.3 and as 0 -0.08 -0.9"),
])
def test_a_drive_that_cannot_be_opened(drive, damage, message):
    damage(drive)
    with pytest.raises(schema.DataError, match=message):
        kitti_reader.KittiRecording(drive)


@pytest.mark.parametrize(("damage", "message"), [
    (break_file("image_02/data/0000000000.png", lambda c: c[:len(c) // 2]), "0.png: not a readable image.*copy it"),
    (break_file("image_02/data/0000000000.png", lambda c: b""), "0000000000.png: not a readable image"),
    (break_file("velodyne_points/data/0000000000.bin", lambda c: c[:-3]), r"3197 bytes; .*multiple of 16"),
    (break_file("velodyne_points/data/0000000000.bin", lambda c: b""), r"0 bytes; .*multiple of 16"),
    (break_file("velodyne_points/data/0000000000.bin", points(GOOD, BAD)), "1 of 2 points are NaN"),
    (break_file("velodyne_points/data/0000000000.bin", lambda c: c[:1600] + bytes(1600)),
     "0000000000.bin: 100 of 200 points are 0 in all their numbers: .* in part"),
    (break_file("oxts/data/0000000000.txt", lambda c: b"1 2 3"), "0000000000.txt: 3 values, expected 30"),
    (break_file("oxts/data/0000000000.txt", lambda c: b"3 " + c), "0000000000.txt: 31 values, expected 30"),
    (break_file("oxts/data/0000000000.txt", lambda c: c + b"\n" + c), "0000000000.txt: 60 values, expected 30"),
    (break_file("oxts/data/0000000000.txt", lambda c: b"north"), "0000000000.txt: not a line of numbers"),
    (break_file("../calib_cam_to_cam.txt", lambda c: c.replace(b"1.280000e+02", b"6.4e+01")), "128x48 pixels.*64x48"),
])
def test_a_frame_that_cannot_be_read(drive, damage, message):
    damage(drive)
    recording = kitti_reader.KittiRecording(drive)
    with pytest.raises(schema.DataError, match=message):
        recording.read(recording.sequences[0], 0)


def test_a_few_nan_points_are_dropped_and_counted(drive):
    path = drive / "velodyne_points/data/0000000000.bin"
    path.write_bytes(points(*[GOOD] * 199, BAD)(None))
    with pytest.warns(schema.DataWarning, match="0000000000.bin: 1 of 200 points"):
        assert kitti_reader.read_scan(path).shape == (199, 3)


@pytest.mark.skipif(samples.KITTI is None, reason="no real KITTI drive here; name one by MUVO_KITTI=FOLDER")
def test_a_real_drive():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = sources.open_recording(samples.KITTI)
    config, _ = fitting.adapt(presets.get("town"), recording)
    frame = prepare.prepare_frame(recording.read(recording.sequences[0], 0), config)
    camera_position_m = np.array(recording.description.camera.camera_to_ego)[:3, 3]
    np.testing.assert_allclose(camera_position_m, [0.27, 0.06, 1.65], atol=0.03)  # KITTI's own drawing of the car
    points_m = frame["range_view"][frame["range_view"][..., 3] > 0][:, :3]
    assert len(points_m) > 0.5 * frame["range_view"][..., 3].size
    near = (np.abs(points_m[:, 1]) < 1.5) & (np.abs(points_m[:, 0]) < 12)
    assert abs(np.median(points_m[near, 2])) < 0.15  # the road is at height 0
    uv_px, depth_m = camera_ops.project_to_image(points_m, frame["intrinsics"], frame["camera_to_ego"])
    ahead = (depth_m > 7) & (np.abs(points_m[:, 1]) < 1.0) & (np.abs(points_m[:, 2]) < 0.3)
    inside = (uv_px[ahead] > 0) & (uv_px[ahead] < [256, 64])
    assert inside.mean() > 0.95


@pytest.mark.slow
@pytest.mark.skipif(samples.KITTI is None, reason="no real KITTI drive here; name one by MUVO_KITTI=FOLDER")
def test_a_real_drive_is_judged_by_the_card_of_4d_occ():
    """What is moved with the car forecasts scans better than what stands still, along rays and inside the box."""
    recording = sources.open_recording(samples.KITTI)
    card = cards.load("kitti-4docc-1s")
    config = card.applied(presets.town(), {"evaluation.windows": 1})
    config = fitting.adapt(config, recording, keep=tuple(card.settings), splits=("train",)).config
    assert not card.foreign(config, recording.description.kind)
    report = protocol.evaluate(None, None, validation.windows(pipeline.Frames(recording, config), "train", 1), config,
                               sources=("copy_last", "warp_last"))
    imagined = cards.defined(card, report)["imagined"]
    assert imagined["copy_last"].keys() == card.metrics.keys()
    for name in ("scan_chamfer_near_m2", "scan_l1_m"):
        assert 0 < imagined["warp_last"][name]["mean"] < imagined["copy_last"][name]["mean"]
    steps = imagined["copy_last"]["scan_l1_m"]
    assert steps["to_step"] == pytest.approx(np.cumsum(steps["per_step"]) / np.arange(1, 6))
