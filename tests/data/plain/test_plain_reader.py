"""The reader of plain recordings, and the recogniser of folders."""

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax.data import schema, sources
from muvo_jax.data.plain import reader as plain_reader


def rewrite_table(root, run, change):
    path = root / run / "frames.csv"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def test_description_and_frames(tmp_path):
    recording = sources.open_recording(writers.write_plain(tmp_path / "rec"))
    description = recording.description
    assert (description.kind, description.name, description.rate_hz) == ("plain", "test", 10.0)
    assert description.splits == ("train", "val_rl")
    assert description.lidar.position_m == (0.5, 0.0, 2.0) and description.lidar.columns == 512
    assert description.voxels.shape == (16, 16, 16)
    assert description.contract.source == "recorded"
    assert {"image", "points_m", "occupancy", "route_map", "speed_mps", "reward"} <= description.modalities
    assert [(s.split, s.name, s.length) for s in recording.sequences] == [
        ("train", "train/a", 10), ("train", "train/b", 6), ("val_rl", "val_rl/c", 8)]
    frame = recording.read(recording.sequences[1], 5)
    assert (frame["image"] == 5).all() and frame["image"].shape == (32, 64, 3)
    assert (frame["route_map"] == 5).all() and (frame["points_m"] == 7).all()
    np.testing.assert_array_equal(frame["action"], np.float32([0.25, -0.5]))
    np.testing.assert_array_equal(recording.action(recording.sequences[1], 5), frame["action"])
    assert frame["speed_mps"] == 5.5 and frame["reward"] == 1.0 and bool(frame["is_terminal"])
    assert frame["frame_id"] == 5 and frame["timestamp_s"] == pytest.approx(0.5)


def test_a_run_without_table_is_left_out_with_a_warning(tmp_path):
    root = writers.write_plain(tmp_path)
    (root / "train/b/frames.csv").unlink()
    with pytest.warns(schema.DataWarning, match="1 of 2 runs have no frames.csv.* b"):
        recording = plain_reader.PlainRecording(root)
    assert [s.name for s in recording.sequences] == ["train/a", "val_rl/c"]


@pytest.mark.parametrize("file", ["image/000004.png", "lidar/000004.npz", "occupancy/000004.npz",
                                  "route_map/000004.png"])
def test_a_missing_file_splits_the_sequence(tmp_path, file):
    root = writers.write_plain(tmp_path)
    (root / "train/a" / file).unlink()
    message = f"1 of 10 frames are left out .*1 in {file.split('/')[0]}.* 2 gap-free"
    with pytest.warns(schema.DataWarning, match=message):
        recording = plain_reader.PlainRecording(root)
    assert [(s.start, s.length) for s in recording.sequences if s.name == "train/a"] == [(0, 4), (5, 5)]


def test_a_restart_and_a_missing_line_split_the_sequence(tmp_path):
    root = writers.write_plain(tmp_path)
    rewrite_table(root, "train/a", lambda lines: [*lines[:4], lines[4].replace(",0,noon", ",1,noon"), *lines[5:]])
    rewrite_table(root, "val_rl/c", lambda lines: lines[:4] + lines[5:])
    with pytest.warns(schema.DataWarning, match=r"val_rl/c: time jumps .* at 1 of 7 frames; .* 2 gap-free"):
        recording = plain_reader.PlainRecording(root)
    pieces = [(s.name, s.start, s.length) for s in recording.sequences]
    assert pieces == [("train/a", 0, 4), ("train/a", 4, 6), ("train/b", 0, 6), ("val_rl/c", 0, 3), ("val_rl/c", 3, 4)]


def test_absent_modalities_are_absent(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    for name in ("route_map", "occupancy"):
        for path in (root / "train/a" / name).iterdir():
            path.unlink()
        (root / "train/a" / name).rmdir()
    rewrite_table(root, "train/a", lambda lines: [line.replace(",1.0,", ",,") for line in lines])
    recording = plain_reader.PlainRecording(root)
    assert not {"route_map", "occupancy", "reward"} & recording.description.modalities
    assert not {"route_map", "occupancy", "reward"} & set(recording.read(recording.sequences[0], 0))


@pytest.mark.parametrize(("header", "message"), [
    ({"schema_version": "2"}, "schema_version is 2, this reader knows 1"),
    ({"rate_hz": '"fast"'}, "rate_hz is 'fast', expected a number"),
    ({"wheelbase": "3"}, r"recording.toml: voxels .*'wheelbase' is unknown"),
    ({"intrinsics": "[[1, 0], [0, 1]]"}, "camera.intrinsics: .*3 rows of 3"),
    ({"splits": '["test"]'}, "no complete run.*test.*holds recording.toml, train/"),
    ({"name": "oops"}, "recording.toml: not valid TOML"),
])
def test_a_description_that_cannot_be_used(tmp_path, header, message):
    with pytest.raises(schema.DataError, match=message):
        plain_reader.PlainRecording(writers.write_plain(tmp_path, {"train/a": 2}, **header))


def test_how_windows_are_cut_is_no_matter_of_the_recording(tmp_path):
    path = writers.write_plain(tmp_path) / "recording.toml"
    assert "step_action" not in path.read_text()
    path.write_text(path.read_text().replace("[action]\n", '[action]\nstep_action = "first"\n'))
    with pytest.raises(schema.DataError, match=r"train with --set contract\.step_action=first"):
        plain_reader.PlainRecording(tmp_path)


def test_a_missing_section_is_named(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 2})
    text = (root / "recording.toml").read_text()
    (root / "recording.toml").write_text(text[:text.index("[voxels]")])
    with pytest.raises(schema.DataError, match=r"section \[voxels\] is missing"):
        plain_reader.PlainRecording(root)


