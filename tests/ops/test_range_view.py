import numpy as np
import pytest
from golden_rule import Golden, make_input
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax import config as config_lib
from muvo_jax.ops import range_view

GEOMETRY = config_lib.RangeViewGeometry(rows=64, columns=256)
LIDAR_M = np.array(GEOMETRY.position_m, np.float32)


def test_beams_hit_their_own_pixels():
    """project is the inverse of beam_directions at any distance: every pixel gets its own beam back."""
    ranges_m = np.random.default_rng(0).uniform(1, 80, (64, 256, 1)).astype(np.float32)
    points_m = LIDAR_M + ranges_m * range_view.beam_directions(GEOMETRY)
    image = range_view.project(points_m.reshape(-1, 3), GEOMETRY)
    np.testing.assert_allclose(image[..., :3], points_m, atol=1e-5)
    np.testing.assert_allclose(image[..., 3:], ranges_m, rtol=1e-5)


@pytest.mark.parametrize(("offset_m", "pixel"), [
    # Just below elevation 0 of -30..+10 degrees: row (1 - 30/40) * 64 = 16. Yaw 0: column 256 / 2 = 128.
    ((10, -0.01, -0.02), (16, 128)),
    ((0.01, 10, -0.02), (16, 64)),  # left: yaw 90 degrees, (1 - 1/2) / 2 * 256 = 64
    ((0, -10, -0.02), (16, 192)),  # right
    ((-10, 1e-3, -0.02), (16, 0)),  # behind, just left of the seam
    ((1, -0.001, 10), (0, 128)),  # far above the field of view: squeezed into the first row
    ((1, -0.001, -10), (63, 128)),  # far below: last row
])
def test_worked_pixels(offset_m, pixel):
    image = range_view.project(LIDAR_M[None] + np.array([offset_m], np.float32), GEOMETRY)
    assert [tuple(index) for index in np.argwhere(image[..., 3] > 0)] == [pixel]


def test_nearest_point_wins_and_empty_is_minus_one():
    near, far = np.array([[6.0, 0, 2]]), np.array([[10.0, 0, 2]])
    for order in ((near, far), (far, near)):
        image = range_view.project(np.concatenate(order), GEOMETRY)
        hit = image[..., 3] > 0
        assert hit.sum() == 1
        np.testing.assert_allclose(image[hit], [[6, 0, 2, 5]])
        assert (image[~hit] == [0, 0, 0, -1]).all()


def test_to_points_takes_returns_beyond_the_threshold():
    image = range_view.project(LIDAR_M + np.array([[3, 0, 0], [0, 20, 0]], np.float32), GEOMETRY)
    assert range_view.to_points(image, 0.0).shape == (2, 3)
    np.testing.assert_allclose(range_view.to_points(image, 10.0), [[1, 20, 2]])


def test_a_point_at_the_lidar_has_no_direction():
    assert (range_view.project(LIDAR_M[None], GEOMETRY)[..., 3] == -1).all()


def test_no_points_give_an_empty_view():
    assert (range_view.project(np.zeros((0, 3)), GEOMETRY)[..., 3] == -1).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 300))
def test_every_pixel_holds_one_of_the_points_and_the_order_does_not_matter(seed, count):
    points_m = np.random.default_rng(seed).normal(0, 20, (count, 3)).astype(np.float32)
    image = range_view.project(points_m, GEOMETRY)
    np.testing.assert_array_equal(image, range_view.project(points_m[::-1], GEOMETRY))
    returned = range_view.to_points(image)
    assert 0 < len(returned) <= count
    assert {tuple(point) for point in returned} <= {tuple(point) for point in points_m}
    distances_m = np.linalg.norm(points_m - LIDAR_M, axis=1)
    assert np.isclose(image[..., 3][image[..., 3] > 0].min(), distances_m.min(), rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(bad):
    with pytest.raises(ValueError, match="1 of 3 points are NaN or infinite"):
        range_view.project(np.array([[1, 2, 3], [bad, 0, 0], [1, 1, 1]]), GEOMETRY)


def test_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"\(4, 4\), expected \[points, 3\]"):
        range_view.project(np.zeros((4, 4)), GEOMETRY)


def test_of_two_points_at_almost_one_distance_the_nearer_wins():
    """In float32 both ranges round to the same number; the authors compare in float64."""
    near, far = np.array([[9.0, 0.0, 2.0]], np.float32), np.array([[9.0, 1e-4, 2.0]], np.float32)
    for order in ((near, far), (far, near)):
        image = range_view.project(np.concatenate(order), config_lib.RangeViewGeometry(rows=1, columns=1))
        np.testing.assert_array_equal(image[0, 0, :3], near[0])


def test_agrees_with_the_reference():
    """Pack P2: 60 000 points into 64 x 1024, every pixel; classes where no duplicate of the point has another one."""
    golden = Golden("p2_geometry.npz")
    points_m = make_input("rv_cloud", (60000,), "cloud")
    classes = make_input("rv_sem", (60000,), "ints9")
    geometry = config_lib.RangeViewGeometry()
    image = range_view.project(points_m, geometry)
    np.testing.assert_allclose(image[..., 3], golden["range/depth"], atol=2e-5)
    assert golden.error("range/xyz", image[..., :3]) < 1e-5
    nearest = range_view.nearest_points(points_m, geometry)
    shown = np.where(nearest >= 0, classes[nearest], 0)
    sure = ~golden["range/label_ambiguous"]
    np.testing.assert_array_equal(shown[sure], golden["range/sem"][sure])


def test_many_points_in_one_pixel():
    """Whatever their order."""
    for steps in (np.arange(1, 101), np.arange(100, 0, -1)):
        points_m = LIDAR_M + np.stack([steps, 0 * steps, 0 * steps], axis=1).astype(np.float32)
        nearest = range_view.nearest_points(points_m, GEOMETRY)
        assert nearest[nearest >= 0].tolist() == [int(np.argmin(steps))]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 400), st.integers(1, 20))
def test_the_nearest_of_a_cell_is_the_last_of_the_nearest(seed, count, cells):
    rng = np.random.default_rng(seed)
    cell, distance = rng.integers(-1, cells, count), rng.integers(0, 30, count).astype(np.float64)
    expected = np.full(cells, -1)
    for point in range(count):
        best = expected[cell[point]]
        if cell[point] >= 0 and (best < 0 or distance[point] <= distance[best]):
            expected[cell[point]] = point
    nearest, half = range_view.NearestOfCells(cells), count // 2
    nearest.add(cell[:half], distance[:half])
    nearest.add(cell[half:], distance[half:], half)
    np.testing.assert_array_equal(nearest.winner, expected)
    np.testing.assert_array_equal(nearest.least, np.where(expected < 0, np.inf, distance[expected]))
