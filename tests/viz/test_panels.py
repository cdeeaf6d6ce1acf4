"""Pictures: orientation, colours, tags and files. (How they look has to be looked at.)"""

import numpy as np
import pytest
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.agents import rewards
from muvo_jax.viz import canvas, curves, panels, sheets

GRID = config_lib.VoxelGrid(shape=(16, 12, 8), voxel_size_m=1.0, origin_m=(-8.0, -6.0, -1.0))
SCENE = sheets.Scene(grid=GRID, frame_s=0.2)


def _view(seed=0):
    rng = np.random.default_rng(seed)
    range_view = rng.uniform(1.5, 30.0, (8, 32, 4)).astype(np.float32)
    range_view[:2] = (0.0, 0.0, 0.0, -1.0)
    return sheets.View(image=rng.integers(0, 255, (32, 64, 3), dtype=np.uint8), range_view=range_view,
                       occupancy=rng.integers(0, 2, GRID.shape).astype(np.uint8))


def _is_colour(pixel, colour):
    return tuple(int(value) for value in pixel) == tuple(colour)


def test_colour_map_meets_its_anchors_and_clips():
    anchors = ((0, 0, 0), (100, 0, 0), (100, 200, 0))
    colours = canvas.colour_map(np.array([-1.0, 0.0, 0.25, 0.5, 1.0, 2.0, np.nan]), anchors)
    np.testing.assert_array_equal(
        colours, [(0, 0, 0), (0, 0, 0), (50, 0, 0), (100, 0, 0), (100, 200, 0), (100, 200, 0), (0, 0, 0)])


@pytest.mark.parametrize(("kinematics", "rear_m", "front_m"), [
    ("bicycle", rewards.EgoBox().rear_m, rewards.EgoBox().front_m), ("none", -2.3, 2.3)])
def test_the_car_is_drawn_where_it_is(kinematics, rear_m, front_m):
    ego_m = panels.ego_of(config_lib.ActionContract(kinematics=kinematics))
    for picture in (panels.birds_eye(np.zeros((0, 3)), extent_m=8.0, side_px=480, ego_m=ego_m),
                    panels.occupancy_from_above(np.zeros(GRID.shape, np.uint8), GRID, columns_px=360, ego_m=ego_m)):
        rows = np.flatnonzero((picture == panels.EGO).all(axis=-1).any(axis=1))
        np.testing.assert_allclose(8.0 - rows[[-1, 0]] / 30.0, [rear_m, front_m], atol=0.05)


def test_camera_clips_predictions_and_keeps_recorded_pixels():
    recorded = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert panels.camera(recorded) is recorded
    np.testing.assert_array_equal(panels.camera(np.array([[[-0.5, 0.5, 1.5]]])), [[[0, 128, 255]]])


def test_range_image_shows_holes_as_no_return_and_near_brighter_than_far():
    range_view = np.zeros((1, 3, 4), np.float32)
    range_view[0, :, 3] = (-1.0, 2.0, 50.0)
    hole, near, far = panels.range_image(range_view, far_m=60.0)[0]
    assert _is_colour(hole, panels.NO_RETURN)
    assert near.astype(int).sum() > far.astype(int).sum()


def test_birds_eye_puts_forward_up_and_left_left():
    picture = panels.birds_eye(np.array([[8.0, 0.05, 1.0], [0.05, 8.0, 1.0]]), extent_m=10.0, side_px=100)
    colour = canvas.colour_map(panels.height_fraction(np.array(1.0), (0.0, 6.0)), canvas.HEIGHT_COLOURS)
    rows, columns = np.nonzero((picture == colour).all(axis=-1))
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(10, 49), (49, 10)]


def test_birds_eye_leaves_out_points_outside_and_not_finite():
    empty = panels.birds_eye(np.zeros((0, 3)), extent_m=10.0)
    strange = np.array([[np.nan, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, -np.inf, 0.0]])
    np.testing.assert_array_equal(panels.birds_eye(strange, extent_m=10.0), empty)


