"""The reader of the MUVO layout, on recordings that the authors' own writer made (skipped where there are none)."""

import shutil

import numpy as np
import pytest
import recording_samples as samples

from muvo_jax import presets
from muvo_jax.data import fitting, schema, sources
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs

pytestmark = pytest.mark.skipif(samples.MUVO_LAYOUT is None,
                                reason="no recording in the MUVO layout here; name one by MUVO_LAYOUT=FOLDER")


@pytest.fixture
def layout(tmp_path):
    """A copy that may be damaged, in a folder with a space and an accent in its name."""
    target = tmp_path / "enregistré à Köln" / "muvo"
    run = "trainval/train/Town01/0000"
    shutil.copytree(samples.MUVO_LAYOUT / run, target / run)
    for path in (target, *target.rglob("*")):
        path.chmod(0o755)
    return target


@pytest.fixture
def run_folder(layout):
    return layout / "trainval/train/Town01/0000"


def test_every_level_of_the_tree_is_recognised():
    root = samples.MUVO_LAYOUT
    recording = sources.open_recording(root)
    assert recording.description.kind == "MUVO CARLA" and recording.description.splits[0] == "train"
    names = {sequence.name for sequence in recording.sequences}
    assert {sequence.name for sequence in sources.open_recording(root / "trainval").sequences} == names
    for below in ("trainval/train", "trainval/train/Town01", "trainval/train/Town01/0000"):
        found = {sequence.name for sequence in sources.open_recording(root / below).sequences}
        assert found == {name for name in names if name.startswith("train/")}


def test_runs_of_little_reward_and_the_first_second_are_left_out():
    recording = muvo_reader.MuvoRecording(samples.MUVO_LAYOUT)
    every = muvo_runs.find_runs(samples.MUVO_LAYOUT)
    low = {run.name for run in every if run.mean_reward < 0.6}
    assert low.isdisjoint(sequence.name for sequence in recording.sequences)
    assert any(f"{len(low)} of {len(every)} runs are left out" in note for note in recording.description.notes)
    assert {sequence.start for sequence in recording.sequences} == {10}
    everything = muvo_reader.MuvoRecording(samples.MUVO_LAYOUT, min_mean_reward=-np.inf, skipped_s=0.0)
    assert sum(sequence.length for sequence in everything.sequences) == sum(run.frames for run in every)


def test_a_frame(run_folder):
    recording = sources.open_recording(run_folder)
    sequence = recording.sequences[0]
    frame = recording.read(sequence, 3)
    run = recording.run(sequence.name)
    throttle, steer, brake = run.columns["action"][13]
    np.testing.assert_array_equal(frame["action"], np.float32([throttle if throttle > 0 else -brake, steer]))
    np.testing.assert_array_equal(recording.action(sequence, 3), frame["action"])
    assert frame["frame_id"] == 13 and frame["timestamp_s"] == pytest.approx(1.3)
    assert frame["speed_mps"] == run.columns["speed"][13][0]
    camera = recording.description.camera
    assert frame["image"].shape == (camera.height_px, camera.width_px, 3)
    # Field of view 110 degrees: half the width over the tangent of 55 degrees.
    assert frame["intrinsics"][0, 0] == pytest.approx(camera.width_px / 2 / np.tan(np.radians(55)), rel=1e-6)
    assert not muvo_files.in_ego_box(frame["points_m"]).any()
    assert set(np.unique(frame["occupancy"])) == {0, 1} and frame["occupancy"].shape == (192, 192, 64)
    assert frame["route_map"].shape == (64, 64) and set(np.unique(frame["route_map"])) == {0, 255}


def test_points_lie_in_the_voxels_that_were_made_from_them(run_folder):
    """The frames of points and voxels agree: lidar returns lie in occupied voxels."""
    recording = sources.open_recording(run_folder)
    frame = recording.read(recording.sequences[0], 0)
    grid = recording.description.voxels
    index = np.floor((frame["points_m"] - np.float32(grid.origin_m)) / np.float32(grid.voxel_size_m)).astype(int)
    inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
    assert inside.sum() > 500
    assert frame["occupancy"][tuple(index[inside].T)].mean() > 0.95


