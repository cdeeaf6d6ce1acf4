"""Embedded windows for the tests of both transitions."""

import jax
import jax.numpy as jnp

from muvo_jax.model import rollout


def make_window(batch, frames, embedding_shape, latent_shape, dropout=False):
    """(embedding, action, is_first, noise) of [batch, frames]; is_first at 0 alone, every other step from the prior."""
    embedding = jax.random.normal(jax.random.key(2), (batch, frames, *embedding_shape))
    action = jax.random.uniform(jax.random.key(3), (batch, frames, 2), minval=-1.0)
    is_first = jnp.zeros((batch, frames), bool).at[:, 0].set(True)
    noise = rollout.draw_noise(jax.random.split(jax.random.key(1), batch), frames, latent_shape, 0.5, dropout=dropout)
    return embedding, action, is_first, noise
