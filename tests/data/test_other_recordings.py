"""Recordings of other people's kinds: what is found, what is refused by name; what a run lacks takes nothing away."""

import warnings

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fields, fitting, pictures, pipeline, prepare, schema, sources, windows
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer


def rewrite_table(folder, change):
    path = folder / "frames.csv"
    path.write_bytes(change(path.read_text()).encode())


def pieces(recording):
    return [(sequence.name, sequence.start, sequence.length) for sequence in recording.sequences]


def with_cell(column, row, value):
    """Changes one cell of a table as recording_writers makes it; row 0 is the first frame."""
    def change(text):
        header, *lines = text.splitlines()
        cells = lines[row].split(",")
        cells[header.split(",").index(column)] = value
        lines[row] = ",".join(cells)
        return "\n".join([header, *lines]) + "\n"
    return change


@pytest.mark.parametrize("change", [
    lambda text: "\ufeff" + text,
    lambda text: text.replace(",", ", "),
    lambda text: text.replace("\n", "\r\n"),
    lambda text: text + "\n,,,,,,,,,,\n\n",
    lambda text: text.replace("frame_id", " frame_id "),
    with_cell("is_terminal", 0, ""), with_cell("is_terminal", 0, "False"), with_cell("frame_id", 3, "3.0"),
], ids=["byte order mark", "spaces", "Windows lines", "blank lines", "blank in header", "blank flag", "word", "12.0"])
def test_tables_as_other_programs_write_them(tmp_path, change):
    root = writers.write_plain(tmp_path)
    before = pieces(plain_reader.PlainRecording(root))
    rewrite_table(root / "train/a", change)
    assert pieces(plain_reader.PlainRecording(root)) == before


@pytest.mark.parametrize(("change", "message"), [
    (with_cell("speed_mps", 3, "900"), r"line 5: speed_mps is 900; it must be at least -100 and at most 150 m/s"),
    (with_cell("steering", 0, "-1.5"), r"line 2: steering is -1.5; it must be at least -1.001 and at most 1.001"),
    (with_cell("acceleration", 0, "inf"), r"line 2: acceleration is 'inf', expected a finite number"),
    (with_cell("is_terminal", 1, "2"), r"line 3: is_terminal is 2; it must be one of 0, 1"),
    (with_cell("reward", 0, ""), r"line 2: reward is '', expected a finite number"),
    (with_cell("x_m", 4, "nan"), r"line 6: x_m is 'nan', expected a finite number"),
    (with_cell("frame_id", 2, "1"), r"line 4: frame_id is 1, which is there already .*line 3"),
    (with_cell("frame_id", 2, "-7"), r"line 4: frame_id is '-7', expected a whole number from 0"),
    (with_cell("frame_id", 2, "2.5"), r"line 4: frame_id is '2.5', expected a whole number"),
    (with_cell("frame_id", 2, str(2**63)), r"line 4: frame_id is '9223372036854775808'"),
    (lambda text: text.replace(",", ";"), r"Cells are separated by ';'; write commas"),
    (lambda text: text.replace("reward", "speed_mps"), r"column speed_mps is there twice"),
    (lambda text: text.replace("0.25", "0,25", 1), r"line 2: 12 cells under 11 columns. Numbers have a point"),
])
def test_tables_that_cannot_be_are_refused_by_line_column_value_and_range(tmp_path, change, message):
    root = writers.write_plain(tmp_path)
    rewrite_table(root / "train/a", change)
    with pytest.raises(schema.DataError, match=f"frames.csv.*{message}"):
        plain_reader.PlainRecording(root)


