"""The table of fields: RawFrame and types.Batch agree with it, and what is read can be written and read again."""

import typing
import zipfile

import numpy as np
import pytest
import recording_writers as writers
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.data import fields, files, pictures, schema
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.packed import records
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer

SIZES = {"H": 6, "W": 9, "N": 7, "X": 4, "Y": 5, "Z": 3}
CLASSES = (*(f"class {number}" for number in range(20)), "vehicle")
GRID = config_lib.VoxelGrid((4, 5, 3), 1.0, (-2.0, -2.5, -1.0))
LIDAR = config_lib.RangeViewGeometry(rows=4, columns=8)
CAMERA = schema.Camera(9, 6, ((5.1, 0.0, 4.5), (0.0, 5.1, 3.0), (0.0, 0.0, 1.0)),
                       ((0.0, 0.0, 1.0, 1.5), (-1.0, 0.0, 0.0, 0.1), (0.0, -1.0, 0.0, 1.6), (0.0, 0.0, 0.0, 1.0)))
# The others are drawn as they must be, or made of one of these.
WRITTEN = [field for field in fields.TABLE if field.name not in ("intrinsics", "camera_to_ego", "image_instance_mask",
                                                                  "frame_id", "timestamp_s")]


def numbers_of(field):
    """Any numbers that the field may have, its extremes included."""
    dtype = np.dtype(field.dtype)
    if field.values:
        return st.sampled_from([dtype.type(value) for value in field.values])
    if field.name in ("image_classes", "point_classes"):
        return st.sampled_from([np.uint8(value) for value in (*range(len(CLASSES)), fields.UNKNOWN)])
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        return st.integers(max(info.min, int(max(field.limits.lowest, info.min))),
                           int(min(field.limits.highest, info.max)))
    width = 8 * dtype.itemsize
    low, high = (max(min(value, 1e30), -1e30) for value in (field.limits.lowest, field.limits.highest))
    low, high = np.nextafter(dtype.type(low), dtype.type(0)), np.nextafter(dtype.type(high), dtype.type(0))
    return st.floats(float(max(low, 0.0) if field.name == "depth_m" else low), float(high), width=width)


@st.composite
def cameras(draw):
    """A camera that looks anywhere from anywhere on a car, or none: then the description's is meant."""
    if draw(st.booleans()):
        return {}
    cosine, sine = np.cos(angle := draw(st.floats(-3.2, 3.2))), np.sin(angle)
    pose = np.eye(4, dtype=np.float32)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[:3, :3] = pose[:3, :3] @ np.float32(CAMERA.camera_to_ego)[:3, :3]
    pose[:3, 3] = draw(arrays.arrays(np.float32, 3, elements=st.floats(-30, 30, width=32)))
    intrinsics = np.eye(3, dtype=np.float32)
    intrinsics[0] = draw(st.tuples(*(st.floats(*ends, width=32) for ends in ((1, 90), (-5, 5), (-9, 18)))))
    intrinsics[1, 1:] = draw(st.tuples(*(st.floats(*ends, width=32) for ends in ((1, 90), (-6, 12)))))
    return {"intrinsics": intrinsics, "camera_to_ego": pose}


@st.composite
def frames(draw):
    """One frame of all fields that a writer takes, as a reader would give it."""
    frame = {"frame_id": np.int64(draw(st.integers(0, 2**63 - 1))),
             "timestamp_s": np.float64(draw(st.floats(0.0, 1e10)))}
    for field in WRITTEN:
        shape = tuple(SIZES.get(size, size) for size in field.shape)
        values = draw(arrays.arrays(field.dtype, shape, elements=numbers_of(field)))
        frame[field.name] = values if shape else field.dtype(values[()])
    frame |= draw(cameras())
    if draw(st.booleans()):
        frame["depth_m"] = pictures.decode_depth(plain_writer.encode_depth(frame["depth_m"]))
        frame["depth_m"][0, 0] = np.inf
    return frame


