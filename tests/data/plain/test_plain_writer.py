import csv
import math
import tomllib

import numpy as np
import pytest
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.data import files, pictures, schema, sources
from muvo_jax.data.plain import writer as plain_writer
from muvo_jax.ops import camera as camera_ops

GRID = config_lib.VoxelGrid(shape=(4, 5, 6), voxel_size_m=1.0, origin_m=(-2.0, -2.5, -1.0))
LIDAR = config_lib.RangeViewGeometry(rows=4, columns=8)
CONTRACT = config_lib.ActionContract(accel_full_mps2=2.5)


def describe(root, **changes):
    intrinsics = camera_ops.intrinsics_from_fov(12, 8, math.radians(90))
    pose = camera_ops.level_camera_to_ego((1.0, 0.0, 2.0))
    camera = schema.Camera(12, 8, tuple(map(tuple, intrinsics.tolist())), tuple(map(tuple, pose.tolist())))
    settings = {"name": 'a "test"', "rate_hz": 10.0, "splits": ("train", "val_rl"), "contract": CONTRACT,
                "camera": camera, "lidar": LIDAR, "voxels": GRID, **changes}
    return plain_writer.write_description(root, **settings)


def make_frame(index, rng):
    depth_m = rng.uniform(1, 90, (8, 12)).astype(np.float32)
    depth_m[0] = np.inf
    return {"frame_id": index, "timestamp_s": index / 10, "x_m": 0.1 * index, "y_m": -1.0, "yaw_rad": 0.25,
            "speed_mps": np.float32(7.1), "acceleration": np.float32(-0.3), "steering": 0.123456789, "reward": 0.5,
            "is_terminal": index == 4, "weather": "clear_noon",
            "image": rng.integers(0, 255, (8, 12, 3), np.uint8), "depth_m": depth_m,
            "classes": rng.integers(0, 9, (8, 12), np.uint8), "route_map": rng.integers(0, 255, (64, 64), np.uint8),
            "points_m": rng.normal(0, 9, (20 + index, 3)).astype(np.float32),
            "occupancy": rng.choice(np.array([0, 1, 255], np.uint8), GRID.shape)}


def record(root, split="train", run="000", count=5, seed=0):
    rng = np.random.default_rng(seed)
    frames = [make_frame(index, rng) for index in range(count)]
    writer = plain_writer.RunWriter(root, split, run)
    for frame in frames:
        writer.write(frame)
    writer.close()
    return frames


def test_what_is_read_back_equals_what_was_written(tmp_path):
    describe(tmp_path)
    written = record(tmp_path)
    recording = sources.open_recording(tmp_path)
    description = recording.description
    assert description.name == 'a "test"' and description.splits == ("train", "val_rl")
    assert (description.contract, description.lidar, description.voxels) == (CONTRACT, LIDAR, GRID)
    (sequence,) = recording.sequences
    assert (sequence.split, sequence.length) == ("train", 5)
    for index, frame in enumerate(written):
        read = recording.read(sequence, index)
        for name in ("image", "points_m", "occupancy", "route_map", "speed_mps", "reward", "is_terminal", "frame_id"):
            np.testing.assert_array_equal(read[name], frame[name], err_msg=name)
        np.testing.assert_allclose(read["action"], [frame["acceleration"], frame["steering"]])
        assert read["timestamp_s"] == frame["timestamp_s"]


def test_depth_and_classes_are_kept_beside_the_image(tmp_path):
    (frame,) = record(tmp_path, count=1)
    with Image.open(tmp_path / "train/000/depth/000000.png") as image:
        depth_m = pictures.decode_depth(np.asarray(image))
    assert np.isinf(depth_m[0]).all()
    np.testing.assert_allclose(depth_m[1:], frame["depth_m"][1:], atol=0.00501)
    with Image.open(tmp_path / "train/000/classes/000000.png") as image:
        np.testing.assert_array_equal(np.asarray(image), frame["classes"])


def test_depth_code():
    """12.34 m is 1234; the largest code is the sky, and so is everything from 655.35 m on."""
    depth_m = np.array([0.0, 12.34, 655.34, 655.35, 1e9, np.inf, np.nan])
    assert plain_writer.encode_depth(depth_m).tolist() == [0, 1234, 65534, 65535, 65535, 65535, 65535]


def test_frames_csv_has_the_agreed_columns(tmp_path):
    record(tmp_path, count=2)
    with (tmp_path / "train/000/frames.csv").open() as file:
        header, first, _ = csv.reader(file)
    assert header == ["frame_id", "timestamp_s", "x_m", "y_m", "yaw_rad", "speed_mps", "acceleration", "steering",
                      "reward", "is_terminal", "weather"]
    assert first == ["0", "0.0", "0.0", "-1.0", "0.25", "7.1", "-0.3", "0.123456789", "0.5", "false", "clear_noon"]


