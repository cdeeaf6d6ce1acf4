"""Occupancy from depth and lidar: the authors' own voxel files, carving worked by hand, and interruptions."""

import json
import os
import shutil

import numpy as np
import pytest
import recording_samples as samples
import recording_writers as writers
from PIL import Image

from muvo_jax import voxelize as command
from muvo_jax.data import fields, processes, schema, voxelizing
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import safe_pickle
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer

needs_layout = pytest.mark.skipif(samples.MUVO_LAYOUT is None,
                                  reason="no recording in the MUVO layout here; name one by MUVO_LAYOUT=FOLDER")
# Camera at (-7.5, 0.5, 0.5) in a grid of 1 m from (-8, -8, -2): its axis runs along row y 8, layer z 2.
CAMERA_TO_EGO = "[[0, 0, 1, -7.5], [-1, 0, 0, 0.5], [0, -1, 0, 0.5], [0, 0, 0, 1]]"


@pytest.fixture
def recording(tmp_path):
    """Two runs of two frames, 3x3 pixels and one lidar point; the middle pixel sees 5 m, the others nothing."""
    root = writers.write_plain(
        tmp_path / "mesuré ici", {"train/a": 2, "val_rl/c": 2}, width_px="3", height_px="3",
        intrinsics="[[1, 0, 1.5], [0, 1, 1.5], [0, 0, 1]]", camera_to_ego=CAMERA_TO_EGO, position_m="[-7.5, 5.5, 0.5]")
    depth_m = np.zeros((3, 3))
    depth_m[1, 1] = 5.0
    for run in (root / "train/a", root / "val_rl/c"):
        shutil.rmtree(run / "occupancy")
        (run / "depth").mkdir()
        for frame in range(2):
            Image.new("RGB", (3, 3)).save(run / f"image/{frame:06d}.png")
            Image.fromarray(plain_writer.encode_depth(depth_m)).save(run / f"depth/{frame:06d}.png")
            np.savez(run / f"lidar/{frame:06d}.npz", points_m=np.array([[-3.5, 5.5, 0.5]], np.float32))
    return root


def occupancy(root, run="train/a", frame=0):
    return np.load(root / run / f"occupancy/{frame:06d}.npz")["occupancy"]


def test_rays_carve_what_they_pass_and_the_rest_is_unknown(recording):
    progress = []
    result = voxelizing.voxelize(recording, workers=1, progress=lambda *counts: progress.append(counts))
    assert result == (4, 0) and progress == [(4, 4)]
    grid = occupancy(recording)
    expected = np.full((16, 16, 16), 255, np.uint8)
    expected[0:5, 8, 2], expected[5, 8, 2] = 0, 1  # the camera: from x -7.5 to -2.5
    expected[0:4, 13, 2], expected[4, 13, 2] = 0, 1  # the lidar: to x -3.5
    np.testing.assert_array_equal(grid, expected)
    read = plain_reader.PlainRecording(recording)
    np.testing.assert_array_equal(read.read(read.sequences[-1], 1)["occupancy"], expected)


def test_each_frame_has_the_camera_of_its_row_and_files_any_name_that_the_reader_takes(recording):
    run = recording / "train/a"
    header, first, second = (run / "frames.csv").read_text().split()
    lines = [f"{header},{','.join(fields.FIELDS['camera_to_ego'].columns)}"]
    for line, y_m in ((first, 0.5), (second, -2.5)):
        lines.append(f"{line},0,0,1,-7.5,-1,0,0,{y_m},0,-1,0,0.5")
    (run / "frames.csv").write_text("\n".join(lines) + "\n")
    (run / "lidar/000001.npz").rename(run / "lidar/1.NPZ")
    np.savez(run / "depth/01.npz", depth_m=np.pad(np.float32([[4.0]]), 1))
    (run / "depth/000001.png").unlink()
    (run / "occupancy").mkdir()
    (run / "occupancy/rule.json").write_text("{}")  # what an interruption at the first frame leaves
    plain_reader.PlainRecording(recording)
    voxelizing.voxelize(recording, workers=1, overwrite=True)
    assert [np.argwhere(occupancy(recording, frame=frame) == 1).tolist() for frame in range(2)] == [
        [[4, 13, 2], [5, 8, 2]], [[4, 5, 2], [4, 13, 2]]]


