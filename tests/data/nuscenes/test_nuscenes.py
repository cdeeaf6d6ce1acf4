"""The nuScenes reader on synthetic sets in its format."""

import dataclasses
import json
import pathlib
import shutil
import warnings

import numpy as np
import nuscenes_writer as writer
import pytest
import recording_writers
from PIL import Image

from muvo_jax import doctor, presets, recordings, train
from muvo_jax.data import fitting, prepare, schema, sequences, sources
from muvo_jax.data.nuscenes import reader, scans, scene_splits, tables
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import writer as plain_writer
from muvo_jax.ops import camera as camera_ops
from muvo_jax.training import screen


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    return writer.write(tmp_path_factory.mktemp("template") / "nuscenes")


@pytest.fixture
def root(template, tmp_path):
    return shutil.copytree(template, tmp_path / "nuscenes")


def opened(path, **options):
    """Without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return sources.open_recording(path, **options)


def pieces(recording):
    return [(sequence.split, sequence.name, sequence.start, sequence.length) for sequence in recording.sequences]


def times_us(recording, sequence):
    return [int(recording.read(sequence, index)["frame_id"]) for index in range(sequence.length)]


def greys(recording, sequence):
    """In which turn of the lidar each picture was taken."""
    return [round(float(recording.read(sequence, index)["image"].mean()) / 5) for index in range(sequence.length)]


def test_frames_are_every_second_scan_with_the_picture_nearest_in_time(root):
    recording = opened(root)
    assert recording.description.kind == "nuScenes" and recording.description.rate_hz == 10.0
    assert pieces(recording) == [("train", "scene-0061", 0, 21), ("val", "scene-0103", 0, 21)]
    sequence = recording.sequences[0]
    assert times_us(recording, sequence) == [writer.START_US + 100_000 * index for index in range(21)]
    assert recording.read(sequence, 1)["timestamp_s"] == (writer.START_US + 100_000) / 1e6
    # Pictures are taken in turns 0, 2, 4, 5, 7, 9, 10 ..., 35 ms before the turn of their number ends.
    assert greys(recording, sequence)[:11] == [0, 2, 5, 7, 9, 10, 12, 15, 17, 19, 20]


def test_key_frames_are_samples(root):
    recording = opened(root, key_frames=True)
    assert recording.description.rate_hz == recording.description.contract.rate_hz == 2.0
    sequence = recording.sequences[1]
    assert times_us(recording, sequence) == [writer.START_US + 500_000 * index for index in range(5)]
    assert greys(recording, sequence) == [0, 10, 20, 30, 40]


@pytest.mark.parametrize("scene", [0, 1])
def test_what_stands_still_is_seen_where_it_stands(root, scene):
    recording = opened(root)
    sequence = recording.sequences[scene]
    for index in (0, 3, 20):
        frame = recording.read(sequence, index)
        np.testing.assert_allclose(frame["pose"], writer.pose_at(int(frame["frame_id"])), rtol=0, atol=1e-6)
        x, y, yaw = frame["pose"]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        on_map = frame["points_m"].astype(float)
        on_map[:, :2] = on_map[:, :2] @ turn.T + [x, y]
        np.testing.assert_allclose(on_map, writer.landmarks(), atol=2e-5)


def test_a_picture_was_taken_where_the_car_was_then(root):
    recording = opened(root)
    described = recording.description.camera
    np.testing.assert_allclose(described.camera_to_ego, writer.sensor_to_ego("CAM_FRONT", 0), atol=1e-9)
    for index, turn in ((1, 2), (2, 5)):  # 35 ms before and 15 ms after the scan
        frame = recording.read(recording.sequences[0], index)
        taken_us = writer.START_US + turn * writer.TURN_US + writer.SHUTTER_US["CAM_FRONT"]
        map_to_camera = np.linalg.inv(writer.ego_to_map(taken_us) @ writer.sensor_to_ego("CAM_FRONT", 0))
        seen = writer.landmarks() @ map_to_camera[:3, :3].T + map_to_camera[:3, 3]
        ahead = seen[:, 2] > 2
        expected_px = writer.FOCAL * seen[ahead, :2] / seen[ahead, 2:] + [writer.WIDTH / 2, writer.HEIGHT / 2]
        uv_px, depth_m = camera_ops.project_to_image(frame["points_m"], frame["intrinsics"], frame["camera_to_ego"])
        np.testing.assert_allclose(uv_px[ahead], expected_px, atol=0.02)
        np.testing.assert_allclose(depth_m[ahead], seen[ahead, 2], atol=1e-3)


def test_a_picture_at_the_pose_of_its_scan_has_the_calibration_exactly(root):
    def one_pose(rows):
        by_time = {row["timestamp"]: row["ego_pose_token"] for row in rows if "LIDAR_TOP" in row["filename"]}
        for row in rows:
            if "CAM_FRONT" in row["filename"]:
                row["timestamp"] -= writer.SHUTTER_US["CAM_FRONT"]
                row["ego_pose_token"] = by_time[row["timestamp"]]
    writer.change(root, "sample_data", one_pose)
    recording = opened(root, key_frames=True)
    for sequence, scene in zip(recording.sequences, (0, 1), strict=True):
        frame = recording.read(sequence, 2)
        np.testing.assert_array_equal(frame["camera_to_ego"],
                                      writer.sensor_to_ego("CAM_FRONT", scene).astype(np.float32))
        assert frame["intrinsics"][0, 0] == writer.FOCAL + scene


def test_actions_are_derived_from_the_poses(root):
    recording = opened(root)
    contract = recording.description.contract
    assert (contract.source, contract.kinematics, contract.wheelbase_m) == ("derived", "bicycle", 2.588)
    sequence = recording.sequences[0]
    for index in (1, 10, 18):
        frame = recording.read(sequence, index)
        speed_mps = writer.SPEED_MPS + 0.1 * index * writer.ACCELERATION_MPS2
        assert frame["speed_mps"] == pytest.approx(speed_mps, abs=2e-3)
        assert frame["yaw_rate_radps"] == pytest.approx(writer.YAW_RATE_RADPS, abs=1e-6)
        steering_rad = -np.arctan(2.588 * writer.YAW_RATE_RADPS / speed_mps)  # to the left
        np.testing.assert_allclose(frame["action"], [1.5 / 3.0, steering_rad / 0.6], atol=1e-3)
        np.testing.assert_array_equal(recording.action(sequence, index), frame["action"])


def test_the_lidar_is_an_hdl_32e_on_this_roof(root):
    lidar = opened(root).description.lidar
    assert (lidar.rows, lidar.position_m) == (32, (0.94, 0.0, 1.84))
    row_rad = (lidar.elevation_max_rad - lidar.elevation_min_rad) / 32
    lowest, highest = lidar.elevation_min_rad + 0.5 * row_rad, lidar.elevation_max_rad - 0.5 * row_rad
    np.testing.assert_allclose(np.rad2deg([lowest, highest]), [-30.67, 10.67], atol=0.01)


def test_every_camera_can_be_chosen(root):
    recording = opened(root, camera="CAM_BACK")
    np.testing.assert_allclose(recording.description.camera.camera_to_ego, writer.sensor_to_ego("CAM_BACK", 0),
                               atol=1e-9)
    assert greys(recording, recording.sequences[0])[:6] == [0, 2, 4, 7, 9, 10]  # 10 ms before the end of their turns
    with pytest.raises(schema.DataError, match="has no camera 'CAM_TOP' but CAM_FRONT"):
        sources.open_recording(root, camera="CAM_TOP")
    with pytest.raises(schema.DataError, match=r"sensor.json: there is no sensor CAM_FRONT_LEFT; there are CAM_BACK, "):
        sources.open_recording(root, camera="CAM_FRONT_LEFT")


def test_only_nuscenes_has_key_frames(tmp_path):
    plain = recording_writers.write_plain(tmp_path / "plain")
    with pytest.raises(schema.DataError, match="kind plain has no key frames; leave --key-frames out"):
        sources.open_recording(plain, key_frames=True)


def test_official_splits():
    mini, full = (scene_splits.OF_VERSION[version] for version in ("v1.0-mini", "v1.0-trainval"))
    assert [len(splits[name]) for splits in (mini, full) for name in ("train", "val")] == [8, 2, 700, 150]
    assert not full["train"] & full["val"]
    assert scene_splits.of("v1.0-mini")["scene-0553"] == "train" and "scene-0553" in full["val"]


def test_the_path_may_be_the_root_or_the_tables_and_must_say_which(tmp_path, monkeypatch):
    root = writer.write(tmp_path, scenes=("scene-0061", "scene-0553"))
    expected = pieces(opened(root))
    assert [split for split, *_ in expected] == ["train", "train"]
    assert pieces(opened(root / "v1.0-mini")) == expected
    monkeypatch.chdir(root / "v1.0-mini")
    assert pieces(opened(".")) == expected
    shutil.copytree(root / "v1.0-mini", root / "v1.0-trainval")
    with pytest.raises(schema.DataError, match=r"tables of v1.0-mini, v1.0-trainval: give the one that is meant"):
        sources.open_recording(root)
    assert [split for split, *_ in pieces(opened(root / "v1.0-trainval"))] == ["train", "val"]


def test_scenes_of_no_split_are_left_out_and_counted(tmp_path):
    root = writer.write(tmp_path, scenes=("scene-0061", "scene-0077", "scene-0103"))
    with pytest.warns(schema.DataWarning, match="v1.0-mini: 1 of 3 scenes are in neither of the official splits"):
        recording = sources.open_recording(root)
    assert [name for _, name, _, _ in pieces(recording)] == ["scene-0061", "scene-0103"]
    writer.change(root, "scene", lambda rows: [row | {"name": f"mine-{row['name']}"} for row in rows])
    with pytest.raises(schema.DataError, match=r"none of its 3 scenes .mine-scene-0061, .* is in the official splits"):
        sources.open_recording(root)


def remove_files(root, *patterns):
    for path in [path for pattern in patterns for path in root.glob(pattern)]:
        path.unlink()


def test_scenes_whose_archives_are_not_here_are_left_out_and_counted(root):
    remove_files(root, "s*/*/n000__*")  # all of scene-0061
    with pytest.warns(sequences.GapWarning, match="1 of 2 scenes have no files of CAM_FRONT or LIDAR_TOP here"):
        recording = sources.open_recording(root)
    assert pieces(recording) == [("val", "scene-0103", 0, 21)] and recording.description.splits == ("val",)
    remove_files(root, "s*/*/n001__*")
    with pytest.raises(schema.DataError, match=r"none of 2 scenes .* has files of CAM_FRONT or LIDAR_TOP\. The folder"):
        sources.open_recording(root)


def test_an_archive_of_key_frames_alone_is_said_to_be_one(root):
    shutil.rmtree(root / "sweeps")
    with pytest.raises(schema.DataError, match=r"if they are of key frames, read these alone .--key-frames"):
        sources.open_recording(root)
    assert len(pieces(opened(root, key_frames=True))) == 2


@pytest.mark.parametrize(("sensor", "modality"), [("LIDAR_TOP", "points_m"), ("CAM_*", "image")])
def test_a_sensor_may_be_missing_altogether(root, sensor, modality):
    for folder in root.glob(f"s*/{sensor}"):
        shutil.rmtree(folder)
    recording = opened(root)
    assert modality not in recording.description.modalities | recording.read(recording.sequences[0], 4).keys()
    assert [recording.description.lidar is None, recording.description.camera is None] == [modality == "points_m",
                                                                                             modality == "image"]
    model = fitting.adapt(presets.get("tiny"), recording).config.model
    assert (model.camera is None, model.lidar is None) == (modality == "image", modality == "points_m")


def test_a_camera_that_was_not_unpacked_is_named(root):
    for folder in root.glob("s*/CAM_FRONT"):
        shutil.rmtree(folder)
    with pytest.raises(schema.DataError, match="no scene has files of CAM_FRONT; there are folders of CAM_BACK"):
        sources.open_recording(root)


def test_a_scene_without_scans_is_passed_by_where_they_are_needed(tmp_path):
    root = writer.write(tmp_path, scenes=("scene-0061", "scene-0103", "scene-0553"))
    remove_files(root, "s*/LIDAR_TOP/n001__*")
    with pytest.warns(schema.DataWarning, match=r"points_m is missing in 1 of 3 runs .scene-0103"):
        recording = sources.open_recording(root)
    assert [sequence.lacks for sequence in recording.sequences] == [(), ("points_m",), ()]
    assert "points_m" not in recording.read(recording.sequences[1], 0)


def test_missing_files_split_a_scene_and_are_counted(root):
    picture_us = writer.START_US + 9 * writer.TURN_US + writer.SHUTTER_US["CAM_FRONT"]  # of turn 9, for the scan of 8
    remove_files(root, f"s*/LIDAR_TOP/n000__*{writer.START_US + 400_000}*", f"s*/CAM_FRONT/n000__*{picture_us}*")
    with pytest.warns(sequences.GapWarning, match=r"1 of 21 frames .*1 in image, 1 in points_m.* 2 gap-free"):
        recording = sources.open_recording(root)
    assert pieces(recording)[:2] == [("train", "scene-0061", 0, 4), ("train", "scene-0061", 5, 16)]
    frame = recording.read(recording.sequences[1], 0)
    assert frame["frame_id"] == writer.START_US + 500_000


def test_a_time_without_scans_splits_a_scene(root):
    gap = range(writer.START_US + 500_000, writer.START_US + 800_000)
    writer.change(root, "sample_data", lambda rows: [row for row in rows if row["timestamp"] not in gap])
    with pytest.warns(schema.DataWarning, match="scene-0103: time jumps by more than 1.5 periods at 1 of 18 frames"):
        recording = sources.open_recording(root)
    assert pieces(recording)[0] == ("train", "scene-0061", 0, 5)


@pytest.mark.parametrize("name", tables.NAMES)
def test_a_missing_table_is_named(root, name):
    (root / f"v1.0-mini/{name}.json").unlink()
    with pytest.raises(schema.DataError, match=rf"v1.0-mini/{name}.json is missing; expected a table of nuScenes"):
        sources.open_recording(root)


def in_first(**changes):
    def alter(rows):
        rows[0] |= changes
    return alter


def in_row(channel, **changes):
    """In every row of a sensor."""
    def alter(rows):
        for row in rows:
            if channel in row.get("filename", "") or row.get("sensor_token") == writer.token(channel):
                row |= changes
    return alter


@pytest.mark.parametrize(("table", "alter", "message"), [
    ("scene", lambda rows: [row | {"name": "scene-0061"} for row in rows],
     rf"scene.json: rows {writer.token('scene', 'scene-0061')} and {writer.token('scene', 'scene-0103')} are both na"),
    ("scene", in_first(name=7), r"scene.json: row .* has name = '7' .int., expected str"),
    ("sample_data", in_row("LIDAR_TOP", timestamp=1.5e9), r"sample_data.json: row .* has timestamp = .*expected int"),
    ("sample_data", in_row("CAM_FRONT", timestamp=-1), "sample_data.json: row .* timestamp -1, expected microseconds"),
    ("sample_data", in_row("LIDAR_TOP", filename="../../etc/passwd"), "'../../etc/passwd', expected a path below"),
    ("sample_data", in_row("LIDAR_TOP", filename="/etc/passwd"), "'/etc/passwd', expected a path below"),
    ("sample_data", in_row("CAM_FRONT", width=-5), "has width = -5, expected pixels"),
    ("sample_data", in_row("LIDAR_TOP", timestamp=writer.START_US), "scene-0061: two scans have one timestamp"),
    ("sample_data", lambda rows: [row | {"timestamp": row["timestamp"] // 1000} for row in rows],
     "scans are 5e-05 s apart, which must be at least 0.01 .* must be microseconds"),
    ("ego_pose", lambda rows: rows[:-60], r"ego_pose.json: \d+ of \d+ poses that sample_data.json names are missing"),
    ("ego_pose", in_first(rotation=[1, 1, 0, 0]), r"ego_pose.json: row .*\[1.0, 1.0, 0.0, 0.0\], expected a unit quat"),
    ("ego_pose", in_first(translation=[1, 2]), r"ego_pose.json: row .* translation = \[1, 2\], expected 3 numbers"),
    ("ego_pose", in_first(translation=[1, float("nan"), 0]), r"translation = \[1, nan, 0\], expected 3 numbers"),
    ("ego_pose", lambda rows: [row | {"translation": [50 * value for value in row["translation"]]} for row in rows],
     "scene-0061, from ego_pose.json: speed_mps has"),
    ("calibrated_sensor", in_row("LIDAR_TOP", translation=[940.0, 0.0, 1840.0]), "puts LIDAR_TOP at .940"),
    ("calibrated_sensor", in_row("CAM_FRONT", camera_intrinsic=[]), "scene-0061: CAM_FRONT has no camera_intrinsic"),
    ("calibrated_sensor", in_row("CAM_FRONT", camera_intrinsic=[[1, 0, 0]]), "1 rows of camera_intrinsic, expected 3"),
    ("calibrated_sensor", in_row("CAM_FRONT", camera_intrinsic=[[0.02, 0, 32], [0, 50, 18], [0, 0, 1]]),
     "make no camera: .*fx = 0.02"),
    ("sensor", lambda rows: [row for row in rows if row["channel"] != "LIDAR_TOP"], "no sensor LIDAR_TOP; there are"),
])
def test_tables_with_what_cannot_be_are_refused_by_row(root, table, alter, message):
    writer.change(root, table, alter)
    with pytest.raises(schema.DataError, match=message):
        sources.open_recording(root)


@pytest.mark.parametrize(("damage", "message"), [
    (lambda text: text[:len(text) // 2], r"sample_data.json: row \d+ is not readable"),
    (lambda text: text[:-1], r"sample_data.json: row \d+ is not readable"),
    (lambda text: "", "row 1 is not readable .the file does not begin with"),
    (lambda text: text[1:], "row 1 is not readable .the file does not begin with"),
    (lambda text: text.replace("{", "[7", 1), "row 1 is not readable"),
    (lambda text: "[" * 100_000, "row 1 is not readable"),
    (lambda text: "[3]", "row 1 is not readable .found '3' instead of an object"),
    (lambda text: text + text, r"row \d+ is not readable .the list ends before '\["),
    (lambda text: text + "\n" * 3_000_000 + '"CAM_', r"row \d+ is not readable .the list ends before '\"CAM_'"),
    (lambda text: text.encode("utf-16"), "row 1 is not readable"),
])
def test_a_damaged_table_is_refused(root, damage, message):
    path = root / "v1.0-mini/sample_data.json"
    content = damage(path.read_text())
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(schema.DataError, match=message):
        sources.open_recording(root)


@pytest.mark.parametrize("chunk", [1, 2, 7, 1000])
def test_tables_are_read_whatever_chunks_they_fall_into(tmp_path, monkeypatch, chunk):
    rows = [{"a": [1, 2.5, -3e-7], "b": "}], {\"\\u00e4\u00e4"}, {}, {"c": {"d": None}}]
    path = tmp_path / "scene.json"
    monkeypatch.setattr(tables, "_CHUNK_CHARS", chunk)
    for text in (json.dumps(rows), json.dumps(rows, indent=4), "\n\n" + json.dumps(rows, ensure_ascii=False) + "\n"):
        path.write_text("\ufeff" + text if chunk > 2 else text, encoding="utf-8")
        assert list(tables.rows(path)) == rows
    path.write_text("[]")
    assert list(tables.rows(path)) == []
    path.write_text("[] ]")
    with pytest.raises(schema.DataError, match=r"row 1 is not readable .the list ends before '\]'"):
        list(tables.rows(path))


def test_a_row_without_end_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_LONGEST_ROW_CHARS", 1 << 12)
    monkeypatch.setattr(tables, "_CHUNK_CHARS", 1 << 10)
    path = tmp_path / "scene.json"
    path.write_text('[{"token": "' + "x" * 100_000 + '"}]')
    with pytest.raises(schema.DataError, match=r"scene.json: row 1 is not readable"):
        list(tables.rows(path))


def test_returns_of_the_own_car_are_left_out(root):
    path = next((root / "samples/LIDAR_TOP").iterdir())
    # The lidar looks along y: 1 m ahead of it is the bonnet, 5 m ahead the road.
    np.array([[0, 1, -1, 9, 3], [0, 5, -1.84, 9, 3]], np.float32).tofile(path)
    np.testing.assert_allclose(scans.read_scan(path, writer.sensor_to_ego("LIDAR_TOP", 0)), [[5.94, 0, 0]], atol=1e-6)


def test_what_does_not_return_lies_at_the_lidar_and_is_left_out(root):
    """Such rows have the number of their beam, so that only those of beam 0 are zeros throughout."""
    path = next((root / "samples/LIDAR_TOP").iterdir())
    rows = np.zeros((64, 5), np.float32)
    rows[:, 4] = np.arange(64) % 32
    rows[16:, 1] = 5.0
    rows.tofile(path)
    assert len(scans.read_scan(path, writer.sensor_to_ego("LIDAR_TOP", 0))) == 48


@pytest.mark.parametrize(("rows", "message"), [
    (np.zeros((3, 4), np.float32), r"48 bytes; a scan of nuScenes is a positive multiple of 20"),
    (np.zeros((0, 5), np.float32), "0 bytes; a scan of nuScenes"),
    (np.array([[5, 1, 0, 3, 0.5]], np.float32), "its beams reach from 0.5 to 0.5, expected whole numbers from 0 to 31"),
    (np.array([[5, 1, 0, 3, 64]], np.float32), "its beams reach from 64 to 64"),
    (np.array([[5, 1, 0, -1, 3]], np.float32), "its intensities reach from -1 to -1, expected 0 to 255"),
    (np.array([[5, np.nan, 0, 9, 3]], np.float32), "1 of 1 points are NaN"),
    (np.repeat(np.array([[5, 1, 0, 9, 3], [0] * 5], np.float32), (60, 4), axis=0),
     "4 of 64 points are 0 in all their numbers: .* in part"),
    (np.array([[5e6, 0, 0, 9, 3]], np.float32), "points_m has 1 of 3 values such as 5000000"),
])
def test_a_scan_that_is_none_is_refused(root, rows, message):
    recording = opened(root)
    path = root / f"samples/LIDAR_TOP/n000__LIDAR_TOP__{writer.START_US}.pcd.bin"
    rows.tofile(path)
    with pytest.raises(schema.DataError, match=f"{path.name}: {message}"):
        recording.read(recording.sequences[0], 0)


def test_a_scan_that_may_not_be_read_is_refused_by_name(root, monkeypatch):
    recording = opened(root)
    path = root / f"samples/LIDAR_TOP/n000__LIDAR_TOP__{writer.START_US}.pcd.bin"

    def refuse(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(pathlib.Path, "read_bytes", refuse)
    with pytest.raises(schema.DataError, match=f"{path.name}: expected a scan of LIDAR_TOP, but it cannot be read"):
        recording.read_fields(recording.sequences[0], 0, {"points_m"})


def test_a_picture_of_another_size_is_refused(root):
    recording = opened(root)
    path = root / f"samples/CAM_FRONT/n000__CAM_FRONT__{writer.START_US + writer.SHUTTER_US['CAM_FRONT']}.jpg"
    Image.new("RGB", (32, 18)).save(path)
    with pytest.raises(schema.DataError, match=r"32x18 pixels, but sample_data.json says 64x36"):
        recording.read(recording.sequences[0], 0)


def test_packs_hold_the_same_frames_and_follow_what_is_corrected(root, tmp_path):
    out = tmp_path / "packed"
    pack = lambda: packed_writer.pack(root, out, key_frames=True, frames_per_shard=5, workers=1)
    pack()
    source, packed = opened(root, key_frames=True), packed_reader.PackedRecording(out)
    assert packed.description == dataclasses.replace(source.description, kind="packed nuScenes")
    assert packed.sequences == source.sequences
    for sequence in source.sequences:
        for index in range(sequence.length):
            expected, frame = source.read(sequence, index), packed.read(sequence, index)
            assert expected.keys() == frame.keys()
            for name, value in expected.items():
                np.testing.assert_array_equal(frame[name], value)
    made = {path.name: path.stat().st_mtime_ns for path in out.glob("*.arrayrecord")}
    corrected = root / f"samples/LIDAR_TOP/n001__LIDAR_TOP__{writer.START_US}.pcd.bin"  # of the second scene
    np.array([[0, 5, -1.84, 9, 3]], np.float32).tofile(corrected)
    remove_files(root, "sweeps/*/*")  # no frame is made of these
    pack()
    again = {path.name: path.stat().st_mtime_ns for path in out.glob("*.arrayrecord")}
    assert [again[name] == made[name] for name in sorted(made)] == [True, False]
    assert len(packed_reader.PackedRecording(out).read(source.sequences[1], 0)["points_m"]) == 1


def test_a_plain_copy_has_the_camera_of_each_frame_and_scene(root, tmp_path):
    source = opened(root, key_frames=True)
    described = source.description
    plain_writer.write_description(tmp_path / "copy", name="copy", rate_hz=described.rate_hz, splits=described.splits,
                                   camera=described.camera, lidar=described.lidar, contract=described.contract)
    for sequence in source.sequences:
        run = plain_writer.RunWriter(tmp_path / "copy", sequence.split, sequence.name)
        for index in range(sequence.length):
            run.write(source.read(sequence, index))
        run.close()
    copy = opened(tmp_path / "copy")
    assert copy.description == dataclasses.replace(described, name="copy", kind="plain", notes=())
    for ours, theirs in zip(copy.sequences, source.sequences, strict=True):
        for index in range(theirs.length):
            expected, frame = source.read(theirs, index), copy.read(ours, index)
            assert expected.keys() == frame.keys()
            for name, value in expected.items():
                np.testing.assert_array_equal(frame[name], value, err_msg=name)
    first, second = (copy.read(sequence, 1) for sequence in copy.sequences)
    assert first["intrinsics"][0, 0] + 1 == second["intrinsics"][0, 0]  # of the cars of the two scenes
    assert first["camera_to_ego"][0, 3] != np.float32(described.camera.camera_to_ego[0][3])


def test_the_doctor_takes_missing_archives_for_no_fault(tmp_path, capsys):
    root = writer.write(tmp_path / "set", scenes=("scene-0061", "scene-0553", "scene-0103"))
    remove_files(root, "s*/*/n001__*")
    options = doctor.Options(root, out=tmp_path / "out", frames=60, workers=1)
    result = doctor.examine(options, screen.Screen())
    said = [finding.text for finding in result.findings if finding.level == "problem"]
    assert said == [text for text in said if "of one colour" in text], said  # the writer's pictures are
    assert any("1 of 3 scenes have no files" in finding.text for finding in result.findings)


def test_frames_are_what_a_model_eats(root):
    recording = opened(root)
    config, _ = fitting.adapt(presets.get("tiny"), recording)
    frame = prepare.prepare_frame(recording.read(recording.sequences[0], 3), config)
    assert frame["image"].shape == (*config.model.image_size, 3)
    assert (frame["range_view"][..., 3] > 0).sum() > 50
    assert {0, 1, 255} == set(np.unique(frame["occupancy"]))


def test_every_row_of_the_town_presets_range_view_is_one_beam(root):
    """Points in the middle of the lidar's 32 beams, all around: each lies in a row of its own, and none is empty."""
    recording = opened(root)
    elevations_rad = np.radians(np.linspace(-92 / 3, 32 / 3, 32))
    azimuths_rad = np.radians(np.arange(0.0, 360.0))
    elevation_rad, azimuth_rad = (values.ravel() for values in np.meshgrid(elevations_rad, azimuths_rad, indexing="ij"))
    flat_m = 9.0 * np.cos(elevation_rad)
    points = np.stack([flat_m * np.cos(azimuth_rad), flat_m * np.sin(azimuth_rad), 9.0 * np.sin(elevation_rad),
                       np.full(len(flat_m), 17.0), np.repeat(np.arange(32), len(azimuths_rad))], axis=1)
    points.astype(np.float32).tofile(root / f"samples/LIDAR_TOP/n000__LIDAR_TOP__{writer.START_US}.pcd.bin")
    config, notes = fitting.adapt(presets.get("town"), recording)
    assert config.model.range_view.rows == 32
    assert "range views have 32 rows instead of 64: the lidar has 32, and more would be empty." in notes
    view = prepare.prepare_frame(recording.read(recording.sequences[0], 0), config)["range_view"]
    ranges_m = view[..., 3]
    assert (ranges_m > 0).mean() > 0.9 and (ranges_m > 0).any(axis=1).all()
    seen_rad = np.arcsin((view[..., 2] - 1.84) / np.where(ranges_m > 0, ranges_m, np.nan))
    np.testing.assert_allclose(np.nanmean(seen_rad, axis=1), elevations_rad[::-1], atol=1e-3)


def test_a_folder_in_another_case_is_named(root):
    (root / "samples").rename(root / "Samples")
    with pytest.raises(schema.DataError, match=r"Samples: expected the name samples\. Rename the folder"):
        sources.open_recording(root)


def test_a_scene_is_made_of_its_own_files_and_the_tables(root):
    listed = reader.NuScenesRecording(root).run_files("scene-0103")
    assert len(set(listed)) == len(tables.NAMES) + 21 + 21 and all(path.is_file() for path in listed)
    assert all(path.parent.name == "v1.0-mini" or path.name.startswith("n001__") for path in listed)


def test_train_takes_camera_and_key_frames(root):
    config, *_ = train.configure(train.Options(preset="tiny", data=str(root), data_camera="CAM_BACK", key_frames=True))
    described = recordings.open_configured(config).description
    assert described.rate_hz == 2.0 and described.camera.camera_to_ego[0][3] == pytest.approx(0.05)  # the back one's
    config, *_ = train.configure(train.Options(preset="tiny", data=str(root)))
    assert recordings.open_configured(config).description.rate_hz == 10.0
