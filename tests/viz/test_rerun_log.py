"""The file for the Rerun viewer, read back: what was logged, when and where."""

import pathlib

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.ops import camera
from muvo_jax.viz import rerun_log, sheets

GRID = config_lib.VoxelGrid(shape=(16, 12, 8), voxel_size_m=1.0, origin_m=(-8.0, -6.0, -1.0))
SCENE = sheets.Scene(grid=GRID, frame_s=0.2)
FRAMES, CONTEXT = 3, 2


def view(frame):
    range_view = np.zeros((4, 8, 4), np.float32)
    range_view[..., 3] = -1.0
    range_view[0, : frame + 1] = (5.0, 1.0, 0.5, 5.1)
    occupancy = np.zeros(GRID.shape, np.uint8)
    occupancy[0, 0, : frame + 2] = 1
    return sheets.View(image=np.full((16, 32, 3), 50, np.uint8), range_view=range_view, occupancy=occupancy)


def test_what_was_logged_is_read_back(tmp_path):
    rerun = pytest.importorskip("rerun", reason="rerun-sdk (extra [viz]) is not installed")
    views = [view(frame) for frame in range(FRAMES)]
    batch = types.Batch(action=np.array([[[0.5, -0.5], [0.25, 0.0], [0.0, 1.0]]], np.float32),
                        is_first=np.zeros((1, FRAMES), bool), image=np.stack([one["image"] for one in views])[None],
                        intrinsics=camera.intrinsics_from_fov(32, 16, 1.5)[None],
                        camera_to_ego=camera.level_camera_to_ego((1.0, 0.0, 2.0))[None])
    log = rerun_log.RerunLog(tmp_path / "new" / "dream.rrd")
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.5, 0.1]])
    log.window(batch, {"truth": views, "world model": views}, SCENE, context=CONTEXT, poses=poses)
    log.window(batch, {"truth": views}, SCENE, context=CONTEXT, name="val_rl")
    path = log.close()

    found = read(rerun, path)
    for source in ("truth", "world_model"):
        points = found[f"/ego/{source}/points", "Points3D:positions"]
        assert [len(cell) for cell in points] == [1, 2, 3]
        np.testing.assert_allclose(points[2][0], [5.0, 1.0, 0.5])
        voxels = found[f"/ego/{source}/voxels", "Boxes3D:centers"]
        assert [len(cell) for cell in voxels] == [2, 3, 4]
        np.testing.assert_allclose(voxels[0][0], [-7.5, -5.5, -0.5])
        assert len(found[f"/ego/{source}/camera/image", "EncodedImage:blob"]) == FRAMES
    assert [cell[0] for cell in found["/action/steering", "Scalars:scalars"]] == [-0.5, 0.0, 1.0]
    assert [cell[0] for cell in found["/phase", "TextLog:text"]] == ["observed", "observed", "imagined"]
    np.testing.assert_allclose(found["/ego", "Transform3D:translation"][2][0], [4.0, 0.5, 0.0])
    np.testing.assert_allclose(found["/path", "LineStrips3D:strips"][0][0], [[0, 0, 0], [2, 0, 0], [4, 0.5, 0]])
    assert ("/val_rl/ego/truth/points", "Points3D:positions") in found
    assert ("/val_rl/path", "LineStrips3D:strips") not in found
    np.testing.assert_allclose(found["times_s"], [-0.2, 0.0, 0.2], atol=1e-9)


def read(rerun, path):
    """{(entity, component): the cells of all rows in the order of time}, with "times_s" of the steering."""
    cells, times_s = {}, {}
    for chunk in rerun.chunk.RrdReader(path).stream():
        columns = chunk.to_record_batch().to_pydict()
        places = columns.get("frame", range(chunk.num_rows))
        if chunk.entity_path == "/action/steering":
            times_s |= zip(places, (time.total_seconds() for time in columns["time"]), strict=True)
        for name, values in columns.items():
            cells.setdefault((chunk.entity_path, name), {}).update(zip(places, values, strict=True))
    in_order = lambda by_place: [by_place[place] for place in sorted(by_place)]
    return {key: in_order(by_place) for key, by_place in cells.items()} | {"times_s": in_order(times_s)}


def test_a_missing_library_and_a_wrong_name_are_said_before_anything_takes_long(monkeypatch):
    with pytest.raises(ValueError, match=r"pip install 'muvo_jax\[viz\]'|expected the name of a file FILE.rrd"):
        rerun_log.check(pathlib.Path("dream.gif"))
    monkeypatch.setattr(rerun_log.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'muvo_jax\[viz\]'"):
        rerun_log.check(pathlib.Path("dream.rrd"))
