"""Worked arithmetic of every change, and what stays whatever the amount."""

import jax
import numpy as np
import pytest

from muvo_jax.ops import photometric

RED, GREY = (1.0, 0.0, 0.0), (0.5, 0.5, 0.5)
pytestmark = pytest.mark.usefixtures("strict_dtypes")


def plain(colour, rows=4, columns=6):
    return np.broadcast_to(np.float32(colour), (rows, columns, 3)).copy()


def test_hue_goes_round_the_colour_circle():
    third = np.asarray(photometric.hue(plain(RED), 1 / 3))
    np.testing.assert_allclose(third, plain((0.0, 1.0, 0.0)), atol=1e-6)
    # Orange (30 degrees) turned by 60 degrees is the yellow green at 90 degrees.
    np.testing.assert_allclose(photometric.hue(plain((1.0, 0.5, 0.0)), 1 / 6), plain((0.5, 1.0, 0.0)), atol=1e-6)
    np.testing.assert_allclose(photometric.hue(plain(GREY), 0.3), plain(GREY), atol=1e-6)
    image = np.random.default_rng(0).random((5, 7, 3), np.float32)
    np.testing.assert_allclose(photometric.hue(image, 0.0), image, atol=1e-6)
    np.testing.assert_allclose(photometric.hue(photometric.hue(image, 0.1), -0.1), image, atol=1e-5)


def test_brightness_contrast_and_saturation_blend_with_black_with_the_mean_and_with_grey():
    np.testing.assert_allclose(photometric.brightness(plain((0.2, 0.4, 0.9)), 1.5), plain((0.3, 0.6, 1.0)), atol=1e-6)
    halves = np.concatenate([plain((0.2, 0.2, 0.2)), plain((0.6, 0.6, 0.6))])
    # The mean is 0.4 (times 0.9999, the sum of the three weights); doubled, 0.2 becomes 0 and 0.6 becomes 0.8.
    expected = np.concatenate([plain((0.0, 0.0, 0.0)), plain((0.8, 0.8, 0.8))])
    np.testing.assert_allclose(photometric.contrast(halves, 2.0), expected, atol=1e-4)
    grey = 0.2989 * 1.0
    np.testing.assert_allclose(photometric.saturation(plain(RED), 0.5), plain((0.5 + grey / 2, grey / 2, grey / 2)),
                               atol=1e-6)


def test_blur_is_a_mean_and_sharpening_its_opposite():
    point = np.zeros((7, 7, 3), np.float32)
    point[3, 3] = 1.0
    blurred = np.asarray(jax.jit(photometric.blur)(point, 1.0))
    one_away = np.exp(-0.5) / (1 + 2 * np.exp(-0.5) + 2 * np.exp(-2.0))
    centre = 1.0 / (1 + 2 * np.exp(-0.5) + 2 * np.exp(-2.0))
    np.testing.assert_allclose(blurred[3, 2:5, 0], centre * np.array([one_away, centre, one_away]), rtol=1e-5)
    np.testing.assert_allclose(blurred.sum(axis=(0, 1)), 1.0, rtol=1e-5)
    np.testing.assert_allclose(photometric.blur(plain(GREY), 1.7), plain(GREY), atol=1e-6)
    # Smoothed, a lone 0.5 keeps 5/13 of itself; sharpened by 2 it gains what smoothing took.
    sharp = np.asarray(photometric.sharpen(0.5 * point, 2.0))
    np.testing.assert_allclose(sharp[3, 3], 0.5 + 0.5 * 8 / 13, rtol=1e-5)
    assert sharp[3, 2].max() == 0.0
    border = np.random.default_rng(1).random((4, 4, 3), np.float32)
    np.testing.assert_allclose(np.asarray(photometric.sharpen(border, 3.0))[0], border[0], atol=1e-6)