@pytest.mark.parametrize("first", [1_700_000_000_100_000_001, 2**53, 2**63 - 20])
def test_whole_numbers_stay_whole(tmp_path, first):
    root = writers.write_plain(tmp_path, {"train/a": 6})
    folder = root / "train/a"
    for number in range(6):
        for path in folder.glob(f"*/{number:06d}.*"):
            path.rename(path.with_name(f"{first + number}{path.suffix}"))
        rewrite_table(folder, with_cell("frame_id", number, str(first + number)))
    recording = plain_reader.PlainRecording(root)
    (sequence,) = recording.sequences
    for index in range(6):
        frame = recording.read(sequence, index)
        assert frame["frame_id"] == first + index and (frame["image"] == index).all()


def rename_images(folder, name):
    for path in (folder / "image").iterdir():
        path.rename(path.with_name(name(int(path.stem))))


@pytest.mark.parametrize("name", [lambda k: f"{k}.png", lambda k: f"{k:012d}.png", lambda k: f"{k:06d}.PNG"])
def test_files_are_found_under_other_paddings_and_cases(tmp_path, name):
    root = writers.write_plain(tmp_path)
    rename_images(root / "train/a", name)
    (root / "train/a/image/.DS_Store").touch()
    (root / "train/a/image/Thumbs.db").touch()
    recording = plain_reader.PlainRecording(root)
    assert pieces(recording)[0] == ("train/a", 0, 10)
    assert (recording.read(recording.sequences[0], 7)["image"] == 7).all()


def test_files_that_no_frame_can_be_told_of_are_refused(tmp_path):
    root = writers.write_plain(tmp_path)
    rename_images(root / "train/a", lambda k: f"frame_{k}.png")
    with pytest.raises(schema.DataError, match=r"no file is named by the number of its frame.* found frame_0.png"):
        plain_reader.PlainRecording(root)
    rename = root / "train/b/image"
    for path in (root / "train/a/image").iterdir():
        path.unlink()
    (rename / "3.png").write_bytes((rename / "000003.png").read_bytes())
    with pytest.raises(schema.DataError, match=r"000003.png and 3.png are both frame 3. Remove one"):
        plain_reader.PlainRecording(root)


def save(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)


@pytest.mark.parametrize(("name", "pixels", "message"), [
    ("image", np.zeros((32, 64), np.uint16), r"mode 'I;16', expected 8 bits of each colour"),
    ("image", np.zeros((32, 64), np.float32), None),  # a TIFF that is named like a PNG
    ("route_map", np.zeros((64, 64), np.uint16), r"expected 8 bits of each colour"),
    ("route_map", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8), r"expected grey"),
    ("route_map", np.zeros((32, 32), np.uint8), r"shape \[32, 32\] of route_map, expected \[64, 64\]"),
    ("depth", np.full((32, 64), 200, np.uint8), r"mode 'L', expected 16 bits of grey, the depth in centimetres"),
    ("depth", np.zeros((32, 64, 3), np.uint8), r"expected 16 bits of grey"),
    ("classes", np.full((32, 64), 37, np.uint8), r"image_classes has the class 37, but the recording names only 10"),
    ("classes", np.random.default_rng(0).integers(0, 9, (32, 64, 3), np.uint8), r"the number of a class in each pixel"),
    ("classes", np.full((32, 64), 300, np.uint16), r"expected 8 bits"),
])
def test_pictures_of_other_pixels_are_refused(tmp_path, name, pixels, message):
    root = writers.write_plain(tmp_path, {"train/a": 4})
    folder = root / "train/a" / name
    folder.mkdir(exist_ok=True)
    for number in range(4):
        path = folder / f"{number:06d}.png"
        if message is None:
            path = path.with_suffix(".png")
            Image.fromarray(pixels).save(path, format="TIFF")
        else:
            save(path, pixels)
    labels = frozenset({"depth_m", "image_classes"})
    with pytest.raises(schema.DataError, match=message or "expected 8 bits"):
        recording = plain_reader.PlainRecording(root, labels=labels)
        recording.read(recording.sequences[0], 0)


