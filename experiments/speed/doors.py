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


def seconds(function, *arguments):
    """Best of five calls, compilation left out."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def scan(step, carry):
    """STEPS steps with auto-reset, jitted; the seconds it takes."""
    def run(carry):
        return jax.lax.scan(step, carry, jax.random.split(jax.random.key(0), STEPS))[1]

    return seconds(jax.jit(run), carry)


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

    base_s = scan(core_step, jax.vmap(core.reset, (0, None))(keys, params)[1])
    print(f"core with restart: {CARS * STEPS / base_s:,.0f} steps/s", flush=True)

    env = gymnax_env.GymnaxImagination(core, params)

    def gymnax_step(state, key):
        observation, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            jax.random.split(key, CARS), state, actions, params)
        return state, reward.sum() + observation.sum()

    doors = {"gymnax": (gymnax_step, jax.vmap(env.reset, (0, None))(keys, params)[1])}
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
    for name, (step, carry) in doors.items():
        print(f"{name}: {scan(step, carry) / base_s:.2f} of the core's time", flush=True)

    model, dream = core.model, muvo_jax.imagine(core.model, params.variables, jax.random.key(0), params.bank.latent,
                                                jnp.zeros((64, 100, 2)))
    whole = seconds(lambda: muvo_jax.decode(model, params.variables, dream.states, heads=("image",)))
    part = seconds(lambda: muvo_jax.decode(model, params.variables, dream.states[:, 50], heads=("image",)))
    print(f"decoding 1 % of {64 * 100} images takes {part / whole:.1%} of decoding all", flush=True)


if __name__ == "__main__":
    main()
