"""Another light on training windows: on half of them, drawn from their keys, over a window in one way."""

import jax
import numpy as np

from muvo_jax import types
from muvo_jax.training import light

WINDOWS, FRAMES = 200, 2


def batch_of(image):
    lead = (WINDOWS, FRAMES)
    return types.Batch(action=np.zeros((*lead, 2), np.float32), is_first=np.zeros(lead, bool),
                       image=np.broadcast_to(image, (*lead, *image.shape)).copy(),
                       range_view=np.ones((*lead, 2, 2, 4), np.float32))


KEYS = jax.random.split(jax.random.key(0), WINDOWS)
PALETTE = np.arange(4 * 8 * 3, dtype=np.uint8).reshape(4, 8, 3) * np.uint8(2)


def test_every_second_window_is_changed_and_all_its_frames_alike():
    batch = batch_of(PALETTE)
    lit = jax.jit(light.randomly)(batch, KEYS)
    image = np.asarray(lit.image)
    assert image.dtype == np.uint8
    changed = (image != batch.image).any(axis=(1, 2, 3, 4))
    assert 0.35 < changed.mean() < 0.65
    np.testing.assert_array_equal(image[~changed], batch.image[~changed])
    np.testing.assert_array_equal(image[:, 0], image[:, 1])
    assert len(np.unique(image[changed, 0], axis=0)) == changed.sum()  # each in a light of its own
    np.testing.assert_array_equal(lit.range_view, batch.range_view)


def test_a_window_is_lit_by_its_own_key():
    batch = batch_of(PALETTE)
    lit = jax.jit(light.randomly)
    first = np.asarray(lit(batch, KEYS).image)
    np.testing.assert_array_equal(first, lit(batch, KEYS).image)
    np.testing.assert_array_equal(first[::-1], lit(batch, KEYS[::-1]).image)
    assert (first != np.asarray(lit(batch, jax.random.split(jax.random.key(1), WINDOWS)).image)).any()


def test_light_is_a_tint_and_a_haze():
    """Affine in each channel, within the bounds that are stated: black becomes haze, white stays below white."""
    black_and_white = np.zeros((1, 2, 3), np.uint8)
    black_and_white[0, 1] = 200
    image = np.asarray(light.randomly(batch_of(black_and_white), KEYS).image)[:, 0, 0].astype(float)
    haze, slope = image[:, 0], (image[:, 1] - image[:, 0]) / 200.0
    assert np.ptp(haze, axis=1).max() <= 1.0 and haze.max() <= light.HAZE * 210.0
    assert slope.min() > light.BRIGHTNESS[0] * light.TINT[0] * (1.0 - light.HAZE) - 0.01
    assert slope.max() < light.BRIGHTNESS[1] * light.TINT[1] + 0.01
    assert (np.ptp(slope, axis=1) > 0.02).any()  # tinted


def test_a_batch_without_images_is_left_alone():
    batch = batch_of(PALETTE).replace(image=None)
    assert light.randomly(batch, KEYS) is batch
