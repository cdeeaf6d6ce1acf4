"""Regression terms: worked arithmetic, masks, parity with the reference."""

import golden_rule
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.objectives import regression

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def test_channels_add_up_and_pixels_are_averaged():
    prediction, target = jnp.array([[1.0, 2.0], [0.0, 0.0]]), jnp.array([[0.0, 4.0], [0.0, 0.0]])
    assert regression.l1_sums(prediction, target).value() == (1 + 2) / 2
    assert regression.l2_sums(prediction, target).value() == (1 + 4) / 2


def test_masked_pixels_neither_count_nor_learn():
    prediction, target = jnp.array([[5.0], [1.0]]), jnp.array([[0.0], [0.0]])
    mask = jnp.array([False, True])
    value = lambda x: regression.l1_sums(x, target, mask).value()
    assert value(prediction) == 1.0
    np.testing.assert_array_equal(jax.grad(value)(prediction), [[0.0], [1.0]])
    assert regression.l1_sums(prediction, target, jnp.zeros(2, bool)).value() == 0.0


def test_range_view_learns_holes_from_the_range_alone():
    # One return at 50 m and one hole; predictions are 5 m off in x, and 10 m off in the range of the hole.
    target = jnp.array([[30.0, 40.0, 0.0, 50.0], [0.0, 0.0, 0.0, -1.0]])
    prediction = jnp.array([[35.0, 40.0, 0.0, 50.0], [5.0, 0.0, 0.0, 9.0]])
    xyz, depth = regression.range_view_sums(prediction, target, scale_m=50.0, mask_holes=True)
    np.testing.assert_allclose(xyz.value(), 0.1**2, rtol=1e-5)
    np.testing.assert_allclose(depth.value(), 0.2 / 2, rtol=1e-5)
    xyz, _ = regression.range_view_sums(prediction, target, scale_m=50.0, mask_holes=False)
    np.testing.assert_allclose(xyz.value(), (0.1**2 + 0.1**2) / 2, rtol=1e-5)


@pytest.mark.parametrize("norm, sums", [("l1", regression.l1_sums), ("l2", regression.l2_sums)])
@pytest.mark.parametrize("variant", ["", "_ignore"])
def test_spatial_parity_with_the_reference(norm, sums, variant):
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    prediction, target = (jnp.moveaxis(jnp.asarray(golden_rule.make_input(name, (2, 2, 3, 24, 32), "normal")), 2, -1)
                          for name in ("sp_pred", "sp_tgt"))
    mask = jnp.asarray(~golden_rule.make_input("sp_ign", (2, 2, 1, 24, 32), "mask")[:, :, 0]) if variant else None
    loss, gradient = jax.value_and_grad(lambda x: sums(x, target, mask).value())(prediction)
    assert golden.error(f"spatial_{norm}{variant}/loss", loss) < 1e-5
    assert golden.error(f"spatial_{norm}{variant}/grad", np.moveaxis(gradient, -1, 2)) < 1e-4


@pytest.mark.parametrize("entry, names, shape", [("regression", ("act_pred", "act_tgt"), (2, 5, 1)),
                                                 ("regression_c4", ("reg3_pred", "reg3_tgt"), (2, 3, 4))])
@pytest.mark.parametrize("norm, sums", [("l1", regression.l1_sums), ("l2", regression.l2_sums)])
def test_vector_parity_with_the_reference(entry, names, shape, norm, sums):
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    prediction, target = (jnp.asarray(golden_rule.make_input(name, shape, "pm1")) for name in names)
    loss, gradient = jax.value_and_grad(lambda x: sums(x, target).value())(prediction)
    assert golden.error(f"{entry}_{norm}/loss", loss) < 1e-5
    assert golden.error(f"{entry}_{norm}/grad", gradient) < 1e-4