def test_pictures_that_say_the_same_otherwise_are_read(tmp_path):
    grey = np.arange(64 * 64, dtype=np.uint32).reshape(64, 64).astype(np.uint8)
    for name, image in {"grey": Image.fromarray(grey), "colours": Image.fromarray(np.stack([grey] * 3, axis=-1)),
                        "alpha": Image.fromarray(grey).convert("LA")}.items():
        image.save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(pictures.read(tmp_path / f"{name}.png", "L"), grey)
    palette = Image.fromarray(grey % 5)
    palette.putpalette([200, 10, 10, 10, 200, 10, 10, 10, 200, 0, 0, 0, 255, 255, 255])
    palette.save(tmp_path / "palette.png")
    np.testing.assert_array_equal(pictures.read(tmp_path / "palette.png", "classes"), grey % 5)
    rgba = Image.fromarray(np.dstack([grey, grey, grey, np.full_like(grey, 7)]))
    rgba.save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(pictures.read(tmp_path / "rgba.png", "RGB"), np.stack([grey] * 3, axis=-1))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_the_camera_was_held(tmp_path, orientation):
    upright = np.zeros((16, 32, 3), np.uint8)
    upright[:8, :16] = 255
    turned = {1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1],
              5: upright.transpose(1, 0, 2), 6: upright[:, ::-1].transpose(1, 0, 2)[:, :, :],
              7: upright[::-1, ::-1].transpose(1, 0, 2), 8: upright[::-1].transpose(1, 0, 2)}
    stored = {6: np.rot90(upright), 8: np.rot90(upright, -1)}.get(orientation, turned[orientation])
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "a.jpg", exif=exif, quality=100)
    np.testing.assert_allclose(pictures.read(tmp_path / "a.jpg", "RGB"), upright, atol=12)


@pytest.mark.parametrize(("file", "name", "values", "message"), [
    ("occupancy", "occupancy", np.full((16, 16, 16), 7, np.uint8), r"4096 of 4096 values such as 7; expected one of 0"),
    ("occupancy", "occupancy", np.full((16, 16, 16), 0.5), r"occupancy holds float64, expected uint8"),
    ("occupancy", "occupancy", np.full((16, 16, 16), 256), r"values such as 256; expected one of 0, 1, 255"),
    ("lidar", "points_m", np.full((5, 3), 8_000_000.0), r"points_m has 15 of 15 values such as 8000000.0"),
    ("lidar", "points_m", np.full((5, 3), 2500), r"points_m holds int64, expected float32 in m"),
    ("lidar", "points_m", np.full((5, 4), 1.0), r"shape \[5, 4\] of points_m"),
])
def test_arrays_that_cannot_be_are_refused(tmp_path, file, name, values, message):
    root = writers.write_plain(tmp_path, {"train/a": 4})
    np.savez(root / f"train/a/{file}/000000.npz", **{name: values})
    recording = plain_reader.PlainRecording(root)
    with pytest.raises(schema.DataError, match=message):
        recording.read(recording.sequences[0], 0)


def test_a_folder_that_one_run_has_more_takes_no_frame_from_the_others(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 10, "train/b": 10, "train/c": 10, "val_rl/d": 10})
    before = pieces(plain_reader.PlainRecording(root))
    (root / "train/a/depth").mkdir()  # empty
    assert pieces(plain_reader.PlainRecording(root, labels=frozenset({"depth_m"}))) == before
    for number in range(10):
        save(root / f"train/a/depth/{number:06d}.png", np.full((32, 64), 100, np.uint16))
    with pytest.warns(schema.DataWarning, match=r"depth_m is recorded in 1 of 4 runs \(train/a\) only and is not used"):
        recording = plain_reader.PlainRecording(root, labels=frozenset({"depth_m"}))
    assert pieces(recording) == before and "depth_m" not in recording.description.modalities


