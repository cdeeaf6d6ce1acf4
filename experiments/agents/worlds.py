"""The world that the scripts of this folder train in: a run, or fresh weights where none is named."""

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax import presets
from muvo_jax.agents import environment, rewards
from muvo_jax.training import checkpoint


def load(run: str | None, horizon: int) -> tuple[environment.Environment, environment.EnvParams]:
    """Environment and params of a run; without one those of untrained weights and random starts.

    Untrained weights show that an agent runs through a door, not that it learns to drive: their reward leaves out the
    collision, so that no occupancy is decoded.
    """
    if run is None:
        config = presets.get("tiny")
        model = muvo_jax.WorldModel(config.model)
        world = environment.make(model, config, reward_config=rewards.RewardConfig(collision=0.0))
        latent = jax.tree.map(lambda leaf: 0.5 * jax.random.normal(jax.random.key(0), leaf.shape),
                              model.initial_state(64))
        bank = environment.StartBank(latent, jnp.linspace(0.0, 8.0, 64))
        return world, world.params(model.init(jax.random.key(0)), bank, horizon)
    loaded = checkpoint.load_run(run)
    config = loaded.config
    batch = muvo_jax.windows(run, "train", count=16)
    observed = muvo_jax.observe(loaded.model, loaded.variables, jax.random.key(0), batch)
    world = environment.make(loaded.model, config)
    bank = environment.bank_of(observed, batch, skip=config.data.context - 1)
    return world, world.params(loaded.variables, bank, horizon)
