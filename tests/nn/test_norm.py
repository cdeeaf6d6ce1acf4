"""Batch, layer and adaptive instance normalisation against arithmetic done by hand and over split batches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from muvo_jax.nn import norm

pytestmark = pytest.mark.usefixtures("strict_dtypes")
VARIABLES = {"params": {"scale": jnp.float32([2.0]), "bias": jnp.float32([0.5])},
             "batch_stats": {"mean": jnp.float32([1.0]), "var": jnp.float32([3.0])}}


def apply(variables, x, mode):
    return norm.BatchNorm().apply(variables, x, mode, mutable=["batch_stats"])


def test_training_normalises_by_the_biased_and_stores_the_unbiased_variance():
    # 1, 2, 3, 6: mean 3, squares 4 + 1 + 0 + 9 = 14, biased variance 3.5, unbiased 14 / 3
    x = jnp.float32([1, 2, 3, 6]).reshape(2, 2, 1)
    y, updated = apply(VARIABLES, x, norm.Mode(train=True))
    np.testing.assert_allclose(y[..., 0], 2 * (x[..., 0] - 3) / np.sqrt(3.5 + 1e-5) + 0.5, rtol=1e-6)
    np.testing.assert_allclose(updated["batch_stats"]["mean"], [0.9 * 1 + 0.1 * 3], rtol=1e-6)
    np.testing.assert_allclose(updated["batch_stats"]["var"], [0.9 * 3 + 0.1 * 14 / 3], rtol=1e-6)


def test_second_derivatives_are_those_of_the_arithmetic():
    weights = jnp.arange(1.0, 7.0).reshape(3, 2)
    variables = {"params": {"scale": jnp.ones(2), "bias": jnp.zeros(2)},
                 "batch_stats": {"mean": jnp.zeros(2), "var": jnp.ones(2)}}
    layer = lambda x: jnp.sum(apply(variables, x, norm.Mode(train=True))[0] ** 3 * weights)

    def by_hand(x):
        centred = x - x.mean(axis=0, keepdims=True)
        return jnp.sum((centred / jnp.sqrt((centred**2).mean(axis=0, keepdims=True) + 1e-5)) ** 3 * weights)

    x = jnp.float32([[0, 1], [2, 5], [3, 4]])
    got, want = (jax.jit(lambda x, of=of: (jax.grad(of)(x), jax.jacrev(jax.grad(of))(x)))(x) for of in (layer, by_hand))
    for ours, theirs in zip(got, want, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_evaluation_uses_the_running_moments_and_keeps_them():
    x = jnp.float32([[1.0], [5.0]])
    y, updated = apply(VARIABLES, x, norm.Mode())
    np.testing.assert_allclose(y[:, 0], [0.5, 2 * 4 / np.sqrt(3 + 1e-5) + 0.5], rtol=1e-6)
    assert updated["batch_stats"] == VARIABLES["batch_stats"]


def test_variance_of_values_far_from_zero_does_not_cancel():
    x = jnp.float32([4096.0, 4097.0, 4098.0])[:, None]
    _, var, unbiased, _ = norm.batch_moments(x, None)
    np.testing.assert_allclose([var[0], unbiased[0]], [2 / 3, 1.0], rtol=1e-6)


def test_one_value_has_zero_variance_and_a_finite_gradient():
    gradient = jax.grad(lambda x: apply(VARIABLES, x, norm.Mode(train=True))[0].sum())(jnp.ones((1, 1)))
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("kept", "mean", "var"), [(0, 1.0, 3.0), (1, 0.9 + 0.1 * 7, 3.0), (2, 1.6, 0.9 * 3)])
def test_too_few_rows_leave_the_running_moments_as_they_were(kept, mean, var):
    mask = jnp.arange(4) < kept
    masked = lambda x, mask, axis_name: norm.BatchNorm().apply(
        VARIABLES, x, norm.Mode(True, axis_name), mask, mutable=["batch_stats"])[1]["batch_stats"]
    over_devices = jax.vmap(functools.partial(masked, axis_name="data"), axis_name="data")(
        jnp.full((4, 1, 1), 7.0), mask[:, None])  # no device has two rows, all together may
    for stats in (masked(jnp.full((4, 1), 7.0), mask, None), jax.tree.map(lambda leaf: leaf[3], over_devices)):
        np.testing.assert_allclose([stats["mean"][0], stats["var"][0]], [mean, var], rtol=1e-6)


def test_over_an_axis_the_statistics_and_gradients_are_those_of_the_whole_batch():
    x = jax.random.normal(jax.random.key(0), (8, 3, 1)) * 2 + 1
    target = jax.random.normal(jax.random.key(1), x.shape)

    def loss(variables, x, target, axis_name):
        y, updated = apply(variables, x, norm.Mode(True, axis_name))
        return jnp.sum(jnp.sin(y) * target), updated["batch_stats"]

    (_, whole_stats), whole = jax.value_and_grad(loss, argnums=1, has_aux=True)(VARIABLES, x, target, None)
    mesh = Mesh(np.array(jax.devices()[:4]), ("data",))

    @functools.partial(jax.shard_map, mesh=mesh, in_specs=(P("data"), P("data")), out_specs=(P(), P("data")))
    def split(x, target):
        (_, stats), gradient = jax.value_and_grad(loss, argnums=1, has_aux=True)(VARIABLES, x, target, "data")
        return stats, gradient

    stats, gradient = split(x, target)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5), stats, whole_stats)
    np.testing.assert_allclose(gradient, whole, rtol=1e-4, atol=1e-5)


def test_bfloat16_input_gets_float32_moments():
    x = (1000 + jnp.arange(8.0)).astype(jnp.bfloat16)[:, None]
    y, updated = apply(VARIABLES, x, norm.Mode(train=True))
    assert y.dtype == jnp.bfloat16 and updated["batch_stats"]["var"].dtype == jnp.float32


def test_layer_norm_by_hand():
    variables = {"params": {"scale": jnp.float32([1, 2]), "bias": jnp.float32([0, 1])}}
    # 1, 3: mean 2, variance 1
    y = norm.LayerNorm().apply(variables, jnp.float32([[1, 3]]))
    np.testing.assert_allclose(y, [[-1, 3]], rtol=1e-4)


def test_adaptive_instance_norm_by_hand():
    # The style map is the identity-like matrix that makes scale 3 and shift -1 of style [3, -1].
    variables = {"params": {"style": {"kernel": jnp.eye(2), "bias": jnp.zeros(2)}}}
    x = jnp.float32([2, 6]).reshape(1, 2, 1, 1)  # mean 4, std 2
    y = norm.AdaptiveInstanceNorm().apply(variables, x, jnp.float32([[3, -1]]))
    np.testing.assert_allclose(y.ravel(), [-4, 2], rtol=1e-5)