@pytest.mark.parametrize(("change", "message"), [
    (lambda lines: [line.replace("timestamp_s", "time") for line in lines], "column timestamp_s is missing"),
    (lambda lines: [*lines[:3], lines[3].replace("0.2", "fast", 1), *lines[4:]], "line 4: timestamp_s is 'fast'"),
    (lambda lines: [*lines[:3], lines[3].replace("5.5", "nan"), *lines[4:]], "line 4: speed_mps is 'nan'"),
    (lambda lines: [lines[0], lines[2], lines[1], *lines[3:]], "line 3: time 0.000 s does not come after"),
])
def test_a_table_that_cannot_be_used(tmp_path, change, message):
    root = writers.write_plain(tmp_path)
    rewrite_table(root, "train/a", change)
    with pytest.raises(schema.DataError, match=f"frames.csv.*{message}"):
        plain_reader.PlainRecording(root)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-20])


@pytest.mark.parametrize(("file", "damage", "message"), [
    ("image/000000.png", truncate, "000000.png: not a readable image"),
    ("lidar/000000.npz", truncate, "000000.npz: not a readable NPZ file"),
    ("lidar/000000.npz", lambda path: np.savez(path, xyz=np.zeros(3)), "holds xyz, expected an array 'points_m'"),
    ("lidar/000000.npz", lambda path: np.savez(path, points_m=np.full((4, 3), np.nan)), "4 of 4 points are NaN"),
    ("lidar/000000.npz", lambda path: np.savez(path, points_m=np.zeros((4, 2))), r"shape \[4, 2\]"),
    ("occupancy/000000.npz", lambda path: np.savez(path, occupancy=np.zeros((2, 2, 2))), r"shape \[2, 2, 2\].*16, 16"),
    ("image/000000.png", lambda path: path.write_bytes((path.parent.parent / "route_map/000000.png").read_bytes()),
     r"000000.png: shape \[64, 64, 3\]"),
])
def test_a_file_that_cannot_be_read(tmp_path, file, damage, message):
    root = writers.write_plain(tmp_path)
    damage(root / "train/a" / file)
    recording = plain_reader.PlainRecording(root)
    with pytest.raises(schema.DataError, match=message):
        recording.read(recording.sequences[0], 0)


def test_a_pickle_inside_an_npz_is_refused(tmp_path):
    root = writers.write_plain(tmp_path)
    np.savez(root / "train/a/lidar/000000.npz", points_m=np.array([{"a": 1}], dtype=object))
    recording = plain_reader.PlainRecording(root)
    with pytest.raises(schema.DataError, match="not a readable NPZ"):
        recording.read(recording.sequences[0], 0)


def test_folders_that_are_no_recording(tmp_path):
    with pytest.raises(schema.DataError, match=r"does not exist.*plain .*KITTI raw .*\"town\""):
        sources.open_recording(tmp_path / "nowhere")
    with pytest.raises(schema.DataError, match="is empty"):
        sources.open_recording(tmp_path)
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(schema.DataError, match=r"no known kind. Known are .*plain .*KITTI raw .*Found holiday.jpg"):
        sources.open_recording(tmp_path)
    with pytest.raises(schema.DataError, match="is a file"):
        sources.open_recording(tmp_path / "holiday.jpg")


def test_images_may_be_jpeg(tmp_path):
    root = writers.write_plain(tmp_path / "rec")
    for index, suffix in ((3, ".jpg"), (4, ".jpeg")):
        path = root / f"train/a/image/{index:06d}.png"
        Image.open(path).save(path.with_suffix(suffix), quality=95)
        path.unlink()
    recording = plain_reader.PlainRecording(root)
    assert recording.sequences[0].length == 10
    for index in (2, 3, 4):
        assert np.abs(recording.read(recording.sequences[0], index)["image"].astype(int) - index).max() <= 2
