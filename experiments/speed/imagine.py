"""Speed of imagination, as ratios within one run: python experiments/speed/imagine.py [--branches=256]

Compares `imagine` (1D latent, paper size) with the same matrix products alone in jitted JAX, and looks at its time over
horizon and branches and at its first call (compilation) over the horizon.
"""

import argparse
import time

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax import presets


def seconds(function, *arguments, repeats=3):
    """Best of several calls, compilation left out."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def products_alone(config, variables, batch, horizon):
    """The matrix products of `horizon` prior steps [batch, ...], one after the other and nothing else."""
    kernels = [leaf for name in ("pre_gru", "gru", "prior")
               for leaf in jax.tree.leaves(variables["params"]["transition"][name]) if leaf.ndim == 2]

    @jax.jit
    def run(kernels, inputs):
        def step(carry, _):
            outputs = [(x + carry) @ kernel for x, kernel in zip(inputs, kernels, strict=True)]
            return sum(output[0, 0] for output in outputs) * 1e-20, [output[:1] for output in outputs]

        return jax.lax.scan(step, jnp.float32(0), None, length=horizon)

    inputs = [jax.random.normal(jax.random.key(0), (batch, kernel.shape[0])) for kernel in kernels]
    products = sum(2 * batch * kernel.size for kernel in kernels) * horizon
    return (lambda: run(kernels, inputs)), products


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--branches", type=int, default=256)
    parser.add_argument("--horizon", type=int, default=15)
    options = parser.parse_args()
    config = presets.get("paper").model
    model = muvo_jax.WorldModel(config)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    state = model.initial_state(1)

    def imagine(branches, horizon):
        actions = jnp.zeros((1, horizon, 2))
        return lambda: muvo_jax.imagine(model, variables, jax.random.key(0), state, actions, branches=branches)

    alone, operations = products_alone(config, variables, options.branches, options.horizon)
    reference_s = seconds(alone)
    for branches, horizon in ((options.branches, options.horizon), (options.branches, 2 * options.horizon),
                              (2 * options.branches, options.horizon)):
        start = time.perf_counter()
        jax.block_until_ready(imagine(branches, horizon)())
        first_s = time.perf_counter() - start
        taken_s = seconds(imagine(branches, horizon))
        print(f"imagine {branches} branches, {horizon} steps: {taken_s:.3f} s, "
              f"{branches * horizon / taken_s:,.0f} latent steps/s, first call {first_s:.1f} s", flush=True)
        if (branches, horizon) == (options.branches, options.horizon):
            print(f"its matrix products alone: {reference_s:.3f} s ({operations / reference_s / 1e9:.0f} GFLOP/s); "
                  f"imagine reaches {reference_s / taken_s:.0%}", flush=True)


if __name__ == "__main__":
    main()
