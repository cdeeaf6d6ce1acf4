"""From raw outputs to predictions: points along beams, and the constants that a fresh decoder starts from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import presets
from muvo_jax.heads import range_view as head
from muvo_jax.model import decoders
from muvo_jax.ops import range_view


def test_points_lie_along_the_beams_of_their_pixels():
    model = dataclasses.replace(presets.tiny().model, range_view_points="beams")
    geometry = model.range_view
    raw = np.zeros((1, geometry.rows // 2, geometry.columns // 2, 4), np.float32)
    raw[..., 3] = 20.0 / model.range_scale_m
    view = np.array(head.along_beams(jnp.asarray(raw), 2, model)[0]) * model.range_scale_m
    distance_m = np.linalg.norm(view[..., :3] - np.asarray(geometry.position_m), axis=-1)
    np.testing.assert_allclose(distance_m, 20.0, rtol=1e-5)
    # Projecting the points again finds each of them in the pixel that it came from.
    again = range_view.project(view[..., :3].reshape(-1, 3), geometry)[::2, ::2]
    np.testing.assert_allclose(again[..., 3], 20.0, rtol=1e-5)
    np.testing.assert_allclose(again[..., :3], view[..., :3], atol=1e-4)


def test_what_the_network_says_is_added_to_the_point_on_the_beam():
    model = dataclasses.replace(presets.tiny().model, range_view_points="beams")
    raw = np.zeros((1, model.range_view.rows, model.range_view.columns, 4), np.float32)
    moved = raw.copy()
    moved[0, 3, 5, :3] = (0.1, 0.2, 0.3)
    difference = head.along_beams(jnp.asarray(moved), 1, model) - head.along_beams(jnp.asarray(raw), 1, model)
    np.testing.assert_allclose(np.asarray(difference)[0, 3, 5], (0.1, 0.2, 0.3, 0.0), atol=1e-6)
    assert np.count_nonzero(np.asarray(difference)) == 3


def test_the_first_guess_is_added_at_every_scale_and_kept_beside_the_statistics():
    guess = decoders.FirstGuess()
    raw = {1: jnp.ones((2, 4, 6, 3)), 2: jnp.zeros((2, 2, 3, 3))}
    variables = guess.init(jax.random.key(0), raw)
    assert set(variables) == {"batch_stats"}
    constants = {"scale_1": np.full((4, 6, 3), 2.0, np.float32), "scale_2": np.full((2, 3, 3), 5.0, np.float32)}
    out = guess.apply({"batch_stats": constants}, raw)
    np.testing.assert_array_equal(out[1], 3.0)
    np.testing.assert_array_equal(out[2], 5.0)
