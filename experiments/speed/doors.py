"""What the doors that stay inside jit cost over the core, auto-reset included, in processor seconds.

    PYTHONPATH=experiments/agents python experiments/speed/doors.py [--run=RUN]        (needs gymnax, brax, stoa-env)
    ... --run=builtin:town --cars=8 --steps=3 --rounds=3      (decodes occupancy for the reward in every step)

Every step of core and doors gives what a training loop consumes: reward, and the observation after auto-reset.
"""

import argparse

import jax
import jax.numpy as jnp
import timing
import worlds
from brax.envs.wrappers import training
from stoa.core_wrappers import auto_reset

from muvo_jax.agents.doors import brax_env, gymnax_env, stoa_env


def doors(core, params, cars, horizon):
    """Name -> (step(carry, key) -> (carry, what is consumed), first carry)."""
    actions = jnp.zeros((cars, 2))
    keys = jax.random.split(jax.random.key(1), cars)
    every = lambda function, *axes: jax.vmap(function, (*axes, None))

    def core_step(state, key):
        key_step, key_reset = jax.random.split(key)
        state, out = every(core.step, 0, 0, 0)(jax.random.split(key_step, cars), state, actions, params)
        state, observation = every(core.restart, 0, 0, 0, 0)(jax.random.split(key_reset, cars), state, out.observation,
                                                             out.final, params)
        return state, (out.reward.sum(), observation.sum())

    gymnax = gymnax_env.GymnaxImagination(core, params)

    def gymnax_step(state, key):
        keys = jax.random.split(key, cars)
        observation, state, reward, *_ = every(gymnax.step, 0, 0, 0)(keys, state, actions, params)
        return state, (reward.sum(), observation.sum())

    brax = training.wrap(brax_env.BraxImagination(core, params), episode_length=horizon)

    def brax_step(state, key):
        del key
        state = brax.step(state, actions)
        return state, (state.reward.sum(), state.obs.sum())

    stoa = auto_reset.AutoResetWrapper(stoa_env.StoaImagination(core, params))

    def stoa_step(state, key):
        del key
        state, timestep = jax.vmap(stoa.step)(state, actions)
        return state, (timestep.reward.sum(), timestep.observation.sum())

    return {"core": (core_step, every(core.reset, 0)(keys, params)[1]),
            "gymnax": (gymnax_step, every(gymnax.reset, 0)(keys, params)[1]),
            "brax": (brax_step, brax.reset(jax.random.key_data(keys))),
            "stoa": (stoa_step, jax.vmap(stoa.reset)(keys)[0])}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run")
    parser.add_argument("--cars", type=int, default=256)
    parser.add_argument("--steps", type=int, default=200, help="of every car in a round")
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--horizon", type=int, default=15)
    options = parser.parse_args()
    core, params = worlds.load(options.run, options.horizon)

    def rollout(step, carry):
        run = jax.jit(lambda carry: jax.lax.scan(step, carry, jax.random.split(jax.random.key(0), options.steps)))
        return lambda: run(carry)

    loops = {name: rollout(*door) for name, door in doors(core, params, options.cars, options.horizon).items()}
    first = {name: timing.first_call_s(loop) for name, loop in loops.items()}
    taken = timing.processor_seconds(loops, options.rounds)
    count = options.cars * options.steps
    for name, seconds in taken.items():
        print(f"{name:7s} {1000 * min(seconds) / count:9.3f} ms of processor time a step, "
              f"{timing.ratio(seconds, taken['core']):.2f} of the core's; the first call {first[name]:.0f} s",
              flush=True)


if __name__ == "__main__":
    main()
