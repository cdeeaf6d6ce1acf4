"""Nearest distances and Chamfer: against a k-d tree, worked numbers, safe gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax.ops import nearest


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([1, 7, 16, 256]), st.integers(0, 99))
def test_distances_are_those_of_a_tree_for_any_chunk(count, targets_count, chunk, seed):
    random = np.random.default_rng(seed)
    points = random.normal(scale=50, size=(count, 3)).astype(np.float32)
    targets = random.normal(scale=50, size=(targets_count, 3)).astype(np.float32)
    mask = random.random(targets_count) < 0.7
    mask[random.integers(targets_count)] = True
    with jax.numpy_dtype_promotion("strict"):
        got = jax.jit(functools.partial(nearest.nearest_distance, chunk=chunk))(points, targets, mask)
    expected, _ = scipy.spatial.cKDTree(targets[mask].astype(np.float64)).query(points.astype(np.float64))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-4)


def test_gradient_points_away_from_the_nearest_target_and_is_zero_on_it(strict_dtypes):
    targets = jnp.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    points = jnp.array([[3.0, 4.0, 0.0], [10.0, 0.0, 0.0]])
    total = lambda points, targets: nearest.nearest_distance(points, targets).sum()
    towards_points, towards_targets = jax.jit(jax.grad(total, (0, 1)))(points, targets)
    np.testing.assert_allclose(towards_points, [[0.6, 0.8, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(towards_targets, [[-0.6, -0.8, 0], [0, 0, 0]], atol=1e-6)


def test_without_valid_targets_distances_are_infinite_and_gradients_zero(strict_dtypes):
    points, targets, nobody = jnp.ones((2, 3)), jnp.zeros((4, 3)), jnp.zeros(4, bool)
    assert np.isposinf(nearest.nearest_distance(points, targets, nobody)).all()
    everybody = jnp.ones(2, bool)
    sums = jax.jit(lambda points: nearest.chamfer_sums(points, targets, everybody, nobody))
    np.testing.assert_array_equal(sums(points), np.zeros(4))
    np.testing.assert_array_equal(jax.grad(lambda points: sums(points)[0])(points), np.zeros((2, 3)))
    assert np.isnan(nearest.chamfer(points, targets, everybody, nobody))


@pytest.mark.parametrize("garbage", [np.nan, np.inf, 3e38])
def test_what_is_masked_changes_neither_distances_nor_gradients(garbage, strict_dtypes):
    points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [garbage] * 3])
    targets = jnp.array([[0.0, 0.0, 1.0], [garbage] * 3, [5.0, 0.0, 0.0]])
    point_mask, target_mask = jnp.array([True, True, False]), jnp.array([True, False, True])
    distances = lambda targets: nearest.nearest_distance(points[:2], targets, target_mask)
    np.testing.assert_allclose(jax.jit(distances)(targets), [1.0, 2.0**0.5], rtol=1e-6)
    np.testing.assert_array_equal(nearest.nearest_index(points[:2], targets, target_mask), [0, 0])
    clean = jnp.where(point_mask[:, None], points, 0.0), jnp.where(target_mask[:, None], targets, 0.0)
    for loss in (lambda points, targets: distances(targets).sum(),
                 lambda points, targets: sum(nearest.chamfer_sums(points, targets, point_mask, target_mask)[::2])):
        gradients = jax.jit(jax.value_and_grad(loss, (0, 1)))
        jax.tree.map(np.testing.assert_array_equal, gradients(points, targets), gradients(*clean))


def test_chamfer_is_half_of_both_means(strict_dtypes):
    points = jnp.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    targets = jnp.array([[0.0, 3.0, 0.0], [99.0, 99.0, 99.0]])
    mask = jnp.array([True, False])
    # Forward: (3 + 5) / 2; backward: 3. The far target is masked.
    np.testing.assert_allclose(nearest.chamfer(points, targets, None, mask), 0.5 * (4 + 3), rtol=1e-6)


def test_chamfer_of_a_set_with_its_permutation_is_zero(strict_dtypes):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)), jnp.float32)
    assert nearest.chamfer(points, points[::-1]) == 0


def test_batches_by_vmap_and_frames_by_scan(strict_dtypes):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(3, 20, 3)), jnp.float32)
    targets = points[:, ::-1] + 0.1
    one = jax.jit(functools.partial(nearest.nearest_distance, chunk=8))
    expected = jnp.stack([one(p, t) for p, t in zip(points, targets, strict=True)])
    np.testing.assert_allclose(jax.vmap(one)(points, targets), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda p, t: jax.lax.map(lambda pt: one(*pt), (p, t)))(points, targets),
                               expected, rtol=1e-6)


def test_errors_name_the_shapes():
    with pytest.raises(ValueError, match=r"targets \(0, 3\)"):
        nearest.nearest_distance(jnp.zeros((2, 3)), jnp.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"target_mask is \(3,\)"):
        nearest.nearest_distance(jnp.zeros((2, 3)), jnp.zeros((4, 3)), jnp.ones(3, bool))
