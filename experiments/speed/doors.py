"""What the doors that stay inside jit cost over the core, and what decoding a hundredth of the steps costs.

    PYTHONPATH=experiments/agents python experiments/speed/doors.py        (needs gymnax, brax and stoa-env)
"""

import time

import jax
import jax.numpy as jnp
import worlds
from brax.envs.wrappers import training
from stoa.core_wrappers import auto_reset

import muvo_jax
from muvo_jax.agents.doors import brax_env, gymnax_env, stoa_env

CARS, STEPS = 256, 200


def seconds(functions, rounds=7):
    """Name -> best time of a function without arguments; they take turns, so that a busy machine slows all alike."""
    for function in functions.values():
        jax.block_until_ready(function())
    best = dict.fromkeys(functions, float("inf"))
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            best[name] = min(best[name], time.perf_counter() - start)
    return best


def scan(step, carry):
    """A function that makes STEPS steps with auto-reset, jitted."""
    run = jax.jit(lambda carry: jax.lax.scan(step, carry, jax.random.split(jax.random.key(0), STEPS)))
    return lambda: run(carry)


def main():
    core, params = worlds.load(None, 15)
    actions = jnp.zeros((CARS, 2))
    keys = jax.random.split(jax.random.key(1), CARS)

    def core_step(state, key):
        key_step, key_reset = jax.random.split(key)
        state, out = jax.vmap(core.step, (0, 0, 0, None))(jax.random.split(key_step, CARS), state, actions, params)
        state, _ = jax.vmap(core.restart, (0, 0, 0, 0, None))(jax.random.split(key_reset, CARS), state, out.observation,
                                                              out.final, params)
        return state, out.reward.sum() + out.observation.sum()

    env = gymnax_env.GymnaxImagination(core, params)

    def gymnax_step(state, key):
        observation, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            jax.random.split(key, CARS), state, actions, params)
        return state, reward.sum() + observation.sum()

    doors = {"core": (core_step, jax.vmap(core.reset, (0, None))(keys, params)[1]),
             "gymnax": (gymnax_step, jax.vmap(env.reset, (0, None))(keys, params)[1])}
    brax = training.wrap(brax_env.BraxImagination(core, params), episode_length=15)

    def brax_step(state, key):
        del key
        state = brax.step(state, actions)
        return state, state.reward.sum() + state.obs.sum()

    doors["brax"] = (brax_step, brax.reset(jax.random.key_data(keys)))
    stoa = auto_reset.AutoResetWrapper(stoa_env.StoaImagination(core, params))

    def stoa_step(state, key):
        del key
        state, timestep = jax.vmap(stoa.step)(state, actions)
        return state, timestep.reward.sum() + timestep.observation.sum()

    doors["stoa"] = (stoa_step, jax.vmap(stoa.reset)(keys)[0])
    taken = seconds({name: scan(step, carry) for name, (step, carry) in doors.items()})
    print(f"core with restart: {CARS * STEPS / taken['core']:,.0f} steps/s", flush=True)
    for name in list(doors)[1:]:
        print(f"{name}: {taken[name] / taken['core']:.2f} of the core's time", flush=True)

    model, dream = core.model, muvo_jax.imagine(core.model, params.variables, jax.random.key(0), params.bank.latent,
                                                jnp.zeros((64, 100, 2)))
    decode = lambda states: lambda: muvo_jax.decode(model, params.variables, states, heads=("image",))
    taken = seconds({"whole": decode(dream.states), "part": decode(dream.states[:, 50])}, rounds=3)
    print(f"decoding 1 % of {64 * 100} images takes {taken['part'] / taken['whole']:.1%} of decoding all", flush=True)


if __name__ == "__main__":
    main()