def test_sky_carves_to_the_border(recording):
    Image.fromarray(np.array([[0, 0, 0], [0, 65535, 0], [0, 0, 0]], np.uint16)).save(
        recording / "train/a/depth/000000.png")
    voxelizing.voxelize(recording, workers=1)
    grid = occupancy(recording)
    assert (grid[:, 8, 2] == 0).all() and (grid == 1).sum() == 1
    assert (occupancy(recording, frame=1)[6:, 8, 2] == 255).all()


def test_the_reference_rule_calls_all_else_empty(recording):
    voxelizing.voxelize(recording, rule="reference", workers=1)
    assert np.argwhere(occupancy(recording) == 1).tolist() == [[4, 13, 2], [5, 8, 2]]
    assert (occupancy(recording) == 255).sum() == 0
    with pytest.raises(FileExistsError, match=r"reference.* not by .*carved.*--overwrite"):
        voxelizing.voxelize(recording, workers=1)
    assert voxelizing.voxelize(recording, overwrite=True, workers=1) == (4, 0)
    assert (occupancy(recording) == 255).any()


def test_whole_files_are_kept_and_half_ones_made_again(recording):
    voxelizing.voxelize(recording, workers=1)
    folder = recording / "train/a/occupancy"
    whole = (folder / "000000.npz").read_bytes()
    (folder / "000000.npz").write_bytes(whole[:-10])
    (folder / "000001.npz").unlink()
    (folder / ".000001.npz.123").write_bytes(whole[:10])  # what kill -9 leaves
    theirs = recording / "val_rl/c/occupancy/000001.npz"
    np.savez(theirs, occupancy=np.zeros((16, 16, 16), np.uint8))
    kept = theirs.read_bytes()
    assert voxelizing.voxelize(recording, workers=1) == (2, 2)
    assert (folder / "000000.npz").read_bytes() == whole and theirs.read_bytes() == kept
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npz", "000001.npz", "rule.json"]


def test_occupancy_is_not_kept_where_what_it_was_made_of_was_corrected(recording):
    voxelizing.voxelize(recording, workers=1)
    depth = recording / "train/a/depth/000001.png"
    Image.fromarray(np.array([[0, 0, 0], [0, 300, 0], [0, 0, 0]], np.uint16)).save(depth)
    made_ns = (recording / "train/a/occupancy/000001.npz").stat().st_mtime_ns
    os.utime(depth, ns=(made_ns + 1_000_000, made_ns + 1_000_000))
    assert voxelizing.voxelize(recording, workers=1) == (1, 3)
    assert np.argwhere(occupancy(recording, frame=1) == 1).tolist() == [[3, 8, 2], [4, 13, 2]]
    header = recording / plain_reader.DESCRIPTION_FILE
    header.write_text(header.read_text().replace(CAMERA_TO_EGO, CAMERA_TO_EGO.replace("-7.5", "-6.5")))
    with pytest.raises(FileExistsError, match=r"made by \{'camera': .*-7\.5.*, not by .*-6\.5.*--overwrite"):
        voxelizing.voxelize(recording, workers=1)
    for path in recording.glob("*/*/occupancy/rule.json"):  # as it was before calibrations were noted
        path.write_text(json.dumps({name: value for name, value in json.loads(path.read_text()).items()
                                    if name not in ("camera", "lidar_position_m")}))
    assert voxelizing.voxelize(recording, workers=1).kept == 4


def test_cameras_of_single_frames_that_were_corrected_make_occupancy_anew(recording):
    table = recording / "train/a/frames.csv"
    header, *rows = table.read_text().split()
    columns = ",".join(fields.FIELDS["intrinsics"].columns)
    table.write_text("\n".join([f"{header},{columns}", *(f"{row},1,0,1.5,0,1,1.5" for row in rows)]) + "\n")
    voxelizing.voxelize(recording, workers=1)
    made_ns = max(path.stat().st_mtime_ns for path in recording.glob("*/*/occupancy/*.npz"))
    for run in ("train/a", "val_rl/c"):  # the second has no camera of its own
        os.utime(recording / run / "frames.csv", ns=(made_ns + 1_000_000, made_ns + 1_000_000))
    assert voxelizing.voxelize(recording, workers=1) == (2, 2)


