"""Scores of the maps that optional heads draw."""

import numpy as np

from muvo_jax.metrics import maps


def test_scores_leave_out_what_is_not_measured_or_labelled():
    truth_m = np.array([[[[10.0, -1.0]], [[-1.0, -1.0]]]], np.float32)
    scores = maps.depth_error_m(np.full(truth_m.shape, 12.0, np.float32), truth_m)
    assert scores.shape == (1, 2) and scores[0, 0] == 2.0 and np.isnan(scores[0, 1])
    truth = np.array([[[[1, 2, 255, 3]]]], np.uint8)
    guess = np.array([[[[1, 2, 1, 1]]]], np.uint8)
    np.testing.assert_allclose(maps.share_right(guess, truth), 2 / 3)
