"""Scores of many futures: worked arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.agents import uncertainty


def test_the_probability_of_branches_and_its_brier_score():
    logits = jnp.array([[[0.0, jnp.log(3.0)], [0.0, 0.0]], [[0.0, -jnp.log(3.0)], [0.0, 40.0]]])  # [N, voxels, 2]
    probability = uncertainty.branch_probability(logits, axis=0)
    np.testing.assert_allclose(probability, [0.5, 0.75], rtol=1e-5)
    truth = jnp.array([1, 0], jnp.uint8)
    np.testing.assert_allclose(uncertainty.brier_score(probability, truth), (0.25 + 0.5625) / 2, rtol=1e-5)
    np.testing.assert_allclose(uncertainty.brier_score(probability, jnp.array([1, 255], jnp.uint8)), 0.25, rtol=1e-5)


def test_the_reliability_curve_by_hand():
    probability = jnp.array([0.1, 0.2, 0.9, 0.9, 1.0])
    curve = uncertainty.reliability(probability, jnp.array([0, 1, 1, 255, 1], jnp.uint8), bins=2)
    assert curve.count.tolist() == [2, 2]
    np.testing.assert_allclose(curve.confidence, [0.15, 0.95], rtol=1e-5)
    np.testing.assert_allclose(curve.frequency, [0.5, 1.0])
    np.testing.assert_allclose(curve.calibration_error, (0.35 + 0.05) / 2, rtol=1e-4)


def test_the_reliability_curve_counts_beyond_what_float32_can_count():
    voxels = 2**24 + 64
    curve = jax.jit(uncertainty.reliability)(jnp.full(voxels, 0.75), jnp.zeros(voxels, jnp.uint8))
    assert curve.count[7] == curve.count.sum() == voxels
    np.testing.assert_allclose(curve.confidence[7], 0.75, rtol=1e-6)


def test_crps_is_the_sum_over_pairs():
    samples, truth = jnp.array([1.0, 4.0, 2.0]), jnp.float32(3.0)
    np.testing.assert_allclose(uncertainty.crps(samples, truth), (2 + 1 + 1) / 3 - (3 + 1 + 2) / 6, rtol=1e-5)
    with pytest.raises(ValueError, match="got 1 branch"):
        uncertainty.crps(samples[:1], truth)


def test_trust_is_one_where_branches_agree_and_falls_to_nothing():
    starts = 3.0 * jax.random.normal(jax.random.key(0), (200, 1, 1, 8))
    noise = jax.random.normal(jax.random.key(1), (200, 16, 3, 8))
    mixed = jnp.concatenate([starts + 0 * noise[:, :, :1], starts + 3.0 * noise[:, :, 1:2], noise[:, :, 2:]], axis=2)
    trusted = uncertainty.trust(mixed)
    np.testing.assert_allclose(trusted.mean(axis=0), [1.0, 0.5, 0.02], atol=0.06)
    assert (np.diff(trusted, axis=1) <= 0).all()
    np.testing.assert_allclose(jnp.cumprod(uncertainty.trust_discount(trusted), axis=1), trusted, atol=1e-5)
    assert uncertainty.trust_horizon(jnp.array([[0.9, 0.6, 0.3]])).tolist() == [2]
    with pytest.raises(ValueError, match="at least 2 starts"):
        uncertainty.trust(mixed[:1])


def test_sensitivity_to_actions():
    before, after = jnp.array([1.0, 2.0]), jnp.array([2.0, 4.0])
    score = uncertainty.action_sensitivity((before, before + 0.5 * (after - before)), (before, after))
    np.testing.assert_allclose([score["gain"], score["correlation"]], [0.5, 1.0], rtol=1e-5)
    assert uncertainty.action_sensitivity((before, before), (before, after))["gain"] == 0
    low, mean = uncertainty.best_of(jnp.array([[3.0, 1.0, 2.0]]))
    assert (low.tolist(), mean.tolist()) == ([1.0], [2.0])
