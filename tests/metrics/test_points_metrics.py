"""Chamfer distance: worked arithmetic, holes, subsets, parity with the reference."""

import golden_rule
import numpy as np
import pytest

from muvo_jax.metrics import points, streaming


def range_view(*pixels):
    """[1, 1, 1, W, 4] from (x, y, z, range) pixels."""
    return np.array(pixels, np.float32).reshape(1, 1, 1, -1, 4)


def test_worked_arithmetic():
    # Prediction {0, 3}, truth {0, 1} on the x axis: to truth (0 + 2) / 2, back (0 + 1) / 2; half of the sum is 0.75.
    prediction = np.array([[0.0, 0, 0], [3, 0, 0]])
    truth = np.array([[0.0, 0, 0], [1, 0, 0]])
    assert points.chamfer_m(prediction, truth) == 0.75
    assert points.chamfer_m(truth, prediction) == 0.75
    assert points.chamfer_m(truth, truth) == 0.0


def test_holes_take_no_part():
    truth = range_view((1, 0, 0, 1), (0, 0, 0, -1))
    prediction = range_view((1, 0, 2, 5), (70, 0, 0, 0.5))
    distance = points.frame_chamfer_m(prediction, truth, return_threshold_m=1.0, points=0, seed=(0,))
    np.testing.assert_allclose(distance, [[2.0]])


def test_the_authors_distance_is_of_pixels_and_holes_are_points_at_the_origin():
    """Two pixels of three are holes that a prediction of one such point has right: the distance shrinks to a third."""
    truth = range_view((10, 0, 0, 10), (0, 0, 0, -1), (0, 0, 0, -1))
    prediction = range_view((10, 3, 0, 10), (0, 0, 0, 0), (40, 0, 0, 40))
    distance = points.pixel_chamfer_m(prediction, truth, pixels=9_000, seed=(0,))
    shares = np.bincount(np.random.default_rng((0, 0, 0)).integers(0, 3, 9_000), minlength=3) / 9_000
    to_truth, to_prediction = shares @ [3.0, 0.0, 30.0], shares @ [3.0, 0.0, 0.0]
    np.testing.assert_allclose(distance, [[(to_truth + to_prediction) / 2]])
    np.testing.assert_array_equal(points.pixel_chamfer_m(truth, truth, pixels=9, seed=(0,)), [[0.0]])
    assert np.isnan(points.pixel_chamfer_m(truth * np.nan, truth, pixels=9, seed=(0,))).all()


def test_an_empty_side_is_undefined_and_not_averaged():
    truth = np.concatenate([range_view((1, 0, 0, 1)), range_view((0, 0, 0, -1))], axis=1)
    prediction = np.concatenate([range_view((2, 0, 0, 2))] * 2, axis=1)
    distance = points.frame_chamfer_m(prediction, truth, return_threshold_m=1.0, points=0, seed=(0,))
    np.testing.assert_array_equal(distance, [[1.0, np.nan]])
    sums = streaming.mean_sums(distance)
    assert (sums["total"].sum(), sums["count"].sum(), sums["undefined"].sum()) == (1.0, 1, 1)


def test_points_on_the_road_do_not_count_above_it():
    truth = range_view((1, 0, 0, 1), (4, 0, 1.0, 4), (9, 0, 0.4, 9))
    prediction = range_view((7, 0, 0, 7), (4, 2, 1.0, 5))
    distance = points.frame_chamfer_m(prediction, truth, return_threshold_m=1.0, points=0, seed=(0,), above_m=0.5)
    np.testing.assert_allclose(distance, [[2.0]])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_prediction_that_is_not_finite_is_counted_and_not_fatal(value):
    truth = np.concatenate([range_view((1, 0, 0, 1))] * 2, axis=1)
    prediction = np.concatenate([range_view((2, 0, 0, 2)), range_view((value, 0, 0, 2))], axis=1)
    distance = points.frame_chamfer_m(prediction, truth, return_threshold_m=1.0, points=0, seed=(0,))
    np.testing.assert_array_equal(distance, [[1.0, np.nan]])


def test_subsets_are_keyed():
    cloud = np.arange(300.0).reshape(100, 3)
    first = points.keyed_subset(cloud, 10, (0, 1))
    assert first.shape == (10, 3)
    assert len(np.unique(first[:, 0])) == 10
    np.testing.assert_array_equal(first, points.keyed_subset(cloud, 10, (0, 1)))
    assert not np.array_equal(first, points.keyed_subset(cloud, 10, (0, 2)))
    for count in (0, 100, 200):
        np.testing.assert_array_equal(points.keyed_subset(cloud, count, (0,)), cloud)


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    prediction, truth = (30 * golden_rule.make_input(name, (2, 2, 400, 3), "pm1") * np.float32([1, 1, 0.2])
                         for name in ("cd_pred", "cd_tgt"))
    sums = streaming.DriveSums()
    for clouds in (prediction, truth + np.float32(0.1)):
        frames = zip(clouds.reshape(4, 400, 3), truth.reshape(4, 400, 3), strict=True)
        distances = [points.chamfer_m(*frame) for frame in frames]
        sums.add(("",) * 4, streaming.mean_sums(np.array(distances)[:, None]))
    mean_m = streaming.summary(sums, streaming.mean, 0)["mean"]
    assert mean_m == pytest.approx(float(golden["metric_cd_1d_2batches"]), rel=1e-5)
