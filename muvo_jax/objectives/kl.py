"""Balanced Kullback-Leibler divergence between the posterior and the prior (paper Eq. 1).

The divergence is summed over the channels of the 1D latent and averaged over batch and time. With the 2D latent it is
summed over the tokens and averaged over their channels too, as in the reference, so that one weight serves both. One
share trains the prior towards a fixed posterior, the rest trains the posterior towards a fixed prior.

Standard: KL(posterior_t || prior_t) at every t; the first prior is that of the zero state. The reference leaves the
first prior out and compares the first posterior with N(0, 1), and by a slip of an index it takes the posterior's std of
step 1 with the mean of step 0; `numerics="reference"` keeps that.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from muvo_jax import types
from muvo_jax.objectives import regression


def gaussian_kl(posterior: types.Gaussian, prior: types.Gaussian) -> types.Array:
    """KL(posterior || prior) of Gaussians [B, T, S] or [B, T, N, C], summed over S or N: to [B, T] or [B, T, C]."""
    precision = 1.0 / prior.std
    spread = jnp.square(posterior.std * precision)
    shift = jnp.square((posterior.mean - prior.mean) * precision)
    return (0.5 * (spread + shift - 1.0) - jnp.log(posterior.std * precision)).sum(axis=2)


def balanced_kl_sums(posterior: types.Gaussian, prior: types.Gaussian, *, balance: float,
                     numerics: str = "standard") -> regression.MeanSums:
    """Sums of the balanced divergence over batch and time (and the channels of tokens).

    Args:
      posterior, prior: Gaussian [B, T, S] or [B, T, N, C], float32.
      balance: share that trains the prior; the value does not depend on it, the gradient does.
      numerics: "standard" or "reference", see the module.

    Raises:
      ValueError: for a window of one frame under `numerics="reference"`, whose rule needs the second frame.
    """
    if numerics == "reference":
        posterior, prior = _reference_first_step(posterior, prior)
    trains_prior = gaussian_kl(jax.lax.stop_gradient(posterior), prior)
    trains_posterior = gaussian_kl(posterior, jax.lax.stop_gradient(prior))
    divergence = balance * trains_prior + (1.0 - balance) * trains_posterior
    return regression.MeanSums(divergence.sum(), jnp.float32(divergence.size))


def _reference_first_step(posterior: types.Gaussian, prior: types.Gaussian) -> tuple[types.Gaussian, types.Gaussian]:
    if posterior.mean.shape[1] < 2:
        raise ValueError('KL with numerics="reference": got a window of 1 frame, expected at least 2 (the rule of the '
                         'reference reads the second one). Use longer windows or numerics="standard".')
    first_prior = types.Gaussian(jnp.zeros_like(prior.mean[:, :1]), jnp.ones_like(prior.std[:, :1]))
    later_prior = prior[:, 1:]
    prior = jax.tree.map(lambda first, later: jnp.concatenate([first, later], axis=1), first_prior, later_prior)
    std = jnp.concatenate([posterior.std[:, 1:2], posterior.std[:, 1:]], axis=1)
    return types.Gaussian(posterior.mean, std), prior