def assert_same(read, written):
    for name, value in written.items():
        assert np.asarray(read[name]).dtype == np.asarray(value).dtype, name
        np.testing.assert_array_equal(np.asarray(read[name]).view(np.uint8) if np.ndim(value) else read[name],
                                      np.asarray(value).view(np.uint8) if np.ndim(value) else value, err_msg=name)


def copy(root, written, described=None):
    """The frames as a plain recording, opened."""
    camera, lidar, voxels = (CAMERA, LIDAR, GRID) if described is None else (described.camera, described.lidar,
                                                                            described.voxels)
    plain_writer.write_description(root, name="copy", rate_hz=10.0, splits=("train",), camera=camera, lidar=lidar,
                                   voxels=voxels, classes=CLASSES,
                                   contract=config_lib.ActionContract() if described is None else described.contract)
    writer = plain_writer.RunWriter(root, "train", "a")
    for frame in written:
        writer.write(frame)
    writer.close()
    return plain_reader.PlainRecording(root, labels=fields.LABELS)


def test_raw_frames_and_batches_follow_the_table():
    assert set(fields.FIELDS) == set(typing.get_type_hints(schema.RawFrame))
    assert fields.LABELS == schema.LABELS
    for name, (dtype, rank) in types.BATCH_FIELDS.items():
        field = fields.FIELDS.get(name)
        if field is not None:
            assert dtype == field.dtype, name
            assert rank == len(field.shape) + (1 if name in types.UNTIMED_FIELDS else 2), name
    for field in fields.TABLE:  # each lies in one place: a folder or columns
        assert bool(field.folder) + bool(field.columns) == 1
        assert bool(field.array) == (".npz" in field.suffixes)
    value = np.arange(16.0, dtype=np.float32).reshape(4, 4)
    value[3] = 0, 0, 0, 1
    field = fields.FIELDS["camera_to_ego"]
    np.testing.assert_array_equal(field.of_cells(field.to_cells(value)), value)


@settings(max_examples=25, deadline=None)
@given(frame=frames())
def test_every_field_is_written_and_read_bit_for_bit(tmp_path_factory, frame):
    root = tmp_path_factory.mktemp("copies")
    first = copy(root / "once", [frame])
    read = first.read(first.sequences[0], 0)
    assert_same(read, frame)
    second = copy(root / "twice", [read])
    assert_same(second.read(second.sequences[0], 0), read)
    assert_same(records.decode_frame(records.encode_frame(read, records.Encoding()), "memory"), read)


def described_frame(number, **camera):
    return {"frame_id": number, "timestamp_s": number / 10, "speed_mps": 1.0, "acceleration": 0.0, "steering": 0.0,
            "image": np.full((6, 9, 3), number, np.uint8)} | camera


def moved(x_m):
    pose = np.array(CAMERA.camera_to_ego, np.float32)
    pose[0, 3] = x_m
    return pose


