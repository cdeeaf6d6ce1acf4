"""Balanced KL: worked arithmetic, gradient shares, parity with the reference's first-step rule."""

import golden_rule
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import types
from muvo_jax.objectives import kl

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def gaussian(mean, std, shape):
    return types.Gaussian(jnp.full(shape, mean), jnp.full(shape, std))


def test_worked_arithmetic():
    # KL(N(1, 1) || N(0, 2)) = ln 2 - 1/2 + (1 + 1) / 8 = 0.4431 for each of 2 channels
    sums = kl.balanced_kl_sums(gaussian(1.0, 1.0, (3, 4, 2)), gaussian(0.0, 2.0, (3, 4, 2)), balance=0.75)
    np.testing.assert_allclose(sums.value(), 2 * (np.log(2) - 0.5 + 0.25), rtol=1e-6)
    assert sums.count == 12


def test_every_step_counts_the_first_included():
    posterior, prior = gaussian(0.0, 1.0, (1, 3, 1)), gaussian(0.0, 1.0, (1, 3, 1))
    posterior = posterior.replace(mean=posterior.mean.at[0, 0].set(2.0))
    # Only step 0 differs: KL(N(2, 1) || N(0, 1)) = 2, a third of it in the mean.
    np.testing.assert_allclose(kl.balanced_kl_sums(posterior, prior, balance=0.5).value(), 2 / 3, rtol=1e-6)


def test_balance_shares_the_gradient_but_not_the_value():
    posterior, prior = gaussian(1.0, 1.0, (1, 2, 1)), gaussian(0.0, 2.0, (1, 2, 1))

    def value(posterior, prior, balance):
        return kl.balanced_kl_sums(posterior, prior, balance=balance).value()

    for balance in (0.0, 0.75, 1.0):
        loss, (to_posterior, to_prior) = jax.value_and_grad(value, argnums=(0, 1))(posterior, prior, balance)
        np.testing.assert_allclose(loss, np.log(2) - 0.25, rtol=1e-6)
        # d/d mu_posterior = (mu_q - mu_p) / sigma_p^2 = 1/4 for each of two steps, halved by the mean
        np.testing.assert_allclose(to_posterior.mean.sum(), (1 - balance) * 0.25, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(to_prior.mean.sum(), -balance * 0.25, rtol=1e-6, atol=1e-7)


def test_reference_rule_pairs_the_first_mean_with_the_second_std():
    posterior = types.Gaussian(jnp.array([[[3.0], [0.0]]]), jnp.array([[[7.0], [0.5]]]))
    prior = types.Gaussian(jnp.array([[[9.0], [1.0]]]), jnp.array([[[8.0], [2.0]]]))
    # First step: KL(N(3, 0.5) || N(0, 1)); second: KL(N(0, 0.5) || N(1, 2)).
    first = -np.log(0.5) + (0.25 + 9) / 2 - 0.5
    second = np.log(4) + (0.25 + 1) / 8 - 0.5
    sums = kl.balanced_kl_sums(posterior, prior, balance=0.75, numerics="reference")
    np.testing.assert_allclose(sums.value(), (first + second) / 2, rtol=1e-6)


def test_reference_rule_refuses_a_single_frame():
    with pytest.raises(ValueError, match="window of 1 frame"):
        kl.balanced_kl_sums(gaussian(0.0, 1.0, (1, 1, 1)), gaussian(0.0, 1.0, (1, 1, 1)), balance=0.75,
                            numerics="reference")


def channels_last(array):
    """[B, T, C, N] of the reference to [B, T, N, C], and back; [B, T, S] as it is."""
    return jnp.swapaxes(jnp.asarray(array), 2, -1)


def test_tokens_are_summed_and_their_channels_averaged():
    # N(1, 1) against N(0, 2) in the first of 2 channels, no difference in the second; 3 tokens: 3 * 0.4431 / 2.
    shift = lambda value, other: jnp.broadcast_to(jnp.float32([value, other]), (2, 4, 3, 2))
    posterior = types.Gaussian(shift(1.0, 5.0), shift(1.0, 0.5))
    prior = types.Gaussian(shift(0.0, 5.0), shift(2.0, 0.5))
    sums = kl.balanced_kl_sums(posterior, prior, balance=0.75)
    np.testing.assert_allclose(sums.value(), 3 * (np.log(2) - 0.25) / 2, rtol=1e-6)
    assert sums.count == 2 * 4 * 2


@pytest.mark.parametrize("tag, shape", [("1d", (2, 4, 16)), ("2d", (2, 3, 8, 11))])
@pytest.mark.parametrize("balance", [0.75, 0.5])
def test_parity_with_the_reference(tag, shape, balance):
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    posterior, prior = (
        types.Gaussian(*(channels_last(golden_rule.make_input(f"kl_{tag}_{which}_{field}", shape, kind))
                         for field, kind in (("mu", "normal"), ("sigma", "sigma"))))
        for which in ("posterior", "prior"))
    value = lambda posterior, prior: kl.balanced_kl_sums(posterior, prior, balance=balance,
                                                         numerics="reference").value()
    loss, gradients = jax.value_and_grad(value, argnums=(0, 1))(posterior, prior)
    entry = f"kl{balance}_{tag}"
    assert golden.error(f"{entry}/loss", loss) < 1e-5
    for which, gradient in zip(("posterior", "prior"), gradients, strict=True):
        assert golden.error(f"{entry}/grad_{which}_mu", channels_last(gradient.mean)) < 1e-4
        assert golden.error(f"{entry}/grad_{which}_sigma", channels_last(gradient.std)) < 1e-4
