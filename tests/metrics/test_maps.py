"""Scores of the maps that optional heads draw."""

import jax.numpy as jnp
import numpy as np

from muvo_jax.metrics import maps


def test_decoded_maps_become_what_a_recording_holds():
    logits = jnp.zeros((1, 1, 2, 2, 11)).at[0, 0, 1, 0, 5].set(3.0).at[..., 10].set(9.0)  # a centre is no class
    frames = maps.finish({"depth": jnp.full((1, 1, 2, 2, 1), 7.0), "birds_eye": logits})
    assert frames["depth_m"].shape == (1, 1, 2, 2) and frames["birds_eye_classes"].dtype == jnp.uint8
    np.testing.assert_array_equal(frames["birds_eye_classes"][0, 0], [[0, 0], [5, 0]])


def test_scores_leave_out_what_is_not_measured_or_labelled():
    truth_m = np.array([[[[10.0, -1.0]], [[-1.0, -1.0]]]], np.float32)
    scores = maps.frame_scores("depth", np.full(truth_m.shape, 12.0, np.float32), truth_m)
    assert scores.shape == (1, 2) and scores[0, 0] == 2.0 and np.isnan(scores[0, 1])
    truth = np.array([[[[1, 2, 255, 3]]]], np.uint8)
    guess = np.array([[[[1, 2, 1, 1]]]], np.uint8)
    np.testing.assert_allclose(maps.frame_scores("semantic_image", guess, truth), 2 / 3)
