import numpy as np
import pytest
from golden_rule import Golden, make_input
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax import config as config_lib
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.ops import camera, voxels

GRID = config_lib.VoxelGrid(shape=(8, 6, 4), voxel_size_m=0.5, origin_m=(-2.0, -1.0, 0.0))


def chords_m(start, end, grid):
    """Length of the segment inside every voxel, by clipping it to each box in float64."""
    corner = np.moveaxis(np.indices(grid.shape), 0, -1) * grid.voxel_size_m + np.asarray(grid.origin_m)
    start, direction = np.asarray(start, np.float64), np.asarray(end, np.float64) - start
    direction = np.where(direction == 0, 1e-30, direction)
    low, high = (corner - start) / direction, (corner + grid.voxel_size_m - start) / direction
    enter = np.maximum(np.minimum(low, high).max(-1), 0)
    leave = np.minimum(np.maximum(low, high).min(-1), 1)
    return np.maximum(leave - enter, 0) * np.linalg.norm(direction)


def test_voxelize_marks_the_containing_voxels():
    points_m = [[-2, -1, 0], [-1.51, -0.51, 0.49], [1.99, 1.99, 1.99], [2, 0, 0], [0, 0, -0.01], [50, 0, 0]]
    grid = voxels.voxelize(np.array(points_m), GRID)
    assert grid.dtype == np.uint8
    assert [tuple(index) for index in np.argwhere(grid)] == [(0, 0, 0), (7, 5, 3)]


def test_carve_along_an_axis():
    """From voxel 0 to voxel 5 along x: voxels 0 to 4 are passed, the end voxel is not."""
    passed = voxels.carve(np.array([-1.9, -0.9, 0.1]), np.array([[0.6, -0.9, 0.1]]), GRID)
    assert [tuple(index) for index in np.argwhere(passed)] == [(x, 0, 0) for x in range(5)]
    # The same ray backwards passes 5 to 1.
    passed = voxels.carve(np.array([0.6, -0.9, 0.1]), np.array([[-1.9, -0.9, 0.1]]), GRID)
    assert [tuple(index) for index in np.argwhere(passed)] == [(x, 0, 0) for x in range(1, 6)]


def test_carve_through_the_whole_grid_marks_up_to_its_border():
    passed = voxels.carve(np.array([-9, 0.2, 0.7]), np.array([[9, 0.2, 0.7]]), GRID)
    assert [tuple(index) for index in np.argwhere(passed)] == [(x, 2, 1) for x in range(8)]


def test_rays_that_miss_the_grid_or_stay_in_a_voxel_carve_nothing():
    assert not voxels.carve(np.array([-9, -9, 9]), np.array([[9, -9, 9], [-9, -8, 9]]), GRID).any()
    assert not voxels.carve(np.array([0.1, 0.1, 0.1]), np.array([[0.2, 0.2, 0.2], [0.1, 0.1, 0.1]]), GRID).any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_carve_equals_clipping_each_voxel(seed):
    rng = np.random.default_rng(seed)
    start, ends = rng.uniform(-3, 3, 3).astype(np.float32), rng.uniform(-3, 3, (7, 3)).astype(np.float32)
    for end in ends:
        lengths_m = chords_m(start, end, GRID)
        index, inside = voxels.voxel_index(end[None], GRID)
        if inside[0]:
            lengths_m[tuple(index[0])] = 0
        passed = voxels.carve(start, end[None], GRID)
        assert passed[lengths_m > 1e-4].all()
        assert (lengths_m[passed] == 0).sum() <= 1  # a ray through an edge may round to either side
    together = voxels.carve(start, ends, GRID)
    single = np.any([voxels.carve(start, end[None], GRID) for end in ends], axis=0)
    np.testing.assert_array_equal(together, single)
    np.testing.assert_array_equal(together, voxels.carve(np.broadcast_to(start, ends.shape), ends, GRID))


def test_occupancy_target_occupied_beats_empty_and_unseen_is_unknown():
    origin = np.array([-1.9, 0.2, 0.2], np.float32)
    # The second point lies on the way to the first: its voxel stays occupied.
    points_m = np.array([[1.7, 0.2, 0.2], [0.2, 0.2, 0.2]], np.float32)
    target = voxels.occupancy_target(points_m, origin, GRID)
    assert target[:, 2, 0].tolist() == [0, 0, 0, 0, 1, 0, 0, 1]
    assert (np.delete(target.reshape(8, -1), 2 * 4, axis=1) == 255).all()


