"""A small world model with fresh weights, and environments on it, for the tests of agents."""

import functools

import jax
import jax.numpy as jnp

from muvo_jax import presets
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import rewards
from muvo_jax.model import world_model
from muvo_jax.types import LatentState

CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
STARTS, HORIZON = 5, 3
NO_COLLISION = rewards.RewardConfig(collision=0.0)


@functools.cache
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


@functools.cache
def bank():
    draw = lambda seed, channels: jax.random.normal(jax.random.key(seed), (STARTS, channels))
    sizes = CONFIG.latent
    latent = LatentState(jnp.tanh(draw(1, sizes.deterministic_channels)), draw(2, sizes.stochastic_channels))
    route_map = jnp.zeros((STARTS, 64, 64), jnp.uint8).at[:, :, 30:34].set(255)
    return environment_lib.StartBank(latent, jnp.linspace(2.0, 8.0, STARTS), route_map)


def make(horizon=HORIZON, **options):
    """(environment, params); without occupancy in the reward unless asked otherwise, since decoding compiles long."""
    environment = environment_lib.Environment(MODEL, periods=2, **{"reward_config": NO_COLLISION} | options)
    return environment, environment.params(variables(), bank(), horizon)