@pytest.mark.parametrize("rule", voxelizing.RULES)
def test_occupancy_that_nobody_noted_a_rule_of_is_not_taken_for_ours(recording, rule):
    folder = recording / "train/a/occupancy"
    folder.mkdir()
    np.savez(folder / "000000.npz", occupancy=np.zeros((8, 8, 4), np.uint8))
    with pytest.raises(FileExistsError, match=r"000000\.npz: no rule\.json beside it .*--overwrite"):
        voxelizing.voxelize(recording, rule=rule, workers=1)
    assert voxelizing.voxelize(recording, rule=rule, overwrite=True, workers=1) == (4, 0)
    assert occupancy(recording).shape == (16, 16, 16)


POINT = np.array([[-3.5, 5.5, 0.5]])


@pytest.mark.parametrize(("path", "arrays", "message"), [
    ("lidar/000001.npz", {"points_m": (POINT * 1000).astype(np.int32)}, "points_m holds int32, expected float32 in m"),
    ("lidar/000001.npz", {"points_m": POINT.astype(complex)}, "points_m holds complex128"),
    ("lidar/000001.npz", {"points_m": POINT * 1e30}, "points_m has 3 of 3 values such as"),
    ("lidar/000001.npz", {"points_m": np.zeros(3, "f4,f4,f4")}, r"shape \[3\] of points_m, expected \['any', 3\]"),
    ("depth/000001.npz", {"depth_m": np.full((3, 3), 5000, np.uint16)}, "depth_m holds uint16, expected float32 in m"),
    ("depth/000001.npz", {"depth_m": np.full((3, 3), -5.0)}, "depth_m has 9 of 9 values such as -5.0"),
    ("depth/000001.npz", {"depth_m": np.full((3, 3), "5.0")}, "depth_m holds <U3"),
    ("depth/000001.npz", {"depth_m": np.zeros((3, 3), "f4,f4")}, r"depth_m holds \[\('f0'"),
])
def test_measurements_that_the_reader_refuses_are_not_voxelized(recording, path, arrays, message):
    (recording / "train/a/depth/000001.png").unlink()
    np.savez(recording / "train/a/depth/000001.npz", depth_m=np.pad(np.float32([[4.0]]), 1))
    np.savez(recording / "train/a" / path, **arrays)
    with pytest.raises(schema.DataError, match=f"1 of 4 frames have no occupancy.*train/a/{path}: {message}"):
        voxelizing.voxelize(recording, workers=1)
    assert len(list(recording.glob("*/*/occupancy/*.npz"))) == 3


def test_frames_that_cannot_be_made_are_named_and_the_others_done(recording):
    (recording / "train/a/depth/000001.png").write_bytes(b"no image")
    with pytest.raises(schema.DataError, match=r"1 of 4 frames have no occupancy.*000001\.png: not a readable image"):
        voxelizing.voxelize(recording, workers=1)
    assert len(list(recording.glob("*/*/occupancy/*.npz"))) == 3


def test_missing_sensors_are_told_before_anything_is_written(recording, tmp_path, capsys):
    shutil.rmtree(recording / "val_rl/c/depth")
    assert command.command_line.run(command.Options, command.voxelize, program="voxelize",
                                    arguments=[str(recording)]) == 1
    assert "no frame has a depth map" in capsys.readouterr().err
    shutil.rmtree(recording / "train/a/lidar")
    with pytest.raises(schema.DataError, match="no frame has a lidar scan"):
        voxelizing.voxelize(recording)
    assert not list(recording.glob("*/*/occupancy"))
    header = recording / plain_reader.DESCRIPTION_FILE
    header.write_text(header.read_text().partition("[voxels]")[0])
    with pytest.raises(schema.DataError, match=r"no section \[voxels\], the grid to fill; add one"):
        voxelizing.voxelize(recording)
    with pytest.raises(schema.DataError, match="is no recording whose occupancy can be made"):
        voxelizing.voxelize(tmp_path / "elsewhere")