def test_the_camera_of_a_frame_stands_in_its_row_where_it_is_not_the_described_one(tmp_path):
    usual = np.array(CAMERA.camera_to_ego, np.float32)
    still = copy(tmp_path / "still", [described_frame(number, camera_to_ego=usual) for number in range(2)])
    assert "camera_to_ego_11" not in (tmp_path / "still/train/a/frames.csv").read_text()
    moving = copy(tmp_path / "moving", [described_frame(0), described_frame(1, camera_to_ego=moved(2.5)),
                                        described_frame(2, intrinsics=[[2.0, 0, 4], [0, 2, 3], [0, 0, 1]])])
    poses = [[recording.read(recording.sequences[0], index)["camera_to_ego"] for index in range(2)]
             for recording in (still, moving)]
    np.testing.assert_array_equal(poses, [[usual, usual], [usual, moved(2.5)]])
    np.testing.assert_array_equal(moving.read(moving.sequences[0], 2)["intrinsics"], [[2, 0, 4], [0, 2, 3], [0, 0, 1]])
    header = (tmp_path / "moving/train/a/frames.csv").read_text().splitlines()[0]
    assert header.endswith(",intrinsics_22,intrinsics_23,camera_to_ego_11,camera_to_ego_12,camera_to_ego_13,"
                           "camera_to_ego_14,camera_to_ego_21,camera_to_ego_22,camera_to_ego_23,camera_to_ego_24,"
                           "camera_to_ego_31,camera_to_ego_32,camera_to_ego_33,camera_to_ego_34")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("camera_to_ego_23", "other", "frames.csv: column camera_to_ego_23 is missing; it belongs to camera_to_ego_11"),
    (",2.5,", ",2500,", r"frames.csv, line 3: Camera.camera_to_ego puts the camera at \[2500"),
    (",2.5,", ",,", "frames.csv, line 3: camera_to_ego_14 is '', expected a finite number"),
    (",1.0,2.5,", ",2.0,2.5,", "frames.csv, line 3: Camera.camera_to_ego is .*must be a rotation"),
])
def test_a_camera_of_a_frame_that_cannot_be_is_refused_by_line(tmp_path, old, new, message):
    copy(tmp_path, [described_frame(0), described_frame(1, camera_to_ego=moved(2.5))])
    table = tmp_path / "train/a/frames.csv"
    assert old in table.read_text()
    table.write_text(table.read_text().replace(old, new))
    with pytest.raises(schema.DataError, match=message):
        plain_reader.PlainRecording(tmp_path)


def test_a_camera_without_its_last_row_and_a_target_by_its_column_are_written_or_refused(tmp_path):
    with pytest.raises(schema.DataError, match=r"frame 0: the last row of camera_to_ego is \[0.0, 0.0, 1.0, 0.0\]"):
        copy(tmp_path / "wrong", [described_frame(0, camera_to_ego=np.eye(4)[[0, 1, 3, 2]])])
    written = copy(tmp_path / "right", [described_frame(0, target_x_m=3.0, target_y_m=-4.0)])
    np.testing.assert_array_equal(written.read(written.sequences[0], 0)["target_m"], [3.0, -4.0])


def test_a_run_may_have_one_of_the_masks_that_share_a_file(tmp_path):
    moving = np.zeros((4, 5, 3), bool)
    moving[1, 2, 0] = True
    frame = {"frame_id": 0, "timestamp_s": 0.0, "speed_mps": 1.0, "acceleration": 0.0, "steering": 0.0,
             "points_m": np.ones((7, 3), np.float32), "occupancy_moving_mask": moving}
    recording = copy(tmp_path, [frame])
    read = recording.read(recording.sequences[0], 0)
    np.testing.assert_array_equal(read["occupancy_moving_mask"], moving)
    assert "image_moving_mask" not in recording.description.modalities | read.keys()


def test_kitti_and_packs_are_copied_bit_for_bit(tmp_path):
    sources_ = {"kitti": kitti_reader.KittiRecording(writers.write_kitti(tmp_path / "kitti"))}
    packed_writer.pack(writers.write_plain(tmp_path / "plain"), tmp_path / "packed", workers=1)
    sources_["packed"] = packed_reader.PackedRecording(tmp_path / "packed")
    for name, source in sources_.items():
        sequence = source.sequences[0]
        written = [source.read(sequence, index) for index in range(sequence.length)]
        again = copy(tmp_path / f"copy of {name}", written, source.description)
        assert again.sequences[0].length == sequence.length
        for index, frame in enumerate(written):
            assert_same(again.read(again.sequences[0], index), frame)


@pytest.mark.parametrize("field", [field for field in fields.TABLE
                                   if field.limits is not fields.FINITE or field.values], ids=lambda field: field.name)
