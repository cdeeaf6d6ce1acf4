"""Baselines: worked arithmetic on frames small enough to see."""

import numpy as np
import pytest

from muvo_jax import types
from muvo_jax.metrics import baselines


def batch_of(windows=1, frames=2, **fields):
    return types.Batch(action=np.zeros((windows, frames, 2), np.float32), is_first=np.zeros((windows, frames), bool),
                       **fields)


def test_copy_last_repeats_the_last_observed_frame():
    image = np.zeros((1, 3, 2, 2, 3), np.uint8)
    image[0, 1] = 51
    range_view = np.arange(12, dtype=np.float32).reshape(1, 3, 1, 1, 4)
    occupancy = np.array([[[0, 0, 0, 0], [1, 255, 0, 255], [1, 1, 1, 1]]], np.uint8).reshape(1, 3, 4, 1, 1)
    batch = batch_of(frames=3, image=image, range_view=range_view, occupancy=occupancy)
    copied, unknown = baselines.copy_last(batch, 2, 4)
    assert copied["image"].shape == (1, 4, 2, 2, 3)
    np.testing.assert_allclose(copied["image"], 0.2, rtol=1e-6)
    np.testing.assert_array_equal(copied["range_view"][0, 3, 0, 0], [4, 5, 6, 7])
    np.testing.assert_array_equal(copied["occupancy"][0, 0, :, 0, 0], [True, False, False, False])
    assert unknown == 2


def test_copy_last_leaves_out_what_is_absent():
    copied, unknown = baselines.copy_last(batch_of(image=np.zeros((1, 2, 2, 2, 3), np.uint8)), 1, 1)
    assert (set(copied), unknown) == ({"image"}, 0)


def test_mean_image_over_batches():
    mean = baselines.TrainingMean()
    for value in (0, 51):
        mean = mean.add(batch_of(image=np.full((1, 2, 1, 1, 3), value, np.uint8)))
    np.testing.assert_allclose(mean.prediction()["image"], 0.1, rtol=1e-6)


def test_mean_range_view_returns_where_more_than_half_of_the_frames_do():
    hole = [0, 0, 0, -1]
    # Three pixels over four frames: always a return, in two of four, in three of four.
    frames = [[[2, 0, 0, 2], [1, 1, 1, 3], [3, 0, 0, 3]], [[4, 0, 0, 4], [1, 1, 1, 3], [6, 0, 0, 6]],
              [[2, 0, 0, 2], hole, [9, 0, 0, 9]], [[4, 0, 0, 4], hole, hole]]
    range_view = np.array(frames, np.float32).reshape(2, 2, 1, 3, 4)
    predicted = baselines.TrainingMean().add(batch_of(windows=2, range_view=range_view)).prediction()["range_view"]
    np.testing.assert_array_equal(predicted[0], [[3, 0, 0, 3], hole, [6, 0, 0, 6]])


def test_mean_occupancy_is_a_majority_of_those_who_know():
    # Voxels: occupied in 2 of 4; in 3 of 4; in the only frame that knows it; never known.
    frames = [[1, 1, 1, 255], [1, 1, 255, 255], [0, 1, 255, 255], [0, 0, 255, 255]]
    occupancy = np.array(frames, np.uint8).reshape(2, 2, 4, 1, 1)
    predicted = baselines.TrainingMean().add(batch_of(windows=2, occupancy=occupancy)).prediction()["occupancy"]
    np.testing.assert_array_equal(predicted[:, 0, 0], [False, True, True, False])


def test_mean_of_nothing_is_refused():
    with pytest.raises(ValueError, match="no frame was added"):
        baselines.TrainingMean().prediction()
