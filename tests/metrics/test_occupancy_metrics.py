"""Occupancy scores: worked arithmetic, unknown voxels, parity with the reference."""

import golden_rule
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.metrics import occupancy


def grids(prediction, target):
    """One window, one step, voxels along x."""
    shape = (1, 1, len(target), 1, 1)
    return np.array(prediction, bool).reshape(shape), np.array(target, np.uint8).reshape(shape)


def test_worked_arithmetic():
    # TP 1, FP 1, FN 1, TN 1, and two unknown voxels of which one is predicted occupied.
    scores = occupancy.OccupancyScores.zeros(1).add(*grids([1, 1, 0, 0, 1, 0], [1, 0, 1, 0, 255, 255])).overall()
    assert scores["iou_occ_observed"] == pytest.approx(1 / 3)
    assert scores["iou_empty_observed"] == pytest.approx(1 / 3)
    assert scores["precision_observed"] == scores["recall_observed"] == 0.5
    # Unknown as empty: FP 2, TN 2.
    assert scores["iou_occ_all"] == pytest.approx(1 / 4)
    assert scores["iou_empty_all"] == pytest.approx(2 / 5)
    assert scores["precision_all"] == pytest.approx(1 / 3)
    assert scores["recall_all"] == 0.5


def test_undefined_scores_are_nan():
    scores = occupancy.OccupancyScores.zeros(1).add(*grids([0, 0], [255, 255]))
    assert np.isnan(list(scores.per_step()["iou_occ_observed"])).all()
    assert np.isnan(scores.overall()["precision_all"])
    assert scores.overall()["iou_empty_all"] == 1.0


def test_counts_are_summed_before_the_ratio_and_kept_per_step():
    # Frame 1: 1 of 1 found; frame 2: 0 of 3 found. Recall 1/4, not the mean 1/2.
    first, second = grids([1, 0, 0], [1, 0, 0]), grids([0, 0, 0], [1, 1, 1])
    prediction, target = (np.concatenate(pair, axis=1) for pair in zip(first, second, strict=True))
    scores = occupancy.OccupancyScores.zeros(2).add(prediction, target)
    assert scores.overall()["recall_all"] == 0.25
    np.testing.assert_array_equal(scores.per_step()["recall_all"], [1.0, 0.0])
    twice = scores.add(prediction, target)
    assert twice.overall() == scores.overall() or np.isnan(list(scores.overall().values())).any()
    assert twice.observed.true_positive.tolist() == [2, 0]


def test_occupied_means_above_one_half():
    logits = jnp.array([[0.0, 0.0], [0.0, 0.1], [0.1, 0.0]])
    np.testing.assert_array_equal(occupancy.predicted_occupied(logits), [False, True, False])


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    shape = (3, 24, 24, 8)
    truth = golden_rule.make_input("ssc_true2", shape, "voxel2_ign")
    keep = (golden_rule.make_input("ssc_mix2", shape, "uniform") < 0.7) & (truth != 255)
    prediction = np.where(keep, truth, golden_rule.make_input("ssc_pred2", shape, "voxel2")) == 1
    counts = occupancy.OccupancyCounts.zeros(3).add(prediction[None], truth[None], unknown_is_empty=False)
    assert_scores(golden["ssc_c2_batch1"], golden["ssc_c2_batch1_perclass"], counts)
    flipped = np.where(truth == 255, 0, truth)[:, ::-1]
    counts = counts.add(prediction[None, :, ::-1], flipped[None], unknown_is_empty=False)
    assert_scores(golden["ssc_c2_batch2"], golden["ssc_c2_batch2_perclass"], counts)


def assert_scores(golden, per_class, counts):
    scores = counts.overall().scores()
    np.testing.assert_allclose([scores["precision"], scores["recall"], scores["iou_occ"]], golden[:3], rtol=1e-5)
    np.testing.assert_allclose([scores["iou_empty"], scores["iou_occ"]], per_class, rtol=1e-5)
