"""Moved views against what is known in closed form: walls, flat ground, a textured plane, the sky, whole voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.geometry import RangeViewGeometry, VoxelGrid
from muvo_jax.ops import camera, range_view, reproject

pytestmark = pytest.mark.usefixtures("strict_dtypes")
# As many pixels in all as keep compiling and running short; the lidar off the origin, so that its place counts.
GEOMETRY = RangeViewGeometry(rows=32, columns=128, position_m=(1.0, 0.0, 2.0))
GRID = VoxelGrid((12, 10, 4), 1.0, (-6.0, -5.0, -1.0))
WALL_M = 10.0
HOLE = np.array([0.0, 0.0, 0.0, -1.0], np.float32)
LIDAR_M = np.asarray(GEOMETRY.position_m, np.float32)


def seen(distance_m):
    """Range view [rows, columns, 4] of what is `distance_m` [rows, columns] along each beam, infinite where nothing."""
    points_m = range_view.beam_directions(GEOMETRY) * np.where(np.isfinite(distance_m), distance_m, 0.0)[..., None]
    view = np.concatenate([points_m + LIDAR_M, distance_m[..., None]], axis=-1)
    return np.where(np.isfinite(distance_m)[..., None], view, HOLE).astype(np.float32)


def wall(ahead_m=WALL_M, ground=False):
    """The scan of an endless upright wall `ahead_m` in front of the ego, and of the road where that is asked for."""
    beams = range_view.beam_directions(GEOMETRY)
    with np.errstate(divide="ignore"):
        to_wall = np.where(beams[..., 0] > 0.05, (ahead_m - LIDAR_M[0]) / beams[..., 0], np.inf)
        to_ground = np.where(beams[..., 2] < 0, -LIDAR_M[2] / beams[..., 2], np.inf)
    return seen(np.minimum(to_wall, to_ground) if ground else to_wall)


def pose(*values):
    return jnp.asarray([values], jnp.float32)


STILL = pose(0.0, 0.0, 0.0)
move_range_view = jax.jit(reproject.move_range_view, static_argnums=2)


def random_scan(seed=0):
    random = np.random.default_rng(seed)
    shape = (GEOMETRY.rows, GEOMETRY.columns)
    return seen(np.where(random.random(shape) < 0.2, np.inf, random.uniform(2.0, 30.0, shape)))


def test_a_scan_that_stands_still_is_itself():
    scan = random_scan()
    np.testing.assert_allclose(move_range_view(scan[None], STILL, GEOMETRY)[0], scan, atol=1e-4)


@pytest.mark.parametrize("forward_m", [0.5, 3.0])
def test_a_wall_is_nearer_by_what_was_driven(forward_m):
    moved = np.asarray(move_range_view(wall()[None], pose(forward_m, 0.0, 0.0), GEOMETRY)[0])
    points_m = range_view.to_points(moved)
    assert len(points_m) > 1000
    np.testing.assert_allclose(points_m[:, 0], WALL_M - forward_m, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(points_m - LIDAR_M, axis=1), moved[..., 3][moved[..., 3] > 0], rtol=1e-5)


def test_turning_left_moves_the_world_right_by_whole_columns():
    # A lidar at the origin of the ego frame turns on the spot.
    columns, centred = 16, RangeViewGeometry(rows=32, columns=128, position_m=(0.0, 0.0, 2.0))
    scan = random_scan()
    scan = np.where(scan[..., 3:] > 0, scan - np.array([1.0, 0.0, 0.0, 0.0], np.float32), HOLE)
    turned = move_range_view(scan[None], pose(0.0, 0.0, columns * 2 * np.pi / GEOMETRY.columns), centred)[0]
    np.testing.assert_allclose(turned[..., 3], np.roll(scan[..., 3], columns, axis=1), rtol=1e-5)


def far_from_edges(points_m):
    """Whether float32 and float64 agree on the pixel, which lies in the field of view (project keeps the others)."""
    x, y, z = (points_m - LIDAR_M).astype(np.float64).T
    row, column = range_view._image_coordinates(x, y, z, GEOMETRY)
    off = lambda value: np.abs(value - np.round(value)) > 1e-3
    return off(row) & off(column) & (row > 0) & (row < GEOMETRY.rows)


def test_the_nearest_point_wins_as_where_scans_are_made():
    points_m = np.random.default_rng(1).uniform((-20, -20, 0), (20, 20, 5), (20_000, 3)).astype(np.float32)
    points_m = points_m[far_from_edges(points_m)][:15_000]
    valid = np.random.default_rng(2).random(len(points_m)) < 0.8
    got = jax.jit(reproject.splat, static_argnums=2)(points_m[None], valid[None], GEOMETRY)[0]
    want = range_view.project(points_m[valid], GEOMETRY)
    np.testing.assert_allclose(got, want, atol=1e-4)
    assert (want[..., 3] > 0).mean() > 0.5


def test_what_leaves_the_field_of_view_is_gone():
    points_m = np.array([[[5.0, 0.0, 20.0], [5.0, 0.0, 2.0]]], np.float32)
    got = np.asarray(reproject.splat(points_m, np.ones((1, 2), bool), GEOMETRY)[0])
    assert (got[..., 3] > 0).sum() == 1 and got[..., 3].max() == pytest.approx(4.0)


def test_one_range_has_the_gradient_of_finite_differences():
    scan = seen(np.full((GEOMETRY.rows, GEOMETRY.columns), np.inf))
    scan[20, 60] = seen(np.full((GEOMETRY.rows, GEOMETRY.columns), 9.0))[20, 60]
    where = jnp.array([0.4, -0.2, 0.1])
    range_m = jax.jit(lambda where: move_range_view(scan[None], where[None], GEOMETRY)[..., 3].max())
    got = jax.jit(jax.grad(range_m))(where)
    steps = 1e-2 * np.eye(3, dtype=np.float32)
    want = [(range_m(where + step) - range_m(where - step)) / 2e-2 for step in steps]
    np.testing.assert_allclose(got, want, atol=5e-3)
    assert got[0] < -0.5  # driving on brings it nearer


TEXTURE = lambda y_m, z_m: 0.5 + 0.25 * np.sin(1.1 * y_m) + 0.2 * np.cos(0.9 * z_m + 0.5)
SIZE = (32, 64)
INTRINSICS = camera.intrinsics_from_fov(SIZE[1], SIZE[0], np.deg2rad(70.0))
CAMERA = camera.level_camera_to_ego((0.5, 0.0, 1.6))


def picture(at=(0.0, 0.0, 0.0), ahead_m=WALL_M):
    """float32 [H, W, 3]: the textured wall as a pinhole camera sees it; of whatever distance, it looks alike from 0."""
    rays = camera.depth_to_points(np.ones(SIZE, np.float32), INTRINSICS, CAMERA).astype(np.float64) - CAMERA[:3, 3]
    cosine, sine = np.cos(at[2]), np.sin(at[2])
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    origin, rays = turn @ CAMERA[:3, 3] + np.array([at[0], at[1], 0.0]), rays @ turn.T
    hit = origin + rays * ((ahead_m - origin[0]) / rays[:, 0])[:, None]
    grey = TEXTURE(*(hit[:, 1:] * WALL_M / ahead_m).T).reshape(SIZE)
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.float32)


move_image = jax.jit(reproject.move_image, static_argnums=5)


def moved_picture(image, at, range_m):
    return [np.asarray(value[0]) for value in move_image(
        image[None], range_m[None], pose(*at), INTRINSICS[None], CAMERA[None], GEOMETRY)]


@pytest.mark.parametrize("scan", [wall(), random_scan()])
def test_a_picture_that_stands_still_is_itself_whatever_the_ranges(scan):
    image = np.random.default_rng(0).random((*SIZE, 3), np.float32)
    same, inside = moved_picture(image, (0.0, 0.0, 0.0), scan[..., 3])
    np.testing.assert_allclose(same[1:-1, 1:-1], image[1:-1, 1:-1], atol=2e-3)
    assert inside[1:-1, 1:-1].all()


@pytest.mark.parametrize("at", [(3.0, 0.0, 0.0), (1.0, 0.5, 0.0), (2.0, -0.3, 0.15)])
def test_a_textured_wall_looks_as_it_does_from_there(at):
    cosine, sine = np.cos(at[2]), np.sin(at[2])
    beams = range_view.beam_directions(GEOMETRY)
    # How far the wall is along the new place's beams.
    lidar_x_m = cosine * LIDAR_M[0] - sine * LIDAR_M[1] + at[0]
    ahead = cosine * beams[..., 0] - sine * beams[..., 1]
    range_m = np.where(ahead > 0.05, (WALL_M - lidar_x_m) / np.maximum(ahead, 0.05), -1.0).astype(np.float32)
    got, inside = moved_picture(picture(), at, range_m)
    want = picture(at)
    assert inside.mean() > 0.75
    error = np.abs(got - want)[inside]
    assert error.mean() < 0.01 and error.max() < 0.06, (error.mean(), error.max())
    assert np.abs(picture() - want)[inside].mean() > 5 * error.mean()


def test_pure_turning_moves_the_picture_of_the_sky_too():
    nothing = np.full((GEOMETRY.rows, GEOMETRY.columns), -1.0, np.float32)
    at = (0.0, 0.0, 0.1)
    got, inside = moved_picture(picture(ahead_m=1e5), at, nothing)
    want = picture(at, ahead_m=1e5)
    assert 0.7 < inside.mean() < 1.0 and np.abs(got - want)[inside].max() < 0.02


def test_the_sky_turns_and_does_not_come_nearer():
    scan = np.full((GEOMETRY.rows, GEOMETRY.columns), 5.0)
    scan[4:10, 60:70] = np.inf
    scan = seen(scan)[None]
    sky = jax.jit(reproject.move_sky, static_argnums=2)
    hole = scan[0, ..., 3] < 0
    np.testing.assert_array_equal(sky(scan, pose(2.0, 0.3, 0.0), GEOMETRY)[0], hole)
    turned = sky(scan, pose(0.0, 0.0, 8 * 2 * np.pi / GEOMETRY.columns), GEOMETRY)[0]
    np.testing.assert_array_equal(turned, np.roll(hole, 8, axis=1))


move_voxels = jax.jit(reproject.move_voxels, static_argnums=2)


@pytest.mark.parametrize(("at", "shift"), [((2.0, 0.0, 0.0), (2, 0)), ((-1.0, 3.0, 0.0), (-1, 3))])
def test_whole_voxels_are_a_shift_and_nothing_comes_from_beyond_the_grid(at, shift):
    values = np.random.default_rng(0).random((1, *GRID.shape), np.float32)
    got = move_voxels(values, pose(*at), GRID)[0]
    padded = np.pad(values[0], ((3, 3), (3, 3), (0, 0)))
    rows, columns = GRID.shape[:2]
    want = padded[3 + shift[0]:3 + shift[0] + rows, 3 + shift[1]:3 + shift[1] + columns]
    np.testing.assert_allclose(got, want, atol=1e-5)


def test_voxels_that_stand_still_are_themselves_and_those_far_away_are_nothing():
    values = np.random.default_rng(0).random((1, *GRID.shape), np.float32)
    np.testing.assert_allclose(move_voxels(values, STILL, GRID), values, atol=1e-6)
    np.testing.assert_array_equal(move_voxels(values, pose(1e6, -1e6, 40.0), GRID), 0.0)


def test_of_several_views_each_result_looks_at_the_one_that_is_named():
    values = np.random.default_rng(0).random((2, *GRID.shape), np.float32)
    where, which = jnp.concatenate([pose(1.0, 0.5, 0.1), pose(0.2, 0.0, 0.0), STILL]), jnp.array([1, 1, 0])
    chosen = reproject.move_voxels(values, where, GRID, which=which)
    np.testing.assert_allclose(chosen, reproject.move_voxels(values[np.asarray(which)], where, GRID), atol=1e-6)
    images, scan = np.random.default_rng(0).random((2, *SIZE, 3), np.float32), wall()[..., 3]
    repeat = lambda array, count: np.stack([array] * count)
    calibration = (repeat(INTRINSICS, 3), repeat(CAMERA, 3), GEOMETRY)
    got, _ = reproject.move_image(images, repeat(scan, 3), where, *calibration, which)
    want, _ = reproject.move_image(images[np.asarray(which)], repeat(scan, 3), where, *calibration)
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_a_voxel_with_a_return_in_it_is_hit():
    points_m = np.array([[[-5.5, -4.5, -0.5], [5.9, 4.9, 2.9], [0.0, 0.0, 0.0], [6.1, 0.0, 0.0]]], np.float32)
    hits = reproject.hit_voxels(points_m, np.array([[True, True, False, True]]), GRID)[0]
    assert np.argwhere(hits).tolist() == [[0, 0, 0], [11, 9, 3]]


def test_a_scan_frees_what_it_looks_through_hits_the_wall_and_says_nothing_behind_it():
    grid = VoxelGrid((24, 3, 1), 1.0, (-2.0, -1.5, 1.5))  # a row of voxels ahead, at the height of the lidar
    which = jnp.zeros((2,), jnp.int32)
    evidence = jax.jit(reproject.scan_evidence, static_argnums=(3, 4))(
        wall()[None, ..., 3], which, jnp.concatenate([STILL, pose(4.0, 0.0, 0.0)]), grid, GEOMETRY)
    centres_m = np.asarray(reproject.voxel_centres_m(grid))[:, 1, 0, 0]
    for row, ahead_m in zip(np.asarray(evidence)[:, :, 1, 0], (WALL_M, WALL_M - 4.0), strict=True):
        between = (centres_m > LIDAR_M[0] - WALL_M + ahead_m) & (centres_m < ahead_m - 1.0)
        np.testing.assert_array_equal(row[between], -1.0)
        assert row[np.abs(centres_m - ahead_m) <= 0.5].min() > 0.95  # beams do not lie on the row exactly
        np.testing.assert_array_equal(row[centres_m > ahead_m + 1.1], 0.0)
        assert between.sum() >= 5


def test_evidence_looks_at_the_scan_that_is_asked_for_and_sees_no_ceiling():
    scans_m = np.stack([wall(WALL_M)[..., 3], wall(6.0)[..., 3]])
    grid = VoxelGrid((20, 1, 8), 1.0, (-2.0, -0.5, -1.0))
    evidence = reproject.scan_evidence(scans_m, jnp.array([1, 0, 1]), jnp.zeros((3, 3)), grid, GEOMETRY)
    np.testing.assert_array_equal(evidence[0], evidence[2])
    assert np.argmax(evidence[0, :, 0, 3]) < np.argmax(evidence[1, :, 0, 3])
    np.testing.assert_array_equal(evidence[0, 3:5, 0, 7], 0.0)  # 6.5 m high, 2 m ahead: above the field of view


def test_on_their_beams_rings_stand_still_and_the_ground_keeps_its_height():
    scan = wall(ground=True)[None]
    moved = move_range_view(scan, pose(0.35, 0.1, 0.03), GEOMETRY)
    shown = np.asarray(reproject.onto_beams(moved, GEOMETRY))
    returned = np.asarray(moved[..., 3]) > 0
    np.testing.assert_array_equal(shown[..., 3] > 0, returned)
    near = (scan[..., 3] > 0) & (scan[..., 3] < 60.0)
    road = returned & near & (np.abs(moved[..., 2]) < 1e-3) & (np.abs(scan[..., 2]) < 1e-3)
    assert road.mean() > 0.2
    np.testing.assert_allclose(shown[road][:, 2], np.asarray(moved)[road][:, 2], atol=1e-3)
    np.testing.assert_allclose(shown[road][:, 3], scan[road][:, 3], rtol=1e-3)  # the ring of that row, as before
    upright = returned & (np.asarray(moved[..., 2]) > 0.5)
    flat = lambda view: np.hypot(view[..., 0] - LIDAR_M[0], view[..., 1] - LIDAR_M[1])
    np.testing.assert_allclose(flat(shown)[upright], flat(np.asarray(moved))[upright], rtol=1e-4)
    directions = (shown[returned][:, :3] - LIDAR_M) / shown[returned][:, 3:]
    np.testing.assert_allclose(directions, range_view.beam_directions(GEOMETRY)[returned[0]], atol=1e-4)


def test_holes_take_the_nearest_neighbour_and_the_sky_stays():
    range_m = wall()[None, ..., 3].copy()
    sky = np.zeros(range_m.shape, bool)
    range_m[0, 8:10, 60:62] = -1.0  # a hole of two pixels: filled within two rounds
    range_m[0, 20, 40], sky[0, 20, 40] = -1.0, True
    range_m[0, 15, 70] = 3.0  # something near, beside a hole
    range_m[0, 15, 71] = -1.0
    full = np.asarray(reproject.fill_holes(range_m, sky, GEOMETRY))[0]
    np.testing.assert_allclose(full[8:10, 60:62], wall()[8:10, 60:62, 3], rtol=0.05)
    assert full[20, 40] == -1.0
    assert full[15, 71] == pytest.approx(3.0, rel=0.05)
    known = range_m[0] > 0
    np.testing.assert_allclose(full[known], range_m[0][known], rtol=1e-5)
    alone = np.full_like(range_m, -1.0)
    np.testing.assert_array_equal(reproject.fill_holes(alone, sky, GEOMETRY), -1.0)


def test_gradients_of_everything_with_respect_to_the_pose_are_finite():
    scan, image = np.stack([wall(ground=True), random_scan()]), jnp.stack([picture(), picture()])
    calibration = np.stack([INTRINSICS] * 2), np.stack([CAMERA] * 2)
    values = jnp.asarray(np.random.default_rng(0).random((2, *GRID.shape), np.float32))

    def all_of(where):
        moved = reproject.onto_beams(reproject.move_range_view(scan, where, GEOMETRY), GEOMETRY)
        sky = reproject.move_sky(scan, where, GEOMETRY)
        filled_m = reproject.fill_holes(moved[..., 3], sky, GEOMETRY)
        seen, _ = reproject.move_image(image, filled_m, where, *calibration, GEOMETRY)
        ranges_m, which = jnp.asarray(scan[..., 3]), jnp.arange(2, dtype=jnp.int32)
        evidence = reproject.scan_evidence(ranges_m, which, where, GRID, GEOMETRY)
        voxels = reproject.move_voxels(values, where, GRID)
        return {"range": filled_m.sum(axis=(1, 2)), "image": seen.sum(axis=(1, 2, 3)),
                "evidence": jnp.square(evidence).sum(axis=(1, 2, 3)), "voxels": jnp.square(voxels).sum(axis=(1, 2, 3))}

    slopes = jax.jit(jax.jacrev(all_of))
    for at in ((0.0, 0.0, 0.0), (0.7, 0.1, 0.05), (1e4, 0.0, 1.0)):
        where = jnp.broadcast_to(pose(*at), (2, 3))
        for name, by_pose in slopes(where).items():
            assert np.isfinite(by_pose).all(), (name, at)
            assert np.abs(by_pose).max() > 0 or at[0] != 0.7, (name, at)


def test_what_a_pixel_without_return_holds_reaches_no_slope():
    scan = random_scan()
    holes = np.where(scan[..., 3:] > 0, scan, [[[np.nan, np.nan, np.nan, -1.0]]]).astype(np.float32)
    rows = lambda view: jnp.asarray(view.reshape(1, -1, 4))
    by_pose = jax.jit(jax.grad(lambda at, view: jnp.tanh(reproject.move_range_view(view, at, GEOMETRY)).sum()))
    by_points = jax.jit(jax.grad(lambda view: reproject.splat(view[..., :3], view[..., 3] > 0, GEOMETRY).sum()))
    moved = pose(0.5, 0.1, 0.2)
    np.testing.assert_array_equal(by_pose(moved, holes[None]), by_pose(moved, scan[None]))
    np.testing.assert_array_equal(by_points(rows(holes)), by_points(rows(scan)))
