"""Inputs change, targets do not; everything follows from the sample's key; rates and geometry as configured.

That eight devices see what one sees is part of test_parallel.py, whose windows are augmented.
"""

import dataclasses
import functools
import types as python_types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.training import augmentation
from muvo_jax.training import step as step_lib

ON = config_lib.AugmentationConfig(image=True, route=True)


@functools.cache
def augmented(seed=0, step=0):
    keys = step_lib.sample_keys(jax.random.key(seed), step, 0, small_world.WINDOWS, None)
    batch = small_world.make_batch(presets.tiny().model)
    return jax.tree.map(np.asarray, _augment(batch, keys))


@jax.jit
def _augment(batch, keys):
    return augmentation.augment(batch, keys, dataclasses.replace(ON, route_drop=0.3, route_affine_large=0.3))


def test_only_inputs_change_and_they_stay_a_batch():
    before, after = small_world.make_batch(presets.tiny().model), augmented()
    after.validate()
    for name in types.BATCH_FIELDS:
        if getattr(before, name) is not None:
            assert np.array_equal(getattr(before, name), getattr(after, name)) == (name not in ("image", "route_map"))
    changed = (before.image != after.image).any(axis=(2, 3, 4))
    # Sharpened or blurred with 0.6, else coloured with 0.3: 0.72 of 24 frames, each on its own.
    assert 10 <= changed.sum() <= 23
    assert any(0 < window.sum() < window.size for window in changed)


def test_the_same_run_step_and_sample_see_the_same_and_others_do_not():
    again = augmented.__wrapped__()
    np.testing.assert_array_equal(again.image, augmented().image)
    np.testing.assert_array_equal(again.route_map, augmented().route_map)
    assert (augmented(step=1).image != augmented().image).any()
    assert (augmented(seed=1).image != augmented().image).any()


def test_off_it_is_the_identity():
    batch = small_world.make_batch(presets.tiny().model)
    keys = step_lib.sample_keys(jax.random.key(0), 0, 0, small_world.WINDOWS, None)
    assert augmentation.augment(batch, keys, config_lib.AugmentationConfig()) == batch
    assert not presets.town().augmentation.image and not presets.town().augmentation.route
    assert presets.paper().augmentation == presets.get("reference-2d").augmentation == ON


@pytest.mark.parametrize("train", [True, False])
def test_the_loss_compares_with_the_recorded_image(monkeypatch, train):
    """Of a training step the encoder gets the changed batch, the loss the recorded one; elsewhere both get that."""
    batch, seen = small_world.make_batch(presets.tiny().model), {}
    zeros = np.zeros((*batch.action.shape[:2], 4), np.float32)
    pair = types.Gaussian(zeros, zeros + 1)

    def observe_window(model, variables, batch, keys, **options):
        return seen.update(encoder=batch) or (types.Observed(types.LatentState(zeros, zeros), pair, pair), {})

    def sums(model, variables, states, memory, batch, keys, **options):
        return seen.update(loss=batch) or {}

    monkeypatch.setattr(step_lib.augmentation, "augment",
                        lambda batch, keys, settings: dataclasses.replace(batch, image=255 - batch.image))
    monkeypatch.setattr(step_lib.rollout, "observe_window", observe_window)
    monkeypatch.setattr(step_lib.scoring, "sums", sums)
    model = python_types.SimpleNamespace(config=dataclasses.replace(presets.tiny().model, heads=("action",)))
    unweighted = config_lib.override(presets.tiny(), "loss.action", 0.0)
    step_lib.forward({}, {}, batch, None, model=model, config=unweighted, train=train, axis_name=None)
    np.testing.assert_array_equal(seen["loss"].image, batch.image)
    np.testing.assert_array_equal(seen["encoder"].image, 255 - batch.image if train else batch.image)


def test_routes_change_as_often_as_configured_and_all_frames_alike():
    count, side = 4000, 8
    maps = jnp.full((2, side, side), 255, jnp.uint8)
    change = jax.jit(jax.vmap(lambda key: augmentation.augment_route(key, maps, ON)))
    routes = np.asarray(change(jax.random.split(jax.random.key(0), count)))
    np.testing.assert_array_equal(routes[:, 0], routes[:, 1])
    rows = routes[:, 0].any(axis=2)
    blank = ~rows.any(axis=1)
    whole_rows = (routes[:, 0] == routes[:, 0, :, :1]).all(axis=(1, 2))
    truncated = whole_rows & ~blank & ~rows[:, 0] & rows[:, -1]
    untouched = (routes[:, 0] == 255).all(axis=(1, 2))
    # A standard deviation is 0.0025. One truncation in 8 takes no row away, and some small moves show nothing here.
    assert abs(blank.mean() - 0.025) < 0.008
    assert abs(truncated.mean() - 0.025 * 7 / 8) < 0.008
    assert 0.885 < untouched.mean() < 0.935
    assert 0.02 < (~untouched & ~blank & ~truncated).mean() < 0.06


def test_affine_moves_pixels_where_arithmetic_says():
    maps = np.zeros((1, 5, 5), np.uint8)
    maps[0, 0, 2], maps[0, 1, 2] = 200, 100  # a stroke up from the centre

    def move(angle_rad=0.0, shift_px=(0.0, 0.0), scale=1.0, shear_rad=0.0):
        moved = augmentation.affine(jnp.asarray(maps), jnp.float32(angle_rad), jnp.asarray(shift_px), scale, shear_rad)
        return {(int(row), int(column)): int(moved[0, row, column]) for row, column in np.argwhere(moved[0])}

    assert move() == {(0, 2): 200, (1, 2): 100}
    assert move(angle_rad=np.pi / 2) == {(2, 4): 200, (2, 3): 100}  # clockwise
    assert move(shift_px=(-1.0, 3.0)) == {(3, 1): 200, (4, 1): 100}  # left and down
    assert move(shift_px=(0.0, -1.0)) == {(0, 2): 100}  # the end of the stroke leaves the map
    assert move(scale=0.5) == {(1, 2): 200}  # the rows 2 and 1 above the centre: 2 becomes 1
    # What lies above the centre goes to the right: by its height, with a shear of 45 degrees.
    assert move(shear_rad=np.pi / 4) == {(0, 4): 200, (1, 3): 100}


def test_impossible_probabilities_are_refused():
    with pytest.raises(ValueError, match=r"blur \+ sharpen = 0\.8 \+ 0\.3"):
        config_lib.AugmentationConfig(blur=0.8)
    with pytest.raises(ValueError, match=r"hue is 0\.7"):
        config_lib.AugmentationConfig(hue=0.7)
