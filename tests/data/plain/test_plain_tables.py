"""What a plain recording's tables and shared files say of each other: rows, times, classes of points, other formats."""

import warnings

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax.data import files, schema, sources
from muvo_jax.data.plain import frames_table
from muvo_jax.data.plain import reader as plain_reader


def table(root, run):
    return root / run / "frames.csv"


def tagged(root, run, frames, change=lambda frame, points, tags: (points, tags)):
    """Writes five points and their classes 0 to 4 into each scan of a run, as `change` leaves them."""
    for frame in range(frames):
        points, tags = change(frame, np.full((5, 3), np.arange(5.0)[:, None], np.float32), np.arange(5, dtype=np.uint8))
        np.savez(root / run / f"lidar/{frame:06d}.npz", points_m=points, point_tags=tags)


def test_a_point_that_is_left_out_takes_its_class_along(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    many = lambda frame, points, tags: (np.where(np.arange(500)[:, None] == 0, np.nan, np.resize(points, (500, 3))),
                                        np.resize(tags, 500))
    tagged(root, "train/a", 3, many)
    recording = sources.open_recording(root, labels=schema.LABELS)
    with pytest.warns(schema.DataWarning, match="1 of 500 points are NaN"):
        frame = recording.read(recording.sequences[0], 0)
    assert len(frame["points_m"]) == len(frame["point_classes"]) == 499
    np.testing.assert_array_equal(frame["points_m"][:, 0], frame["point_classes"])


def test_a_scan_with_classes_is_read_once(tmp_path, monkeypatch):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    tagged(root, "train/a", 3)
    recording = sources.open_recording(root, labels=schema.LABELS)
    read, read_npz = [], files.read_npz
    monkeypatch.setattr(files, "read_npz", lambda path, name: read.append(name) or read_npz(path, name))
    recording.read(recording.sequences[0], 0)
    assert sorted(read) == ["occupancy", "point_tags", "points_m"]
    recording.read_fields(recording.sequences[0], 1, {"point_classes"})
    assert sorted(read[3:]) == ["point_tags", "points_m"]


def test_as_many_classes_as_points_are_expected(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    tagged(root, "train/a", 3, lambda frame, points, tags: (points, tags[:3]))
    recording = sources.open_recording(root, labels=schema.LABELS)
    with pytest.raises(schema.DataError, match=r"000000.npz: 3 point_tags of 5 points"):
        recording.read(recording.sequences[0], 0)


@pytest.mark.parametrize("damage", [
    lambda path: path.write_bytes(path.read_bytes()[:40]),
    lambda path: np.savez(path, points_m=np.ones((5, 3), np.float32))], ids=["damaged", "without classes"])
def test_one_scan_does_not_say_what_a_run_has(tmp_path, damage):
    root = writers.write_plain(tmp_path, {"train/a": 6})
    tagged(root, "train/a", 6)
    damage(root / "train/a/lidar/000000.npz")
    recording = sources.open_recording(root, labels=schema.LABELS)
    assert "point_classes" in recording.description.modalities
    recording.read(recording.sequences[0], 3)
    with pytest.raises(schema.DataError, match=r"000000.npz"):
        recording.read(recording.sequences[0], 0)


@pytest.mark.parametrize(("rate_hz", "said"), [("7.0", "after 0.1 s, in the recording after 0.1429 s"), ("10.5", ""),
                                               ("12.0", "after 0.1 s, in the recording after 0.08333 s"), ("20.0", "")])
def test_a_run_of_another_rate_is_warned_of(tmp_path, rate_hz, said):
    root = writers.write_plain(tmp_path, {"train/a": 6}, rate_hz=rate_hz)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        sources.open_recording(root)
    rates = [str(warning.message) for warning in found if "frames follow each other" in str(warning.message)]
    assert len(rates) == bool(said) and said in "".join(rates)  # at 20 Hz every step is a gap, which is said instead


def test_half_a_table_is_not_taken_for_a_run(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 10, "train/b": 10})
    lines = table(root, "train/a").read_text().splitlines(keepends=True)
    table(root, "train/a").write_text("".join(lines[:6]))
    with pytest.warns(schema.DataWarning, match=r"train/a/frames.csv: files that come after .* \(5 in image, 5 in "):
        recording = sources.open_recording(root)
    assert [sequence.length for sequence in recording.sequences] == [5, 10]
    table(root, "train/a").write_text("".join(lines[:6]).rstrip()[:-1] + "n")
    with pytest.raises(schema.DataError, match=r"last row does not end, and files come after it .5 in image"):
        sources.open_recording(root)
    table(root, "train/a").write_text(lines[0])
    with pytest.warns(schema.DataWarning, match=r"1 of 2 runs have no frames.csv, or no row in it, .* a\."):
        sources.open_recording(root)


def test_a_table_that_an_editor_left_without_its_last_newline_is_read(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 4})
    table(root, "train/a").write_text(table(root, "train/a").read_text().rstrip())
    assert sources.open_recording(root).sequences[0].length == 4


