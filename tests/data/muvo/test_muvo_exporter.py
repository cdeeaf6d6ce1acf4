"""Plain recordings in the authors' layout: read back by our reader, and built like the authors' own files."""

import shutil

import numpy as np
import pytest
import recording_samples as samples
import recording_writers as writers

from muvo_jax import config as config_lib
from muvo_jax.data import fields, processes, schema, sources
from muvo_jax.data.muvo import exporter as muvo_exporter
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import safe_pickle
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer
from muvo_jax.ops import camera as camera_ops

FRAMES = 14
LIDAR = config_lib.RangeViewGeometry(position_m=(0.5, 0.25, 1.75))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A plain recording with everything that the layout needs."""
    root = tmp_path_factory.mktemp("source") / "mein Auto"
    rng = np.random.default_rng(0)
    intrinsics = camera_ops.intrinsics_from_fov(64, 32, np.pi / 2)
    pose = camera_ops.level_camera_to_ego((1.0, 0.0, 2.0))
    camera = schema.Camera(64, 32, tuple(map(tuple, intrinsics.tolist())), tuple(map(tuple, pose.tolist())))
    plain_writer.write_description(root, name="mine", rate_hz=10, splits=("train", "val_rl"), camera=camera,
                                   lidar=LIDAR, contract=config_lib.ActionContract(), voxels=muvo_reader.VOXELS)
    for split, run in (("train", "a"), ("val_rl", "b")):
        writer = plain_writer.RunWriter(root, split, run)
        for frame_id in range(FRAMES):
            occupancy = np.zeros(muvo_reader.VOXELS.shape, np.uint8)
            occupancy[frame_id, 100, 3] = 1
            writer.write({
                "frame_id": frame_id, "timestamp_s": frame_id / 10, "yaw_rad": 0.01 * frame_id ** 2, "speed_mps": 5.5,
                "acceleration": -0.25 if frame_id % 2 else 0.5, "steering": 0.1, "reward": 0.75,
                "image": rng.integers(0, 255, (32, 64, 3), np.uint8), "depth_m": np.full((32, 64), 12.34),
                "classes": np.full((32, 64), 7, np.uint8), "occupancy": occupancy,
                "route_map": rng.integers(0, 2, (64, 64), np.uint8) * 255, "point_tags": np.full(50, 8, np.uint8),
                "points_m": rng.uniform((3, -9, 0), (30, 9, 3), (50, 3)).astype(np.float32)})
        writer.close()
    return root


@pytest.fixture(scope="module")
def exported(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "als muvo"
    assert muvo_exporter.export(source, out) == 2 * FRAMES
    return out


def test_a_camera_of_each_frame_does_not_fit_into_the_layout(source, tmp_path):
    moved = shutil.copytree(source, tmp_path / "source")
    table = moved / "train/a/frames.csv"
    pose = plain_reader.PlainRecording(source).description.camera.camera_to_ego
    camera = ",".join(str(value) for row in (*pose[:2], (*pose[2][:3], 2.5)) for value in row)
    header, *rows = table.read_text().splitlines()
    columns = ",".join(fields.FIELDS["camera_to_ego"].columns)
    table.write_text("\n".join([f"{header},{columns}", *(f"{row},{camera}" for row in rows)]) + "\n")
    with pytest.raises(schema.DataError, match="frame 0 has camera_to_ego of its own"):
        muvo_exporter.export(moved, tmp_path / "out")


def test_what_is_read_back_is_what_was_recorded(source, exported):
    before, after = plain_reader.PlainRecording(source), sources.open_recording(exported)
    assert after.description.splits == ("train", "val0") and after.description.lidar == LIDAR
    assert after.description.camera == before.description.camera
    sequence = after.sequences[0]
    for index in range(sequence.length):
        original = before.read(before.sequences[0], sequence.start + index)
        again = after.read(sequence, index)
        for name in ("image", "occupancy", "route_map", "action", "speed_mps", "reward", "frame_id"):
            np.testing.assert_array_equal(again[name], original[name], err_msg=name)
        np.testing.assert_allclose(again["points_m"], original["points_m"], atol=1e-5)
        assert again["yaw_rate_radps"] == pytest.approx(original["yaw_rate_radps"])
    run = exported / "trainval/train/Town01/0000"
    depth, tags = muvo_files.read_depth_semantic(run / muvo_files.file_name("depth_semantic", 3))
    np.testing.assert_allclose(1000 * depth, 12.34, atol=1e-4)
    assert (tags == 7).all()
    points = muvo_files.read_points(run / muvo_files.file_name("points_semantic", 3), LIDAR.position_m)
    assert (points.tags == 8).all()


def test_a_run_without_occupancy_has_no_voxels(source, tmp_path):
    recording = shutil.copytree(source, tmp_path / "source", ignore=lambda _, names: [
        name for name in names if name[:6].isdigit() and int(name[:6]) > 1])
    for table in recording.glob("*/*/frames.csv"):
        table.write_text("".join(table.read_text().splitlines(keepends=True)[:3]))
    shutil.copytree(recording / "train/a", recording / "train/c")
    shutil.rmtree(recording / "train/c/occupancy")
    with pytest.warns(schema.DataWarning, match="occupancy is missing in 1 of 3 runs"):
        muvo_exporter.export(recording, tmp_path / "out")
    tables = {run.name: "voxel_path" in run.columns for run in muvo_runs.find_runs(tmp_path / "out")}
    assert tables == {"train/Town01/0000": True, "train/Town01/0001": False, "val0/Town01/0000": True}
    assert not (tmp_path / "out/trainval/train/Town01/0001/voxel").exists()


def test_an_export_is_resumed_and_other_sensors_are_refused(source, exported, tmp_path):
    (exported / "trainval/val0/Town01/0000" / muvo_runs.FRAME_FILE).unlink()
    assert muvo_exporter.export(source, exported) == FRAMES
    (tmp_path / muvo_reader.SENSORS_FILE).write_text("rate_hz = 5\n")
    with pytest.raises(FileExistsError, match="describes other sensors"):
        muvo_exporter.export(source, tmp_path)


def test_runs_of_another_recording_are_neither_kept_nor_mixed_with_this_one(source, exported, tmp_path):
    out = shutil.copytree(exported, tmp_path / "out")
    assert muvo_exporter.export(source, out) == 0
    other = shutil.copytree(source, tmp_path / "other")
    (other / "train/a").rename(other / "train/z")
    with pytest.raises(FileExistsError, match=r"Town01/0000 was made of 14 frames from 0 on of train/a of mine, .* "
                                              r"would now be 14 frames from 0 on of train/z of mine.*other folder"):
        muvo_exporter.export(other, out)
    assert (out / "runs.csv").read_bytes() == (exported / "runs.csv").read_bytes()
    (out / "runs.csv").unlink()
    with pytest.raises(FileExistsError, match=r"was made of something that runs\.csv does not say"):
        muvo_exporter.export(source, out)


def test_a_source_that_was_changed_makes_no_half_new_export(source, tmp_path):
    changed = shutil.copytree(source, tmp_path / "source")
    out = changed / "muvo"  # which is no part of what it is made of
    muvo_exporter.export(changed, out)
    assert muvo_exporter.export(changed, out) == 0
    picture = changed / "train/a/image/000003.png"
    shutil.copy(changed / "train/a/image/000004.png", picture)
    with pytest.raises(FileExistsError, match=r"train/Town01/0000 was made of .* fingerprint"):
        muvo_exporter.export(changed, out)
    (out / "trainval/train/Town01/0000" / muvo_runs.FRAME_FILE).unlink()
    assert muvo_exporter.export(changed, out) == FRAMES
    shutil.rmtree(changed / "val_rl/b")
    with pytest.raises(FileExistsError, match=r"val0/Town01/0000 was made of .* would now be no run of this recording"):
        muvo_exporter.export(changed, out)


def test_a_yaw_that_nobody_recorded_is_not_read_as_straight_ahead(source, tmp_path):
    still = shutil.copytree(source, tmp_path / "source")
    for table in still.glob("*/*/frames.csv"):
        table.write_text(table.read_text().replace("yaw_rad", "other_rad").replace("yaw_rate_radps", "other_radps"))
    with pytest.warns(schema.DataWarning, match="not every run has yaw_rate_radps .* export are zeros there"):
        muvo_exporter.export(still, tmp_path / "out")
    recording = sources.open_recording(tmp_path / "out")
    frame = recording.read(recording.sequences[0], 0)
    assert not {"yaw_rate_radps", "pose"} & (recording.description.modalities | frame.keys())
    described = tmp_path / "out" / muvo_reader.SENSORS_FILE
    described.write_text(described.read_text().replace("yaw_rate = false", "yaw_rate = 0"))
    with pytest.raises(schema.DataError, match=r"sensors\.toml: yaw_rate is 0, expected false"):
        sources.open_recording(tmp_path / "out")


def test_a_second_export_into_one_folder_is_told(source, tmp_path):
    pytest.importorskip("fcntl")
    with (processes.locked(tmp_path / ".exporting", "exporting"),
          pytest.raises(BlockingIOError, match="another process is exporting here now")):
        muvo_exporter.export(source, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".exporting"]


def test_what_the_authors_reader_needs_is_asked_for(tmp_path):
    with pytest.raises(schema.DataError, match="has no depth, classes"):
        muvo_exporter.export(writers.write_plain(tmp_path / "rec"), tmp_path / "out")


@pytest.mark.skipif(samples.MUVO_LAYOUT is None, reason="no recording in the MUVO layout here")
def test_built_like_the_authors_own(exported):
    """Folders, file names, types of files, columns, their order and the types of their cells."""
    theirs = samples.MUVO_LAYOUT / "trainval/train/Town01/0000"
    ours = exported / "trainval/train/Town01/0000"
    empty = {"image_left", "image_right", "image_all"}  # which git does not keep
    assert {path.name for path in ours.iterdir()} - empty == {path.name for path in theirs.iterdir()} - empty
    for kind in muvo_files.KINDS:
        assert (ours / muvo_files.file_name(kind, 7)).is_file() and (theirs / muvo_files.file_name(kind, 7)).is_file()
    mine, original = (safe_pickle.load_table(folder / muvo_runs.FRAME_FILE) for folder in (ours, theirs))
    assert list(mine) == list(original)
    for name, column in original.items():
        assert getattr(mine[name], "dtype", None) == getattr(column, "dtype", None), name
        assert type(mine[name][0]) is type(column[0]), name
        assert getattr(mine[name][0], "dtype", None) == getattr(column[0], "dtype", None), name
    for kind in ("points_semantic", "voxel"):
        found = [safe_pickle.load_npy(folder / muvo_files.file_name(kind, 7)) for folder in (ours, theirs)]
        if isinstance(found[0], dict):
            assert [(key, value.dtype, value.flags.f_contiguous) for key, value in found[0].items()] == [
                (key, value.dtype, value.flags.f_contiguous) for key, value in found[1].items()]
        else:
            assert found[0].dtype == found[1].dtype == np.uint16


@pytest.mark.parametrize("town", ["", "../../x", "Berlin", "Town01/x"])
def test_a_town_that_the_authors_code_would_not_find_is_refused(tmp_path, town):
    with pytest.raises(ValueError, match=f"--town={town}: expected a name such as Town01"):
        muvo_exporter.export(tmp_path / "source", tmp_path / "out", town=town)
    assert not (tmp_path / "out").exists()
