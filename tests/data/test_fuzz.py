"""Mutated files give our own errors or warnings, never another exception, whatever byte is wrong."""

import shutil
import warnings

import nuscenes_writer
import pytest
import recording_samples as samples
import recording_writers as writers
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from muvo_jax.data import schema, sources

FUZZ = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
PLAIN = ("recording.toml", "train/a/frames.csv", "train/a/image/000000.png", "train/a/lidar/000000.npz",
         "train/a/occupancy/000000.npz", "train/a/route_map/000000.png")
KITTI = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", f"{writers.DRIVE}/image_02/timestamps.txt",
         f"{writers.DRIVE}/image_02/data/0000000000.png", f"{writers.DRIVE}/velodyne_points/data/0000000000.bin",
         f"{writers.DRIVE}/oxts/data/0000000000.txt")
NUSCENES = (*(f"v1.0-mini/{name}.json" for name in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data",
                                                   "ego_pose")),
            "samples/CAM_FRONT/n000__CAM_FRONT__1532402927612460.jpg",
            f"samples/LIDAR_TOP/n000__LIDAR_TOP__{nuscenes_writer.START_US}.pcd.bin")
CARLA = ("pd_dataframe.pkl", "image/image_000000010.png", "points_semantic/points_semantic_000000010.npy",
         "voxel/voxel_000000010.npy", "routemap/routemap_000000010.png")

edits = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.sampled_from(["flip", "cut", "insert"]),
                           st.binary(min_size=1, max_size=8)), min_size=1, max_size=3)


def mutate(content, changes):
    content = bytearray(content)
    for place, kind, data in changes:
        position = int(place * len(content))
        if kind == "cut":
            del content[position:position + 4 ** len(data)]
        else:
            content[position:position + len(data) * (kind == "flip")] = data
    return bytes(content)


def read_first(root):
    """Opens a recording and reads its first frame; what the reader refuses, in its own words, or None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            recording = sources.open_recording(root)
            if recording.sequences:
                recording.read(recording.sequences[0], 0)
    except schema.DataError as error:
        return str(error)
    return None


def refusal_when_changed(root, name, changes):
    """`read_first` with one file mutated; any exception but a DataError gets through."""
    path = root / name
    original = path.read_bytes()
    path.write_bytes(mutate(original, changes))
    try:
        return read_first(root)
    finally:
        path.write_bytes(original)


def names_what_is_wrong(refusal, root):
    return refusal is None or str(root) in refusal


@pytest.fixture(scope="module")
def plain_root(tmp_path_factory):
    return writers.write_plain(tmp_path_factory.mktemp("plain") / "ein Ordner")


@pytest.fixture(scope="module")
def kitti_root(tmp_path_factory):
    return writers.write_kitti(tmp_path_factory.mktemp("kitti")).parent


@pytest.fixture(scope="module")
def nuscenes_root(tmp_path_factory):
    return nuscenes_writer.write(tmp_path_factory.mktemp("nuscenes") / "set", turns=11)


@pytest.fixture(scope="module")
def carla_root(tmp_path_factory):
    if samples.MUVO_LAYOUT is None:
        pytest.skip("no recording in the MUVO layout here; name one by MUVO_LAYOUT=FOLDER")
    root = tmp_path_factory.mktemp("carla") / "train/Town01/0000"
    shutil.copytree(samples.MUVO_LAYOUT / "trainval/train/Town01/0000", root, copy_function=shutil.copyfile)
    for folder in (root, *root.iterdir()):
        folder.chmod(0o755)
    return root


@pytest.mark.parametrize("name", PLAIN)
@FUZZ
@given(changes=edits)
def test_plain(plain_root, name, changes):
    assert names_what_is_wrong(refusal_when_changed(plain_root, name, changes), plain_root)


@pytest.mark.parametrize("name", KITTI)
@FUZZ
@given(changes=edits)
def test_kitti(kitti_root, name, changes):
    assert names_what_is_wrong(refusal_when_changed(kitti_root, name, changes), kitti_root)


@pytest.mark.parametrize("name", NUSCENES)
@FUZZ
@given(changes=edits)
def test_nuscenes(nuscenes_root, name, changes):
    assert names_what_is_wrong(refusal_when_changed(nuscenes_root, name, changes), nuscenes_root)


@pytest.mark.parametrize("name", CARLA)
@FUZZ
@given(changes=edits)
def test_muvo_layout(carla_root, name, changes):
    assert names_what_is_wrong(refusal_when_changed(carla_root, name, changes), carla_root)
