"""The world that the scripts of this folder train in: a run, or fresh weights where none is named."""

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax import presets
from muvo_jax.agents import environment, rewards


def load(run: str | None, horizon: int) -> tuple[environment.Environment, environment.EnvParams]:
    """Environment and params of a run; without one those of untrained weights and random starts.

    Untrained weights show that an agent runs through a door, not that it learns to drive: their reward leaves out the
    collision, so that no occupancy is decoded.
    """
    if run is None:
        config = presets.get("tiny")
        model = muvo_jax.WorldModel(config.model)
        fresh = muvo_jax.Run(model, model.init(jax.random.key(0)), config)
        world = muvo_jax.Environment.of_run(fresh, reward_config=rewards.RewardConfig(collision=0.0))
        latent = jax.tree.map(lambda leaf: 0.5 * jax.random.normal(jax.random.key(0), leaf.shape),
                              model.initial_state(64))
        bank = environment.StartBank(latent, jnp.linspace(0.0, 8.0, 64))
        return world, world.params(fresh.variables, bank, horizon)
    loaded = muvo_jax.load(run)
    batch = muvo_jax.windows(loaded, "train", count=16)
    observed = muvo_jax.observe(loaded.model, loaded.variables, jax.random.key(0), batch)
    world = muvo_jax.Environment.of_run(loaded)
    bank = world.starts(observed, batch, skip=loaded.config.data.context - 1)
    return world, world.params(loaded.variables, bank, horizon)
