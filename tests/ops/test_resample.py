"""Resampling: worked numbers, agreement with jax.image, cascades."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax.ops import resample


def test_upsampling_blends_quarters_and_repeats_the_edges(strict_dtypes):
    x = jnp.array([0.0, 4.0, 12.0])[None, :, None]
    # 0.75 of the pixel and 0.25 of the neighbour on that side.
    np.testing.assert_array_equal(resample.upsample_linear(x)[0, :, 0], [0, 1, 3, 6, 10, 12])


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 4), st.integers(0, 99))
def test_upsampling_and_its_gradient_are_linear_resizing(rank, factor, seed):
    random = np.random.default_rng(seed)
    sizes = random.integers(1, 6, rank)
    x = jnp.asarray(random.normal(size=(2, *sizes, 3)), jnp.float32)
    by_image = lambda x: jax.image.resize(x, (2, *(int(n) * factor for n in sizes), 3), "linear", antialias=False)
    upsample = lambda x: resample.upsample_linear(x, factor)
    cotangent = jnp.asarray(random.normal(size=jax.eval_shape(by_image, x).shape), jnp.float32)
    differentiate = lambda f: jax.jit(lambda x, cotangent: (f(x), jax.vjp(f, x)[1](cotangent)[0]))(x, cotangent)
    with jax.numpy_dtype_promotion("strict"):
        got, gradient = differentiate(upsample)
        tangent = jax.jit(lambda x: jax.jvp(upsample, (x,), (x,))[1])(x)
    expected, expected_gradient = differentiate(by_image)
    np.testing.assert_allclose(got, expected, atol=2e-6)
    np.testing.assert_allclose(gradient, expected_gradient, atol=2e-5)
    np.testing.assert_allclose(tangent, expected, atol=2e-6)


def test_upsampling_gradient_is_the_transpose_of_the_map(strict_dtypes):
    x = jnp.zeros((1, 3, 2, 1))
    forward = jax.vmap(lambda basis: resample.upsample_linear(basis.reshape(x.shape)).reshape(-1))(jnp.eye(6))
    _, pull_back = jax.vjp(resample.upsample_linear, x)
    backward = jax.vmap(lambda basis: pull_back(basis.reshape(1, 6, 4, 1))[0].reshape(-1))(jnp.eye(24))
    np.testing.assert_allclose(backward, forward.T, atol=1e-6)


def test_resizing_between_corners_reads_equal_steps_from_the_first_to_the_last_pixel(strict_dtypes):
    line = jnp.array([0.0, 1.0, 4.0, 9.0, 16.0])[None, :, None, None]
    longer = resample.resize_corners(line, (6, 1))  # reads 0, 0.8, 1.6, 2.4, 3.2, 4
    np.testing.assert_allclose(longer[0, :, 0, 0], [0.0, 0.8, 2.8, 6.0, 10.4, 16.0], rtol=1e-6)
    np.testing.assert_allclose(resample.resize_corners(line, (3, 1))[0, :, 0, 0], [0.0, 4.0, 16.0], rtol=1e-6)
    assert resample.resize_corners(line, (5, 1)) is line
    # One pixel has no two corners.
    np.testing.assert_allclose(resample.resize_corners(line[:, 3:4], (2, 3)), np.full((1, 2, 3, 1), 9.0), rtol=1e-6)
    np.testing.assert_allclose(resample.resize_corners(line[:, 2:4], (1, 1)), [[[[6.5]]]], rtol=1e-6)


def test_resizing_between_corners_is_numpys_interpolation_of_rows_and_columns(strict_dtypes):
    x = np.random.default_rng(1).normal(size=(2, 5, 13, 3))
    along = lambda x, size, axis: np.apply_along_axis(lambda line: np.interp(
        np.linspace(0, len(line) - 1, size), np.arange(len(line)), line), axis, x)
    got = resample.resize_corners(jnp.asarray(x, jnp.float32), (6, 14))
    np.testing.assert_allclose(got, along(along(x, 6, 1), 14, 2), atol=1e-5)


def test_mean_pool_cascade_keeps_the_mean(strict_dtypes):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 4, 8, 3)), jnp.float32)
    half = resample.mean_pool2(x)
    assert half.shape == (2, 3, 2, 4, 3)
    np.testing.assert_allclose(half[0, 1, 0, 0], x[0, 1, :2, :2].mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(resample.mean_pool2(half).mean((2, 3)), x.mean((2, 3)), atol=1e-6)


def test_errors_name_what_came():
    with pytest.raises(ValueError, match="factor is 0"):
        resample.upsample_linear(jnp.zeros((1, 2, 2, 1)), 0)
    with pytest.raises(ValueError, match="3x4 pixels"):
        resample.mean_pool2(jnp.zeros((3, 4, 1)))