def test_occupancy_from_above_shows_the_highest_voxel_and_what_is_unknown():
    occupancy = np.zeros(GRID.shape, np.uint8)
    occupancy[15, 11, 1] = occupancy[15, 11, 5] = 1  # farthest ahead, farthest left
    occupancy[0, 0, :] = 255  # behind, right
    picture = panels.occupancy_from_above(occupancy, GRID)
    height_m = GRID.origin_m[2] + 5.5 * GRID.voxel_size_m
    colour = canvas.colour_map(panels.height_fraction(np.array(height_m), panels.height_span(GRID)),
                               canvas.HEIGHT_COLOURS)
    assert _is_colour(picture[0, 0], colour)
    assert _is_colour(picture[-1, -1], panels.UNKNOWN)
    assert _is_colour(picture[0, -1], panels.NO_RETURN)


def test_view_from_behind_hides_far_voxels_behind_near_ones():
    occupancy = np.zeros(GRID.shape, np.uint8)
    sky = panels.occupancy_from_behind(occupancy, GRID, size_px=(40, 80))
    assert (sky == np.array(panels.SKY, np.uint8)).all()
    occupancy[12, 4:8, :6] = 1  # a wall ahead
    wall = panels.occupancy_from_behind(occupancy, GRID, size_px=(40, 80))
    occupancy[14, 5:7, :4] = 1  # lower and behind it
    np.testing.assert_array_equal(panels.occupancy_from_behind(occupancy, GRID, size_px=(40, 80)), wall)
    assert (wall != sky).any()
    occupancy[9, 9:11, :3] = 1  # nearer, on the left
    left = (panels.occupancy_from_behind(occupancy, GRID, size_px=(40, 80)) != wall).any(axis=(0, 2))
    assert left.any() and not left[40:].any()


def test_march_agrees_with_small_steps_along_each_ray():
    rng = np.random.default_rng(3)
    occupied = rng.random(GRID.shape) < 0.05
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    eye_m = np.array([-12.0, 0.3, 2.1])
    voxel, axis, _ = panels._march(occupied, GRID, eye_m, directions)
    for ray, direction in enumerate(directions):
        points = eye_m + direction * np.arange(0.0, 40.0, 0.001)[:, None]
        cells = np.floor((points - np.array(GRID.origin_m)) / GRID.voxel_size_m).astype(int)
        cells = cells[((cells >= 0) & (cells < np.array(GRID.shape))).all(axis=1)]
        hits = cells[occupied[tuple(cells.T)]]
        assert (axis[ray] == 3) == (len(hits) == 0)
        if len(hits):
            np.testing.assert_array_equal(voxel[ray], hits[0])


def test_action_bars_grow_to_the_side_of_the_action():
    left, right = (panels.action_bars(np.array([0.0, steering]), 200, labels=False) for steering in (-1.0, 1.0))
    blue = np.array(canvas.OBSERVED, np.uint8)
    assert (left[:, :90] == blue).all(axis=-1).any() and not (left[:, 110:] == blue).all(axis=-1).any()
    assert (right[:, 110:] == blue).all(axis=-1).any() and not (right[:, :90] == blue).all(axis=-1).any()


@pytest.mark.parametrize("badge", ["observed", "imagined"])
def test_every_animation_frame_carries_its_badge(badge):
    picture = sheets.dream_frame([("truth", _view()), ("world model", _view(1))], SCENE, badge=badge,
                                 caption="+0.2 s", action=np.zeros(2))
    assert (picture == np.array(canvas.TAG_COLOURS[badge], np.uint8)).all(axis=-1).any()
    other = canvas.TAG_COLOURS["imagined" if badge == "observed" else "observed"]
    assert not (picture == np.array(other, np.uint8)).all(axis=-1)[:40].any()


def test_write_dream_writes_readable_files_of_every_frame(tmp_path):
    views = [_view(seed) for seed in range(4)]
    paths = sheets.write_dream(tmp_path, views, {"world model": views}, np.zeros((4, 2)), SCENE, context=2, title="t")
    assert sorted(path.name for path in paths) == ["dream.gif", "dream_sensors.png", "dream_space.png"]
    with Image.open(tmp_path / "dream.gif") as animation:
        assert animation.n_frames == 4
    for path in paths[1:]:
        with Image.open(path) as picture:
            picture.verify()
    assert not list(tmp_path.glob("*.part"))