def test_a_second_command_on_one_folder_is_told(recording):
    pytest.importorskip("fcntl")
    with (voxelizing.processes.locked(recording / ".voxelizing", "voxelizing"),
          pytest.raises(BlockingIOError, match="another process is voxelizing here now")):
        voxelizing.voxelize(recording, workers=1)


@pytest.fixture
def layout(tmp_path):
    """The first twelve frames of the sample's first run, as files; its data frame names all."""
    run = "trainval/train/Town01/0000"
    shutil.copytree(samples.MUVO_LAYOUT / run, tmp_path / run, ignore=lambda _, names: [
        name for name in names if name[-13:-4].isdigit() and int(name[-13:-4]) > 11])
    for path in (tmp_path, *tmp_path.rglob("*")):
        path.chmod(0o755)
    return tmp_path


def keep_rows(run, count, without=()):
    """Cuts a run's table down to its first rows; returns its columns."""
    columns = {name: cells[:count] for name, cells in safe_pickle.load_table(run / muvo_runs.FRAME_FILE).items()
               if name not in without}
    (run / muvo_runs.FRAME_FILE).write_bytes(voxelizing.frame_pickle.frame(columns))
    return columns


@needs_layout
def test_the_reference_rule_writes_the_authors_voxels(layout):
    run = layout / "trainval/train/Town01/0000"
    table = safe_pickle.load_table(run / muvo_runs.FRAME_FILE)
    shutil.rmtree(run / "voxel")
    columns = keep_rows(run, 12, without=("voxel_path",))
    assert voxelizing.voxelize(layout, rule="reference", workers=2) == (12, 0)
    for path in (run / "voxel").glob("*.npy"):
        assert path.read_bytes() == (samples.MUVO_LAYOUT / path.relative_to(layout)).read_bytes()
    written = safe_pickle.load_table(run / muvo_runs.FRAME_FILE)
    assert list(written) == list(table) and list(written["voxel_path"]) == list(table["voxel_path"][:12])
    for name in columns:
        for old, new in zip(columns[name], written[name], strict=True):
            np.testing.assert_array_equal(old, new)
    assert list(safe_pickle.load_table(run / voxelizing.ORIGINAL_FRAME_FILE)) == list(columns)


@needs_layout
def test_files_of_the_layout_may_have_any_name_that_the_reader_takes(layout):
    run = layout / "trainval/train/Town01/0000"
    keep_rows(run, 1)
    for kind, suffix in (("depth_semantic", ".PNG"), ("points_semantic", ".NPY")):
        for path in (run / kind).iterdir():
            path.rename(path.with_suffix(suffix))
    assert voxelizing.voxelize(layout, workers=1) == (1, 0)


@needs_layout
def test_carved_occupancy_of_the_layout_is_read_in_place_of_its_voxels(layout):
    run = layout / "trainval/train/Town01/0000"
    keep_rows(run, 12)
    opened = muvo_reader.MuvoRecording(layout)
    theirs = opened.read(opened.sequences[0], 1)["occupancy"]
    before = (run / "voxel/voxel_000000011.npy").read_bytes()
    assert voxelizing.voxelize(layout, workers=1).made == 12
    opened = muvo_reader.MuvoRecording(layout)
    frame = opened.read(opened.sequences[0], 1)
    ours = frame["occupancy"]
    assert set(np.unique(ours)) == {0, 1, 255}
    hit = np.floor((frame["points_m"] - opened.description.voxels.origin_m) / 0.5).astype(int)
    hit = hit[((hit >= 0) & (hit < ours.shape)).all(axis=1)]
    assert (ours[tuple(hit.T)] == 1).all()
    # Pixels are lifted half a pixel apart, so that hits at the borders of voxels differ.
    assert (ours == 1)[theirs == 1].mean() > 0.8
    assert (run / "voxel/voxel_000000011.npy").read_bytes() == before


def without_row(table, row):
    return {name: np.delete(cells, row, axis=0) if isinstance(cells, np.ndarray) else
            [cell for index, cell in enumerate(cells) if index != row] for name, cells in table.items()}


