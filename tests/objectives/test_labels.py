"""Targets at three scales."""

import jax.numpy as jnp
import numpy as np

from muvo_jax.objectives import labels


def test_images_are_averaged():
    image = np.arange(16, dtype=np.uint8).reshape(1, 1, 4, 4, 1)
    scaled = labels.image_labels(image)
    np.testing.assert_allclose(scaled[1][0, 0, :, :, 0] * 255, image[0, 0, :, :, 0], rtol=1e-6)
    np.testing.assert_allclose(scaled[2][0, 0, :, :, 0] * 255, [[2.5, 4.5], [10.5, 12.5]], rtol=1e-6)
    np.testing.assert_allclose(scaled[4][0, 0, :, :, 0] * 255, [[7.5]], rtol=1e-6)


def test_range_views_are_subsampled():
    range_view = np.random.default_rng(0).normal(size=(1, 2, 4, 8, 4)).astype(np.float32)
    scaled = labels.range_view_labels(range_view)
    np.testing.assert_array_equal(scaled[2], range_view[:, :, ::2, ::2])
    np.testing.assert_array_equal(scaled[4], scaled[2][:, :, ::2, ::2])


def test_a_coarse_voxel_is_occupied_if_any_is_and_unknown_only_if_all_are():
    occupancy = np.zeros((1, 1, 4, 4, 4), np.uint8)
    occupancy[0, 0, 1, 1, 1] = 1  # one of its eight, and not the first
    occupancy[0, 0, 2:, 2:, :2] = 255
    occupancy[0, 0, 2:, :2, :2] = 255
    occupancy[0, 0, 3, 1, 1] = 0  # known, if only as empty
    occupancy[0, 0, :2, 2:, 2:] = 255
    occupancy[0, 0, 0, 2, 2] = 1
    scaled = labels.occupancy_labels(occupancy)
    assert {scale: grid.shape[-3:] for scale, grid in scaled.items()} == {1: (4, 4, 4), 2: (2, 2, 2), 4: (1, 1, 1)}
    assert scaled[2].dtype == jnp.uint8
    np.testing.assert_array_equal(scaled[2][0, 0], [[[1, 0], [0, 1]], [[0, 0], [255, 0]]])
    assert int(scaled[4][0, 0, 0, 0, 0]) == 1


def test_the_reference_trains_on_the_first_voxel_alone():
    occupancy = np.zeros((1, 1, 4, 4, 4), np.uint8)
    occupancy[0, 0, 2, 2, 0] = 255
    occupancy[0, 0, 1, 0, 0] = 1
    scaled = labels.occupancy_labels(occupancy, pooled=False)
    np.testing.assert_array_equal(scaled[2], occupancy[..., ::2, ::2, ::2])
    np.testing.assert_array_equal(scaled[4], occupancy[..., ::4, ::4, ::4])
    assert int(scaled[2][0, 0, 1, 1, 0]) == 255
    assert int((scaled[2] == 1).sum()) == 0
