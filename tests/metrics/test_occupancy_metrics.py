"""Occupancy scores: worked arithmetic, unknown voxels, what lies above the road, parity with the reference."""

import golden_rule
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.metrics import occupancy, streaming


def grids(prediction, target):
    """One window, one step, voxels along x."""
    shape = (1, 1, len(target), 1, 1)
    return np.array(prediction, bool).reshape(shape), np.array(target, np.uint8).reshape(shape)


def scores(prediction, target, **options):
    """{score: value} of one call of counts, over all steps."""
    counted = {name: value.sum() for name, value in occupancy.counts(prediction, target, **options).items()}
    return {name: float(score(counted)) for name, score in occupancy.SCORES.items()}


def test_worked_arithmetic():
    # TP 1, FP 1, FN 1, TN 1, and two unknown voxels of which one is predicted occupied.
    pair = grids([1, 1, 0, 0, 1, 0], [1, 0, 1, 0, 255, 255])
    observed, everything = (scores(*pair, unknown_is_empty=unknown) for unknown in (False, True))
    assert observed["iou_occ"] == pytest.approx(1 / 3)
    assert observed["iou_empty"] == pytest.approx(1 / 3)
    assert observed["precision"] == observed["recall"] == 0.5
    # Unknown as empty: FP 2, TN 2.
    assert everything["iou_occ"] == pytest.approx(1 / 4)
    assert everything["iou_empty"] == pytest.approx(2 / 5)
    assert everything["precision"] == pytest.approx(1 / 3)
    assert everything["recall"] == 0.5


def test_only_the_voxels_of_a_mask_count():
    prediction, target = grids([1, 1, 0, 1], [1, 0, 1, 0])
    where = np.array([True, True, False, False]).reshape(target.shape)
    assert scores(prediction, target, unknown_is_empty=False, where=where)["iou_occ"] == 0.5


def test_undefined_scores_are_nan():
    pair = grids([0, 0], [255, 255])
    assert np.isnan(scores(*pair, unknown_is_empty=False)["iou_occ"])
    assert np.isnan(scores(*pair, unknown_is_empty=True)["precision"])
    assert scores(*pair, unknown_is_empty=True)["iou_empty"] == 1.0


def test_counts_are_summed_before_the_ratio_and_kept_per_step():
    # Frame 1: 1 of 1 found; frame 2: 0 of 3 found. Recall 1/4, not the mean 1/2.
    first, second = grids([1, 0, 0], [1, 0, 0]), grids([0, 0, 0], [1, 1, 1])
    prediction, target = (np.concatenate(pair, axis=1) for pair in zip(first, second, strict=True))
    sums = streaming.DriveSums()
    for drive in ("a", "b"):
        sums.add([drive], occupancy.counts(prediction, target, unknown_is_empty=True))
    found = streaming.summary(sums, occupancy.SCORES["recall"], 0)
    assert (found["mean"], found["per_step"], found["interval"]) == (0.25, [1.0, 0.0], [0.25, 0.25])
    assert sums.total()["true_positive"].tolist() == [2, 0]


@pytest.mark.parametrize(("origin_m", "size_m", "first"), [(-1.5, 1.0, 2), (-6.0, 0.5, 13), (-3.0, 2.0, 2),
                                                           (0.6, 1.0, 0), (-1.4, 0.1, 19)])
def test_above_the_road_are_the_layers_that_lie_wholly_half_a_metre_over_it(origin_m, size_m, first):
    grid = config_lib.VoxelGrid((8, 8, 40), size_m, (-4.0, -4.0, origin_m))
    assert occupancy.above_road(grid) == slice(first, 40)
    assert grid.layers(-100.0, 0.5) == slice(0, first)


@pytest.mark.parametrize(("above", "called"), [(0.5, [False, True, False]), (0.3, [True, True, True]),
                                               (0.8, [False, False, False])])
def test_occupied_means_above_the_probability_that_is_asked_for(above, called):
    logits = jnp.array([[0.0, 0.0], [0.0, 0.1], [0.1, 0.0]])
    np.testing.assert_array_equal(occupancy.predicted_occupied(logits, above), called)
    some = jnp.array([[1.0, 1.0 + np.log(above / (1 - above)) + step] for step in (-0.01, 0.01)])
    np.testing.assert_array_equal(occupancy.predicted_occupied(some, above), [False, True])


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    shape = (3, 24, 24, 8)
    truth = golden_rule.make_input("ssc_true2", shape, "voxel2_ign")
    keep = (golden_rule.make_input("ssc_mix2", shape, "uniform") < 0.7) & (truth != 255)
    prediction = np.where(keep, truth, golden_rule.make_input("ssc_pred2", shape, "voxel2")) == 1
    sums = streaming.DriveSums()
    sums.add([""], occupancy.counts(prediction[None], truth[None], unknown_is_empty=False))
    assert_scores(golden["ssc_c2_batch1"], golden["ssc_c2_batch1_perclass"], sums)
    flipped = np.where(truth == 255, 0, truth)[:, ::-1]
    sums.add([""], occupancy.counts(prediction[None, :, ::-1], flipped[None], unknown_is_empty=False))
    assert_scores(golden["ssc_c2_batch2"], golden["ssc_c2_batch2_perclass"], sums)


def assert_scores(golden, per_class, sums):
    found = {name: streaming.summary(sums, score, 0)["mean"] for name, score in occupancy.SCORES.items()}
    np.testing.assert_allclose([found["precision"], found["recall"], found["iou_occ"]], golden[:3], rtol=1e-5)
    np.testing.assert_allclose([found["iou_empty"], found["iou_occ"]], per_class, rtol=1e-5)