def test_no_field_takes_a_number_that_it_cannot_have(field):
    shape = tuple(SIZES.get(size, size) for size in field.shape)
    good = np.zeros(shape, field.dtype)
    assert fields.conform(field.name, good, "here").dtype == field.dtype
    wrong = [77] if field.values else [value for value, whole in (
        (field.limits.lowest - 1, True), (field.limits.highest * 2 + 1, field.limits.highest < 2**62)) if
        np.isfinite(value) and whole]
    for value in wrong:
        bad = np.full(shape, value, np.float64 if np.dtype(field.dtype).kind == "f" else np.int64)
        with pytest.raises(schema.DataError, match=rf"here: {field.name} has \d+ of \d+ values such as"):
            fields.conform(field.name, bad, "here")
    if np.dtype(field.dtype).kind == "f" and field.finite:
        with pytest.raises(schema.DataError, match="values such as nan"):
            fields.conform(field.name, np.full(shape, np.nan), "here")


def test_headers_that_two_threads_parse_at_once_are_read_again(tmp_path, monkeypatch):
    """CPython 3.11 then raises SystemError now and then, here at the first try."""
    np.savez(tmp_path / "one.npz", values=np.arange(3))
    tries = []

    class Stumbling(dict):
        def __getitem__(self, name):
            tries.append(name)
            if len(tries) == 1:
                raise SystemError("AST constructor recursion depth mismatch (before=51, after=48)")
            return super().__getitem__(name)

    monkeypatch.setattr(np, "load", lambda file, allow_pickle: Stumbling({"values.npy": np.arange(3)}))
    np.testing.assert_array_equal(files.read_npz(tmp_path / "one.npz", "values"), np.arange(3))
    assert tries == ["values.npy", "values.npy"]


def test_a_member_without_the_suffix_is_no_array(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "LARGEST_ARRAY_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "one.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points_m", bytes(4 << 20))
        archive.writestr("other.npy", b"")
    with pytest.raises(schema.DataError, match=r"holds other, expected an array 'points_m'"):
        files.read_npz(tmp_path / "one.npz", "points_m")


def test_a_point_at_minus_infinity_counts_as_not_measured_a_depth_does_not():
    points_m = np.zeros((4, 3), np.float32)
    points_m[1, 0], points_m[2, 1] = -np.inf, np.inf
    np.testing.assert_array_equal(fields.conform("points_m", points_m, "here"), points_m)
    with pytest.raises(schema.DataError, match="depth_m has 1 of 2 values such as -inf"):
        fields.conform("depth_m", np.array([[1.0, -np.inf], [np.inf, np.nan]], np.float32), "here")


def test_a_link_to_nowhere_is_no_file(tmp_path):
    (tmp_path / "000001.png").symlink_to(tmp_path / ".annex/missing")
    (tmp_path / "000002.png").touch()
    (tmp_path / "000003.png").symlink_to(tmp_path / "000002.png")
    assert files.numbered(tmp_path, ".png") == {2: "000002.png", 3: "000003.png"}
    assert files.names_in(tmp_path / "none") == []


@pytest.mark.parametrize(("name", "values", "message"), [
    ("image", np.full((4, 4, 3), 300, np.uint16), r"image holds 300 as uint16, expected uint8, 0 to 255 \(a picture"),
    ("route_map", np.full((64, 64), 511), "route_map holds 511 as int64"),
    ("point_classes", np.full(5, 256, np.uint32), "point_classes holds 256 as uint32"),
    ("image_classes", np.full((4, 4), -1, np.int16), "image_classes holds -1 as int16, .*255 where the class is unkn"),
    ("birds_eye_instances", np.full((2, 2), 2**32 + 7), "birds_eye_instances holds 4294967303 as int64"),
])
def test_whole_numbers_that_the_type_cannot_hold_are_refused(name, values, message):
    with pytest.raises(schema.DataError, match=f"here: {message}"):
        fields.conform(name, values, "here")
    fits = fields.conform(name, np.full_like(values, 7), "here")
    assert fits.dtype == fields.FIELDS[name].dtype and (fits == 7).all()