def test_occupancy_target_free_rays_carve_without_occupying():
    origin = np.array([-1.9, 0.2, 0.2], np.float32)
    target = voxels.occupancy_target(np.zeros((0, 3)), origin, GRID, free_points_m=np.array([[90, 0.2, 0.2]]))
    assert target[:, 2, 0].tolist() == [0] * 8
    assert (target == 255).sum() == target.size - 8


def test_ray_stride_thins_rays_but_not_points():
    origins = np.tile(np.array([0, 0, 1.1], np.float32), (4, 1))
    points_m = np.random.default_rng(0).uniform(-0.9, 1.9, (4, 3)).clip(max=1.9).astype(np.float32)
    all_rays = voxels.occupancy_target(points_m, origins, GRID)
    half = voxels.occupancy_target(points_m, origins, GRID, ray_stride=2)
    np.testing.assert_array_equal(all_rays == 1, half == 1)
    assert ((half == 0) <= (all_rays == 0)).all()
    np.testing.assert_array_equal(half == 0, voxels.occupancy_target(points_m[::2], origins[::2], GRID) == 0)


def test_points_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="NaN or infinite"):
        voxels.voxelize(np.array([[np.nan, 0, 0]]), GRID)
    with pytest.raises(ValueError, match="NaN or infinite"):
        voxels.carve(np.zeros(3), np.array([[np.inf, 0, 0]]), GRID)


def test_voxel_table_labels_by_the_point_nearest_to_the_lower_corner():
    points_m = [[-1.9, -0.9, 0.1], [-1.6, -0.6, 0.4], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [1.9, 1.9, 1.9], [50, 0, 0]]
    tags = np.array([1, 2, 3, 6, 4, 5], np.uint8)
    plain = [[0, 0, 0, 1], [4, 2, 0, 3], [7, 5, 3, 4]]
    assert voxels.voxel_table(np.array(points_m), tags, GRID).tolist() == plain
    plain[1][3] = 6  # a road line wins from anywhere in the voxel
    assert voxels.voxel_table(np.array(points_m), tags, GRID, winning_tag=6).tolist() == plain


def test_voxel_table_is_empty_without_points_and_wants_a_tag_for_each():
    assert voxels.voxel_table(np.zeros((0, 3)), np.zeros(0, np.uint8), GRID).shape == (0, 4)
    with pytest.raises(ValueError, match="one for each of 2 points"):
        voxels.voxel_table(np.zeros((2, 3)), np.zeros(3, np.uint8), GRID)


def test_voxels_of_depth_and_lidar_agree_with_the_reference():
    """Pack P2: 600 x 960 depth and 60 000 points, without the car's own; every voxel and every tag."""
    golden = Golden("p2_geometry.npz")
    depth_m = make_input("vf_depth", (600, 960), "depth_m")
    of_pixels = make_input("vf_sem", (600, 960), "labels23").reshape(-1)
    lidar_m = make_input("rv_cloud", (60000,), "cloud")
    seen_m, pixel = camera.reference_depth_points(depth_m, np.deg2rad(110), (1.0, 0.0, 2.0))
    points_m = np.concatenate([seen_m, lidar_m])
    tags = np.concatenate([of_pixels[pixel], make_input("vf_lsem", (60000,), "ints23")])
    kept = ~muvo_files.in_ego_box(points_m)
    assert golden.error("merge/points", points_m[kept]) < 1e-5
    table = voxels.voxel_table(points_m[kept], tags[kept], config_lib.VoxelGrid(), winning_tag=6)
    np.testing.assert_array_equal(table[:, :3], golden["voxel_filter/coords"])
    sure = ~golden["voxel_filter/label_ambiguous"]
    np.testing.assert_array_equal(table[sure, 3], golden["voxel_filter/sem"][sure])


def test_depth_points_agree_with_the_reference():
    golden = Golden("p2_geometry.npz")
    depth_m = make_input("d2p_depth", (60, 96), "depth_m")
    points_m, pixel = camera.reference_depth_points(depth_m, np.deg2rad(110), (1.0, 0.0, 2.0))
    assert golden.error("convert_coor_img", points_m) < 1e-5
    classes = make_input("d2p_sem", (60, 96), "ints23").reshape(-1)
    np.testing.assert_array_equal(classes[pixel], golden["depth2pcd/sem"][:, 0])