def test_other_sensors_are_described_beside_the_data(layout):
    (layout / "sensors.toml").write_text(
        "rate_hz = 20\n[lidar]\nrows = 32\nelevation_min_rad = -0.3\nposition_m = [0.0, 0.5, 1.8]\n")
    shutil.rmtree(layout / "trainval/train/Town01/0000/voxel")
    recording = sources.open_recording(layout)
    assert recording.description.rate_hz == 20 and recording.description.contract.rate_hz == 20
    frame = recording.read(recording.sequences[0], 0)
    assert "occupancy" not in frame and recording.sequences[0].start == 20
    path = layout / "trainval/train/Town01/0000" / muvo_files.file_name("points_semantic", 20)
    default = muvo_files.read_points(path, (1.0, 0.0, 2.0)).points_m
    # The lidar sits 1 m further back, 0.5 m to the left and 0.2 m lower; boxes differ, so compare far points.
    ours = frame["points_m"]
    assert np.isclose(ours[:, 0].max(), default[:, 0].max() - 1.0) and np.isclose(ours[:, 1].max(),
                                                                                 default[:, 1].max() + 0.5)
    config = fitting.adapt(presets.get("tiny"), recording).config
    assert config.model.range_view.elevation_min_rad == -0.3
    assert config.model.range_view.position_m == (0.0, 0.5, 1.8)


def test_a_missing_frame_splits_the_sequence_and_is_counted(run_folder):
    (run_folder / "points_semantic/points_semantic_000000015.npy").unlink()
    with pytest.warns(schema.DataWarning, match="1 of 30 frames are left out .*1 in points_semantic"):
        recording = sources.open_recording(run_folder)
    assert [(s.start, s.length) for s in recording.sequences] == [(10, 5), (16, 14)]


def test_a_run_without_data_frame_is_counted(layout):
    (layout / "trainval/train/Town01/0001/image").mkdir(parents=True)
    with pytest.warns(schema.DataWarning, match=r"1 of 2 runs have no pd_dataframe\.pkl"):
        recording = sources.open_recording(layout)
    assert len(recording.sequences) == 1


def test_paths_out_of_the_run_are_refused(layout, run_folder):
    path = run_folder / muvo_runs.FRAME_FILE
    path.write_bytes(path.read_bytes().replace(b"image/image_000000007.png", b"../../../../../etc/passwd"))
    with pytest.raises(schema.DataError, match=r"row 7: image_path is .*inside the run"):
        sources.open_recording(layout)


@pytest.mark.parametrize(("damage", "message"), [
    (lambda run: (run / "image/image_000000010.png").write_bytes(b""), "image_000000010.png: not a readable image"),
    (lambda run: shutil.copy(run / "routemap/routemap_000000010.png", run / "image/image_000000010.png"),
     "192x192 pixels, the recording's first image has"),
    (lambda run: np.save(run / "points_semantic/points_semantic_000000010.npy", np.zeros(3)), "expected a dict"),
    (lambda run: np.save(run / "points_semantic/points_semantic_000000010.npy",
                         {"points_xyz": np.zeros((4, 3)), "ObjTag": np.zeros(3, np.uint8)}), "ObjTag is no array of 4"),
    (lambda run: np.save(run / "voxel/voxel_000000010.npy", np.array([[192, 0, 0, 7]], np.uint16)),
     r"voxel \[192\s+0\s+0\] lies outside a grid"),
    (lambda run: np.save(run / "voxel/voxel_000000010.npy", np.zeros((4, 3))), r"expected whole numbers \[M, 4\]"),
])
def test_damaged_frames(run_folder, damage, message):
    recording = sources.open_recording(run_folder)
    damage(run_folder)
    with pytest.raises(schema.DataError, match=message):
        recording.read(recording.sequences[0], 0)


def test_tags_of_newer_simulators_are_occupied():
    tags = np.array([0, 13, 1, 22, 28, 255])
    assert muvo_files.is_occupied(tags).tolist() == [False, False, True, True, True, False]


def test_depth_goes_there_and_back():
    depth_m = np.array([[0.0, 0.5, 73.21, 999.99, np.inf]])
    back_m = 1000 * muvo_files.decode_depth(muvo_files.encode_depth(depth_m))
    np.testing.assert_allclose(back_m, [[0.0, 0.5, 73.21, 999.99, 1000.0]], atol=1e-4)
