"""From raw outputs to predictions: points along beams, and the constants that a fresh decoder starts from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import head as head_lib
from muvo_jax import presets, types
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


@pytest.mark.parametrize("weights", [{"chamfer": 0.0}, {"chamfer": 4.0}], ids=["without chamfer", "with chamfer"])
def test_a_pixel_that_may_show_either_of_two_walls_is_drawn_on_the_likelier_one_and_on_its_beam(weights):
    config = presets.tiny()
    model = dataclasses.replace(config.model, range_view_points="beams")
    geometry, drives, near_m, far_m = model.range_view, 5, 10.0, 30.0
    size = (drives, geometry.rows, geometry.columns, 1)
    walls_m = jnp.broadcast_to(jnp.array([near_m, near_m, near_m, far_m, far_m]).reshape(drives, 1, 1, 1), size)
    view = lambda range_m: head.HEAD.finish(jnp.concatenate([jnp.zeros((*size[:-1], 3)), range_m], axis=-1)
                                            / model.range_scale_m, 1, model)[:, None]
    truth = np.asarray(view(walls_m))
    loss = dataclasses.replace(presets.town().loss, **weights)
    batch = types.Batch(action=np.zeros((drives, 1, 2), np.float32), is_first=np.ones((drives, 1), bool),
                        range_view=truth)
    keys = jax.random.split(jax.random.key(0), (drives, 1))

    @jax.jit
    def total(range_m, aside_m):
        full = view(jnp.full(size, range_m)) + jnp.append(aside_m, 0.0).reshape(1, 1, 1, 1, 4)
        predictions = {scale: full[:, :, ::scale, ::scale] for scale in head.HEAD.scales}
        sums = head.HEAD.losses(head_lib.Learned(predictions, batch, model, loss, keys, None))
        weight = head.HEAD.weights(loss)
        return sum(weight[name] * value for term, of in sums.items() for name, value in of.terms(term).items())

    tried_m = np.linspace(8.0, 32.0, 49)
    assert tried_m[np.argmin([total(range_m, jnp.zeros(3)) for range_m in tried_m])] == near_m
    slope, aside = jax.grad(total, argnums=(0, 1))(20.0, jnp.full(3, 0.5))
    assert slope > 0.0 and (aside > 0.0).all()  # to the near wall, and onto the beam


def test_the_first_guess_is_added_at_every_scale_and_kept_beside_the_statistics():
    guess = decoders.FirstGuess()
    raw = {1: jnp.ones((2, 4, 6, 3)), 2: jnp.zeros((2, 2, 3, 3))}
    variables = guess.init(jax.random.key(0), raw)
    assert set(variables) == {"batch_stats"}
    constants = {"scale_1": np.full((4, 6, 3), 2.0, np.float32), "scale_2": np.full((2, 3, 3), 5.0, np.float32)}
    out = guess.apply({"batch_stats": constants}, raw)
    np.testing.assert_array_equal(out[1], 3.0)
    np.testing.assert_array_equal(out[2], 5.0)