def test_a_baseline_stands_beside_the_dream_on_every_sheet(tmp_path):
    """Without the optional maps, which it does not predict: there its place stays empty."""
    maps = {"depth": np.ones((4, 8), np.float32)}
    views = [_view(seed) | maps for seed in range(2)]
    sizes = []
    for beside in ({}, {"warp-last": [_view(2), _view(3)]}):
        paths = sheets.write_dream(tmp_path, views, {"world model": views}, np.zeros((2, 2)), SCENE, context=1,
                                   title="t", beside=beside)
        sizes.append([Image.open(path).size for path in paths])
    (animation, sensors, space), (wider, wider_sensors, taller_space) = sizes
    assert wider[0] > animation[0] and wider_sensors[0] > sensors[0] and wider_sensors[1] == sensors[1]
    assert taller_space[1] > space[1] and taller_space[0] == space[0]


def test_of_one_moment_the_last_is_shown(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(sheets, "sensor_sheet", lambda moments, *_, **__: shown.extend(moments))
    views = [_view(seed) for seed in range(4)]
    sheets.write_dream(tmp_path, views, {"world model": views}, np.zeros((4, 2)), SCENE, context=2, title="t",
                       most_moments=1, animate=False)
    assert [moment.badge for moment in shown] == ["imagined"] and shown[0].truth is views[3]


def test_a_recording_with_a_camera_alone_has_no_space_sheet(tmp_path):
    views = [sheets.View(image=_view()["image"])] * 2
    paths = sheets.write_dream(tmp_path, views, {"world model": views}, np.zeros((2, 2)), SCENE, context=1, title="t")
    assert sorted(path.name for path in paths) == ["dream.gif", "dream_sensors.png"]


def test_views_of_frames_picks_the_sample():
    frames = {"image": np.zeros((2, 3, 4, 4, 3)), "occupancy": np.ones((2, 3, 2, 2, 2), bool)}
    frames["image"][1] = 1.0
    views = sheets.views_of_frames(frames, 1)
    assert len(views) == 3 and views[0]["image"].min() == 1.0 and "range_view" not in views[0]
    assert views[2]["occupancy"].dtype == np.uint8


def test_curves_leave_gaps_and_survive_constant_and_missing_values(tmp_path):
    plots = [curves.curve({"train": ([0, 1, 2, 3], [1.0, float("nan"), 0.5, 0.5])}, "loss", logarithmic=True),
             curves.curve({"train": ([5], [0.0])}, "constant"),
             curves.curve({"train": ([0], [float("nan")])}, "nothing")]
    path = curves.write_curves(tmp_path / "curves.png", plots, "run", per_row=2)
    with Image.open(path) as picture:
        assert picture.width > plots[0].shape[1]


def test_nothing_to_draw_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no plots"):
        curves.write_curves(tmp_path / "a.png", [], "run")


def test_optional_maps_have_panels_where_truth_has_them_too(tmp_path):
    classes = np.array([[0, 1], [2, 255]], np.uint8)
    picture = panels.class_image(classes)
    assert len({tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}) == 4 and not picture[1, 1].any()
    plan = panels.ground_plan(np.array([[0, 0], [3, 0]], np.uint8), 2)  # a vehicle ahead on the right
    np.testing.assert_array_equal(plan[0, 1], panels.class_image(np.array([3], np.uint8))[0])
    maps = {"depth": np.ones((4, 8), np.float32), "semantic_image": np.ones((4, 8), np.uint8),
            "birds_eye": np.ones((4, 4), np.uint8)}
    truth, dream = sheets.View(**maps), sheets.View(**maps, semantic_range_view=np.ones((4, 8), np.uint8))
    sizes = []
    for view in (truth, sheets.View(depth=maps["depth"])):
        paths = sheets.write_dream(tmp_path, [view] * 2, {"world model": [dream] * 2}, np.zeros((2, 2)), SCENE,
                                   context=1, title="t", animate=False)
        sizes.append({path.name: Image.open(path).height for path in paths})
    assert set(sizes[0]) == {"dream_sensors.png", "dream_space.png"} and set(sizes[1]) == {"dream_sensors.png"}
    assert sizes[0]["dream_sensors.png"] > sizes[1]["dream_sensors.png"]