@pytest.mark.parametrize("empty", [True, False])
def test_a_run_without_a_sensor_is_passed_by_only_where_it_is_needed(tmp_path, empty):
    root = writers.write_plain(tmp_path, {"train/a": 10, "train/b": 10, "train/c": 10, "val_rl/d": 10})
    for path in (root / "train/b/lidar").iterdir():
        path.unlink()
    if not empty:
        (root / "train/b/lidar").rmdir()
    with pytest.warns(schema.DataWarning, match=r"points_m is missing in 1 of 4 runs \(train/b\)"):
        recording = plain_reader.PlainRecording(root)
    assert [sequence.lacks for sequence in recording.sequences] == [(), ("points_m",), (), ()]
    assert "points_m" not in recording.read(recording.sequences[1], 0)
    config = config_lib.override_all(presets.tiny(), {"data.stride": 1})
    adapted = fitting.adapt(config, recording).config
    blind = fitting.adapt(config_lib.override_all(config, {"model.lidar": "none", "model.heads": ["image", "action"]}),
                          recording).config
    names = {}
    for what, chosen in (("both", adapted), ("camera alone", blind)):
        needs = pipeline.Frames(recording, chosen).needs
        found = windows.find_windows(recording, "train", frames=4, stride=1, needs=needs)
        names[what] = {window.sequence.name for window in found}
    assert names == {"both": {"train/a", "train/c"}, "camera alone": {"train/a", "train/b", "train/c"}}


def test_a_split_that_lacks_what_is_needed_is_said_so(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 10, "train/b": 10, "val_rl/d": 10})
    for path in (root / "val_rl/d/image").iterdir():
        path.unlink()
    with pytest.warns(schema.DataWarning, match="image is missing in 1 of 3 runs"):
        recording = plain_reader.PlainRecording(root)
    config = config_lib.override_all(presets.tiny(), {"data.stride": 1})
    with pytest.raises(schema.DataError, match=r"split 'val_rl' that has image has 0 frames, but a window needs 8"):
        fitting.adapt(config, recording)


