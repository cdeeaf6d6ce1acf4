"""Batches check themselves and slice over time."""

import copy
import pickle
import re

import jax
import jax.numpy as jnp
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


@pytest.mark.parametrize(("name", "shape", "expected"), [
    ("action", (2, 5, 3), "2"), ("ego_motion", (2, 5, 3), "4"), ("points", (2, 5, 9, 4), "3"),
    ("range_view", (2, 5, 4, 8, 3), "4"), ("target_m", (2, 5, 3), "2"), ("intrinsics", (2, 3, 4), "3, 3"),
    ("camera_to_ego", (2, 3, 4), "4, 4")])
def test_last_axes_that_are_the_same_everywhere_are_checked(name, shape, expected):
    message = re.escape(f"Batch.{name}: got {list(shape)}, expected [..., {expected}]")
    with pytest.raises(ValueError, match=message):
        batch().replace(**{name: np.zeros(shape, np.float32)}).validate()


def test_latent_states_index_like_arrays_and_put_h_first():
    state = types.LatentState(deterministic=np.ones((3, 4, 2), np.float32), stochastic=np.zeros((3, 4, 1), np.float32))
    assert state[:, ::2].deterministic.shape == (3, 2, 2)
    np.testing.assert_array_equal(state.features[0, 0], [1, 1, 0])


def test_an_index_of_observed_frames_keeps_all_that_was_remembered():
    numbers = lambda *shape: np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    gaussian = types.Gaussian(numbers(2, 5, 3), numbers(2, 5, 3))
    memory = types.Memory(pose=numbers(2, 4, 3), range_view=numbers(2, 4, 2, 2, 4), intrinsics=numbers(2, 3, 3),
                          camera_to_ego=numbers(2, 4, 4))
    observed = types.Observed(types.LatentState(numbers(2, 5, 3), numbers(2, 5, 3)), gaussian, gaussian, memory)
    same = lambda got, want: jax.tree.map(np.testing.assert_array_equal, got, want)
    for index in (np.s_[:, -3:], np.s_[:, 2], np.s_[...], np.s_[:]):
        same(observed[index].memory, memory)
        same(observed[index].states, observed.states[index])
        same(observed[index].prior, gaussian[index])
    same(observed[1:, :3].memory, memory[1:])
    same(observed[0].memory, memory[0])
    assert observed.replace(memory=None)[:, :2].memory is None


def test_an_index_of_a_batch_keeps_the_calibration_whole():
    calibration = np.arange(2 * 9, dtype=np.float32).reshape(2, 3, 3)
    windows = batch(intrinsics=calibration, speed_mps=np.arange(10, dtype=np.float32).reshape(2, 5))
    later = windows[:, 3:].validate()
    assert later.frames == 2 and later.image is None
    np.testing.assert_array_equal(later.intrinsics, calibration)
    np.testing.assert_array_equal(later.speed_mps, [[3, 4], [8, 9]])
    second = windows[1:, :2].validate()
    np.testing.assert_array_equal(second.intrinsics, calibration[1:])
    np.testing.assert_array_equal(windows[1].intrinsics, calibration[1])


def predictions():
    """[3, 8, 4, 1] at full size; the head `continue` has no other."""
    image = {scale: jnp.full((3, 8 // scale, 4 // scale, 1), scale, jnp.float32) for scale in (1, 2)}
    return types.Predictions({"image": image, "continue": {1: jnp.zeros((3, 1))}})


def test_predictions_are_read_by_name_at_full_size_or_another():
    decoded = predictions()
    assert decoded.image.shape == (3, 8, 4, 1) and decoded["continue"].shape == (3, 1)
    assert decoded.at_scale(2).image.shape == decoded.at_scale(2)["image"].shape == (3, 4, 2, 1)
    assert decoded.at_scale(2).at_scale(1).image is decoded.image
    assert decoded.heads == tuple(decoded) == ("image", "continue") and decoded.at_scale(2).heads == ("image",)
    assert "image" in decoded and "depth" not in decoded and "continue" not in decoded.at_scale(2)
    assert list(decoded.scales("image")) == [1, 2]
    more = decoded | types.Predictions({"depth": {1: jnp.ones(3)}})
    assert more.heads == ("image", "continue", "depth") and decoded.heads == ("image", "continue")


def test_a_head_or_scale_that_is_not_there_is_named_with_those_that_are():
    decoded = predictions()
    with pytest.raises(AttributeError, match=r"Predictions.depth: the head 'depth' was not decoded; these were"):
        _ = decoded.depth
    with pytest.raises(KeyError, match="was not decoded; these were: image, continue"):
        _ = decoded["depth"]
    with pytest.raises(KeyError, match="the head 'continue' has no scale 2; it has 1"):
        _ = decoded.at_scale(2)["continue"]
    with pytest.raises(ValueError, match="no decoded head has the scale 3; there are 1, 2"):
        decoded.at_scale(3)
    with pytest.raises(TypeError, match="brackets take the name of a head"):
        _ = decoded[:, 0]


def test_predictions_are_a_pytree_through_jit_vmap_scan_and_copies():
    decoded = predictions()
    doubled = jax.jit(lambda tree: jax.tree.map(lambda leaf: 2 * leaf, tree))(decoded)
    np.testing.assert_array_equal(doubled.at_scale(2).image, 4.0)
    assert jax.vmap(lambda one: one.image.sum())(decoded).shape == (3,)
    _, stacked = jax.lax.scan(lambda carry, one: (carry, one.at_scale(2)), 0, decoded)
    assert stacked.image.shape == (3, 4, 2, 1) and stacked.at_scale(1).image.shape == (3, 8, 4, 1)
    for other in (copy.deepcopy(decoded), pickle.loads(pickle.dumps(jax.device_get(decoded)))):
        np.testing.assert_array_equal(other.image, decoded.image)