def test_lines_are_counted_as_an_editor_does(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 4})
    lines = table(root, "train/a").read_text().splitlines()
    lines[3] = lines[3].replace("5.5", "true")
    table(root, "train/a").write_text("\n".join([lines[0], "", *lines[1:]]) + "\n")
    with pytest.raises(schema.DataError, match=r"line 5: speed_mps is 'true', expected a finite number"):
        frames_table.read(table(root, "train/a"))


def test_no_other_program_reads_a_picture(tmp_path, monkeypatch):
    root = writers.write_plain(tmp_path / "recording", {"train/a": 3})
    Image.new("RGB", (64, 32)).save(root / "train/a/image/000001.png", format="EPS")
    called = tmp_path / "called"
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {called}\necho 10.0\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    recording = sources.open_recording(root)
    with pytest.raises(schema.DataError, match=r"000001.png: not a readable image .* no PNG or JPEG"):
        recording.read(recording.sequences[0], 1)
    assert not called.exists()


def test_an_array_that_would_fill_the_memory_is_not_unpacked(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "zeros.npz", points_m=np.zeros((4000, 3), np.float32))
    assert len(files.read_npz(tmp_path / "zeros.npz", "points_m")) == 4000
    monkeypatch.setattr(files, "LARGEST_ARRAY_BYTES", 40_000)
    with pytest.raises(schema.DataError, match="'points_m' unpacks to 48128 bytes, more than the 40000"):
        files.read_npz(tmp_path / "zeros.npz", "points_m")


def test_a_run_whose_name_no_text_can_hold_is_refused(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    (root / "train/a").rename(root / "train/r\udcff")
    with pytest.raises(schema.DataError, match=r"a run is named 'r\\udcff', which is no UTF-8"):
        sources.open_recording(root)


def test_more_classes_than_a_byte_tells_apart_are_refused(tmp_path):
    names = ", ".join(f'"class {number}"' for number in range(256))
    root = writers.write_plain(tmp_path, {"train/a": 3}, splits=f'["train"]\nclasses = [{names}]')
    with pytest.raises(schema.DataError, match=r"classes names 256; a pixel has one of at most 255"):
        sources.open_recording(root)


@pytest.mark.parametrize("section", ["[lidar]\nrows = 100000000", "[voxels]\nshape = [100000, 100000, 100000]"])
def test_sizes_that_no_memory_holds_are_refused(tmp_path, section):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    path = root / "recording.toml"
    before, name, rest = path.read_text().partition(section.split("\n")[0])
    assert name
    path.write_text(before + section + rest[rest.find("\n["):])
    with pytest.raises(schema.DataError, match=r"rows is 100000000; it must be|shape is .* at most 1073741824 voxels"):
        sources.open_recording(root)


def test_a_counter_that_wraps_leaves_no_file_behind(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 6})
    numbers = [65533, 65534, 65535, 0, 1, 2]
    run = root / "train/a"
    for sensor in ("image", "lidar", "occupancy", "route_map"):
        for frame, number in reversed(list(enumerate(numbers))):
            (path,) = (run / sensor).glob(f"{frame:06d}.*")
            path.rename(path.with_name(f"x{number:06d}{path.suffix}"))
        for path in (run / sensor).iterdir():
            path.rename(path.with_name(path.name[1:]))
    header, *rows = (run / "frames.csv").read_text().splitlines()
    rows = [f"{number},{row.partition(',')[2]}" for number, row in zip(numbers, rows, strict=True)]
    (run / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = plain_reader.PlainRecording(root)
    (sequence,) = recording.sequences
    assert [int(recording.read(sequence, index)["frame_id"]) for index in range(6)] == numbers


def test_one_folder_under_two_splits_is_refused(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 6})
    (root / "val_rl").symlink_to(root / "train")
    with pytest.raises(schema.DataError, match="train/a and val_rl/a are one folder"):
        plain_reader.PlainRecording(root)


def test_a_description_and_a_table_that_cannot_be_read_are_named(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 6})
    (root / "recording.toml").unlink()
    (root / "recording.toml").mkdir()
    with pytest.raises(schema.DataError, match=r"recording\.toml: expected a TOML description, but it cannot be read"):
        plain_reader.read_header(root)


def test_a_camera_that_cannot_be_is_named_by_its_line(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 3})
    header, *rows = table(root, "train/a").read_text().splitlines()
    columns = ",".join(f"intrinsics_{row}{column}" for row in (1, 2) for column in (1, 2, 3))
    rows = [f"{row},{focal_px},0,32,0,32,16" for row, focal_px in zip(rows, (32, -32, 32), strict=True)]
    table(root, "train/a").write_text("\n".join([f"{header},{columns}", "", "", *rows]) + "\n")
    with pytest.raises(schema.DataError, match=r"frames\.csv, line 5: .* fx = -32"):
        plain_reader.PlainRecording(root)