def test_an_unfinished_run_is_ignored_and_recorded_again(tmp_path):
    describe(tmp_path)
    record(tmp_path, run="000")
    writer = plain_writer.RunWriter(tmp_path, "train", "001")
    writer.write(make_frame(0, np.random.default_rng(1)))  # and then the power fails
    writer.write(make_frame(1, np.random.default_rng(1)))
    assert plain_writer.is_complete(tmp_path, "train", "000") and not plain_writer.is_complete(tmp_path, "train", "001")
    with pytest.warns(schema.DataWarning, match="1 of 2 runs have no frames.csv"):
        assert len(sources.open_recording(tmp_path).sequences) == 1

    record(tmp_path, run="001", count=1)
    assert sorted(path.name for path in (tmp_path / "train/001/image").iterdir()) == ["000000.png"]
    assert len(sources.open_recording(tmp_path).sequences) == 2


def test_a_complete_run_is_not_overwritten(tmp_path):
    record(tmp_path)
    with pytest.raises(FileExistsError, match="recorded already"):
        plain_writer.RunWriter(tmp_path, "train", "000")


def test_descriptions_of_other_settings_are_refused(tmp_path):
    path = describe(tmp_path)
    assert describe(tmp_path) == path
    with pytest.raises(FileExistsError, match="describes another recording"):
        describe(tmp_path, rate_hz=5.0)


def test_frames_must_come_in_order(tmp_path):
    writer = plain_writer.RunWriter(tmp_path, "train", "000")
    rng = np.random.default_rng(0)
    writer.write(make_frame(3, rng))
    with pytest.raises(ValueError, match="frame_id 3 after 3"):
        writer.write(make_frame(3, rng))


def test_modalities_that_a_source_lacks_leave_no_trace(tmp_path):
    describe(tmp_path, camera=None, voxels=None)
    writer = plain_writer.RunWriter(tmp_path, "train", "000")
    frame = make_frame(0, np.random.default_rng(0))
    writer.write({name: frame[name] for name in ("frame_id", "timestamp_s", "speed_mps", "acceleration", "steering",
                                                 "points_m")})
    writer.close()
    assert sorted(path.name for path in (tmp_path / "train/000").iterdir()) == ["frames.csv", "lidar"]
    recording = sources.open_recording(tmp_path)
    assert recording.description.camera is None and recording.description.voxels is None
    assert "reward" not in recording.description.modalities


def test_equal_frames_give_equal_bytes(tmp_path):
    record(tmp_path, run="000")
    record(tmp_path, run="001")
    for path in (tmp_path / "train/000").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "train/001" / path.relative_to(tmp_path / "train/000")).read_bytes()


def test_a_description_is_written_once_and_stays_as_somebody_formatted_it(tmp_path):
    values = {"text": 'quote " backslash \\ tab \t umlaut ü', "whole": np.int64(3), "real": np.float32(2.0),
              "tiny": 1e-30, "yes": np.True_, "nested": ((1.0, 2.5), (0.0, -1.0)), "names": ["a", "b"]}
    path = tmp_path / "new/recording.toml"
    files.write_description(path, values | {"table": values}, "something else")
    read = tomllib.loads(path.read_text(encoding="utf-8"))
    expected = values | {"nested": [[1.0, 2.5], [0.0, -1.0]]}
    assert read == expected | {"table": expected}
    text = "# by hand\n" + path.read_text(encoding="utf-8").replace("whole = 3", "whole  =  3")
    path.write_text(text, encoding="utf-8")
    files.write_description(path, values | {"table": values}, "something else")
    assert path.read_text(encoding="utf-8") == text
    with pytest.raises(FileExistsError, match="describes something else; choose another folder"):
        files.write_description(path, values, "something else")


@pytest.mark.parametrize(("split", "run"), [("train", ""), ("", "a"), ("val_rl", ".."), ("train", "x/y"),
                                            ("train", ".hidden"), ("train", "a\\b")])
def test_a_name_that_is_none_of_a_folder_removes_nothing(tmp_path, split, run):
    describe(tmp_path)
    record(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match="expected the name of a folder in"):
        plain_writer.RunWriter(tmp_path, split, run)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("change", "message"), [
    ({"speed_mps": None, "steering": None}, "no speed_mps, steering, which every frame"),
    ({"timestamp_s": 0.05}, r"frame 2: time 0\.05 s does not come after the frame before it \(0\.1 s\)"),
    ({"image": np.zeros((8, 16, 3), np.uint8)}, r"shape \[8, 16, 3\] of image, expected \[8, 12, 3\]"),
    ({"occupancy": np.zeros((4, 5, 5), np.uint8)}, r"shape \[4, 5, 5\] of occupancy, expected \[4, 5, 6\]"),
    ({"point_tags": np.zeros(3, np.uint8)}, "3 classes of 22 points"),
])
def test_what_a_reader_would_refuse_is_not_written(tmp_path, change, message):
    describe(tmp_path)
    rng = np.random.default_rng(0)
    writer = plain_writer.RunWriter(tmp_path, "train", "000")
    for index in range(2):
        writer.write(make_frame(index, rng))
    wrong = {name: value for name, value in (make_frame(2, rng) | change).items() if value is not None}
    with pytest.raises(schema.DataError, match=message):
        writer.write(wrong)
    writer.write(make_frame(2, rng))
    writer.close()
    assert sources.open_recording(tmp_path).sequences[0].length == 3