@pytest.mark.parametrize("column", ["reward", "is_terminal", "x_m"])
def test_a_column_that_one_run_lacks_is_not_switched_off_for_the_others(tmp_path, column):
    root = writers.write_plain(tmp_path, {"train/a": 10, "train/b": 10, "train/c": 10, "val_rl/d": 10})
    rewrite_table(root / "train/a", with_cell("is_terminal", 4, "1"))
    for run in ("train/b",):
        rewrite_table(root / run, lambda text: text.replace(column, f"other_{column}"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", schema.DataWarning)
        recording = plain_reader.PlainRecording(root)
    assert pieces(recording)[:2] == [("train/a", 0, 5), ("train/a", 5, 5)]
    field = fields.COLUMNS[column].name
    assert field in recording.description.modalities
    frame = recording.read(recording.sequences[2], 0)
    assert recording.sequences[2].name == "train/b" and (field in frame) == (column == "is_terminal")
    config = config_lib.override_all(presets.tiny(), {"data.stride": 1})
    frames = pipeline.Frames(recording, fitting.adapt(config, recording).config)
    batch = frames.batch([windows.Window(sequence, 0, 4, 1) for sequence in recording.sequences[1:4]])
    assert (batch.reward is None) == (column == "reward") and batch.is_terminal is not None


@pytest.mark.parametrize("is_packed", [False, True])
def test_no_more_of_a_frame_is_read_than_a_batch_needs(tmp_path, is_packed):
    root = writers.write_plain(tmp_path / "plain", {"train/a": 8, "val_rl/b": 8})
    for path in root.glob("*/*/image/*.png"):
        (path.parents[1] / "moving").mkdir(exist_ok=True)
        np.savez((path.parents[1] / "moving" / path.name).with_suffix(".npz"),
                 image_moving_mask=np.ones((32, 64), bool), occupancy_moving_mask=np.zeros((16, 16, 16), bool))
    if is_packed:
        assert packed_writer.pack(root, tmp_path / "packed", workers=1)
        root = tmp_path / "packed"
    recording = sources.open_recording(root)
    asked = []
    read_fields = recording.read_fields
    recording.read_fields = lambda *place: asked.append(set(place[-1])) or read_fields(*place)
    tiny = presets.get("tiny")
    blind = config_lib.override_all(tiny, {"model.camera": "none", "model.heads": ["range_view"], "model.route": False})
    whole = {"image", "points_m", "occupancy", "route_map"}
    masks = {"image_moving_mask", "occupancy_moving_mask"}
    for config, judged, opened in ((tiny, False, whole), (tiny, True, whole | masks), (blind, False, {"points_m"})):
        asked.clear()
        frames = pipeline.Frames(recording, fitting.adapt(config, recording).config)
        window = windows.find_windows(recording, "train", frames=2, stride=1, needs=frames.needs)[0]
        batch = frames.batch([window], judged=judged)
        assert (batch.image_moving_mask is not None) == judged
        with_files = {name for name in fields.FIELDS if fields.FIELDS[name].folder}
        assert [names & with_files for names in asked] == [opened, opened]
        read = read_fields(window.sequence, 0, asked[0])
        assert set(read) & with_files == opened


def test_the_writer_refuses_slips_and_numbers_that_cannot_be(tmp_path):
    frame = {"frame_id": 0, "timestamp_s": 0.0, "speed_mps": 1.0, "acceleration": 0.0, "steering": 0.0}
    writer = plain_writer.RunWriter(tmp_path, "train", "a")
    with pytest.raises(ValueError, match=r"'speed_mp' is unknown.* Did you mean speed_mps\?"):
        writer.write(frame | {"speed_mp": 3.0})
    with pytest.raises(schema.DataError, match=r"frame 0: steering is 35; it must be"):
        writer.write(frame | {"steering": 35})
    with pytest.raises(schema.DataError, match="occupancy has 8 of 8 values such as 3; expected one of 0, 1, 255"):
        writer.write(frame | {"occupancy": np.full((2, 2, 2), 3, np.uint8)})
    with pytest.raises(schema.DataError, match=r"points_m holds int64, expected float32 in m"):
        writer.write(frame | {"points_m": np.zeros((3, 3), np.int64)})


def test_home_folders_are_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    writers.write_plain(tmp_path / "rec", {"train/a": 2})
    drive = writers.write_kitti(tmp_path / "kitti")
    assert sources.open_recording("~/rec").sequences
    assert plain_reader.PlainRecording("~/rec").sequences
    assert kitti_reader.KittiRecording(f"~/kitti/{drive.parent.name}").sequences
    plain_writer.RunWriter("~/mine", "train", "a").close()
    assert plain_writer.is_complete("~/mine", "train", "a") and (tmp_path / "mine/train/a/frames.csv").is_file()


def test_frames_without_what_the_model_needs_are_refused_by_name(tmp_path):
    recording = plain_reader.PlainRecording(writers.write_plain(tmp_path, {"train/a": 30, "val_rl/b": 30}))
    config = fitting.adapt(presets.tiny(), recording).config
    frame = recording.read(recording.sequences[0], 0)
    del frame["points_m"]
    with pytest.raises(schema.DataError, match="frame 0 has no points_m, which the model needs"):
        prepare.prepare_frame(frame, config)


@pytest.mark.parametrize("damage", [
    lambda content: content[:-300] + bytes(300),
    lambda content: content[:200] + bytes([content[200] ^ 1]) + content[201:],
    lambda content: content[:300] + bytes(64) + content[364:],
    lambda content: content[:-12]], ids=["zeros at the end", "a flipped bit", "zeros", "without IEND"])
def test_a_damaged_png_is_not_read_with_other_pixels(tmp_path, damage):
    path = tmp_path / "a.png"
    save(path, np.random.default_rng(0).integers(0, 4, (64, 64), np.uint8), compress_level=1)
    assert pictures.read(path, "L").shape == (64, 64) and len(path.read_bytes()) > 900
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(schema.DataError, match=r"a\.png: not a readable image .*truncated or damaged"):
        pictures.read(path, "L")
