"""Batches check themselves and slice over time."""

import numpy as np
import pytest

from muvo_jax import types


def batch(**fields):
    return types.Batch(action=np.zeros((2, 5, 2), np.float32), is_first=np.zeros((2, 5), bool), **fields)


def test_time_slice_keeps_calibration_whole():
    sliced = batch(speed_mps=np.arange(10, dtype=np.float32).reshape(2, 5),
                   intrinsics=np.zeros((2, 3, 3), np.float32)).time_slice(1, 3)
    np.testing.assert_array_equal(sliced.speed_mps, [[1, 2], [6, 7]])
    assert sliced.intrinsics.shape == (2, 3, 3)
    assert sliced.image is None
    assert (sliced.batch_size, sliced.frames) == (2, 2)


def test_validate_names_the_field():
    with pytest.raises(ValueError, match=r"Batch.image: got float32\[2, 5, 4, 4, 3\], expected uint8"):
        batch(image=np.zeros((2, 5, 4, 4, 3), np.float32)).validate()
    with pytest.raises(ValueError, match=r"Batch.speed_mps: leading axes \(2, 4\)"):
        batch(speed_mps=np.zeros((2, 4), np.float32)).validate()
    assert batch().validate() is not None


def test_latent_states_index_like_arrays_and_put_h_first():
    state = types.LatentState(deterministic=np.ones((3, 4, 2), np.float32), stochastic=np.zeros((3, 4, 1), np.float32))
    assert state[:, ::2].deterministic.shape == (3, 2, 2)
    np.testing.assert_array_equal(state.features[0, 0], [1, 1, 0])
