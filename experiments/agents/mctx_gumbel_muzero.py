"""Mctx's Gumbel MuZero plans with the world model: python experiments/agents/mctx_gumbel_muzero.py [--run=RUN]

Prior and value are flat, so all that the search knows is what it imagines. Prints the imagined return of driving by the
search beside coasting and random actions.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import mctx
import worlds

from muvo_jax.agents.doors import mctx_model


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run")
    parser.add_argument("--simulations", type=int, default=32)
    parser.add_argument("--horizon", type=int, default=8)
    parser.add_argument("--cars", type=int, default=16)
    options = parser.parse_args()
    core, params = worlds.load(options.run, options.horizon)
    params = dataclasses.replace(params, temperature=jnp.float32(0))
    grid = mctx_model.action_grid(3, 5)
    flat = mctx_model.on_grid(grid, lambda agent, observation: (jnp.zeros(len(grid)), jnp.float32(0)))
    model, search_params = mctx_model.MctxModel(core, flat), mctx_model.SearchParams(params, ())

    def search(key, state):
        root = model.root(search_params, key, state)
        output = mctx.gumbel_muzero_policy(search_params, key, root, model.recurrent_fn,
                                           num_simulations=options.simulations, max_depth=options.horizon,
                                           max_num_considered_actions=len(grid),
                                           gumbel_scale=0.0)  # the best action found: nothing is to be explored
        return model.action(root, output.action)

    drivers = {
        "gumbel_muzero_policy": search, "coasting": lambda key, state: jnp.zeros((options.cars, 2)),
        "random": lambda key, state: jax.random.uniform(key, (options.cars, 2), minval=-1)}
    for name, driver in drivers.items():
        @jax.jit
        def drive(key, driver=driver):
            key_reset, key_steps = jax.random.split(key)
            _, state = jax.vmap(core.reset, (0, None))(jax.random.split(key_reset, options.cars), params)

            def step(carry, key):
                state, alive = carry
                key_driver, key_step = jax.random.split(key)
                action = driver(key_driver, state)
                keys = jax.random.split(key_step, options.cars)
                state, transition = jax.vmap(core.step, (0, 0, 0, None))(keys, state, action, params)
                return (state, alive & ~transition.terminated), alive * transition.reward

            first = (state, jnp.ones(options.cars, bool))
            return jax.lax.scan(step, first, jax.random.split(key_steps, options.horizon))[1].sum(axis=0).mean()

        print(f"{name:22s} imagined return {drive(jax.random.key(0)):.3f}", flush=True)


if __name__ == "__main__":
    main()