@needs_layout
@pytest.mark.parametrize("rule", voxelizing.RULES)
def test_frames_keep_their_occupancy_when_a_row_is_taken_out_of_the_table(layout, rule):
    run = layout / "trainval/train/Town01/0000"
    shutil.rmtree(run / "voxel")
    keep_rows(run, 4, without=("voxel_path",))
    assert voxelizing.voxelize(layout, rule=rule, workers=1) == (4, 0)
    whole = muvo_reader.MuvoRecording(layout, skipped_s=0.0)
    expected = whole.read(whole.sequences[0], 2)
    rest = without_row(safe_pickle.load_table(run / muvo_runs.FRAME_FILE), 1)
    (run / muvo_runs.FRAME_FILE).write_bytes(voxelizing.frame_pickle.frame(rest))
    assert voxelizing.voxelize(layout, rule=rule, workers=1) == (0, 3)
    with pytest.warns(schema.DataWarning, match="time jumps"):
        opened = muvo_reader.MuvoRecording(layout, skipped_s=0.0)
    frame = opened.read(opened.sequences[1], 0)
    for name in ("image", "occupancy"):
        np.testing.assert_array_equal(frame[name], expected[name])


@needs_layout
def test_voxels_of_the_layout_are_kept_by_their_form(layout):
    run = layout / "trainval/train/Town01/0000"
    keep_rows(run, 12)
    theirs = run / "voxel/voxel_000000003.npy"
    theirs.write_bytes(theirs.read_bytes()[:-8])  # an interrupted copy
    assert voxelizing.voxelize(layout, rule="reference", workers=1) == (1, 11)
    (run / "voxel/rule.json").unlink()
    np.save(theirs, np.zeros((192, 192, 64), np.uint8))
    with pytest.raises(FileExistsError, match=r"voxel_000000003\.npy: uint8 \[192, 192, 64\], .*--overwrite"):
        voxelizing.voxelize(layout, rule="reference", workers=1)


def test_the_sensors_of_the_recording_hold_for_any_folder_of_it(tmp_path):
    from_root, header_path = tmp_path / "muvo", tmp_path / "muvo/sensors.toml"
    (from_root / "trainval/val0/Town01").mkdir(parents=True)
    header_path.write_text("[voxels]\nshape = [96, 96, 32]\nvoxel_size_m = 1.0\norigin_m = [-48.0, -48.0, -6.0]\n")
    (from_root / "trainval/val0/Town01/0000").mkdir()
    (from_root / "trainval/val0/Town01/0000/pd_dataframe.pkl").touch()
    for folder in ("", "trainval", "trainval/val0", "trainval/val0/Town01", "trainval/val0/Town01/0000"):
        header, path = muvo_reader.read_sensors(from_root / folder)
        assert header["voxels"]["shape"] == [96, 96, 32] and path == header_path


def test_occupancy_of_another_grid_is_not_read(recording):
    voxelizing.voxelize(recording, workers=1)
    path = recording / "recording.toml"
    text = path.read_text()
    assert "voxel_size_m = 1\n" in text
    path.write_text(text.replace("voxel_size_m = 1\n", "voxel_size_m = 0.5\n"))
    told = r"made for .*'voxel_size_m': 1\.0.* described with .*'voxel_size_m': 0\.5"
    with pytest.raises(schema.DataError, match=told):
        plain_reader.PlainRecording(recording)
    path.write_text(text)
    (recording / "train/a/occupancy/rule.json").write_bytes(b"\xff{")
    with pytest.raises(schema.DataError, match=r"rule\.json: does not say by which rule and grid"):
        plain_reader.PlainRecording(recording)
    with pytest.raises(FileExistsError, match="--overwrite removes them"):
        voxelizing.voxelize(recording, workers=1)
    voxelizing.voxelize(recording, workers=1, overwrite=True)
    assert plain_reader.PlainRecording(recording).sequences


@pytest.mark.parametrize("held", ["..", "train", "train/a"])
def test_who_works_on_a_part_or_the_whole_keeps_others_out(recording, held):
    with (processes.locked((recording / held).resolve() / ".voxelizing", "voxelizing"),
          pytest.raises(BlockingIOError, match="another process is voxelizing here now")):
        voxelizing.voxelize(recording, workers=1)
