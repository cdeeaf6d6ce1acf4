"""Speed and memory of imagination (1D latent, paper size), in processor seconds: python experiments/speed/imagine.py

`imagine` beside its matrix products alone in jitted JAX; its time over horizon and branches; what compiling takes over
the horizon; its memory beside what decoding would need; what decoding a chosen hundredth of the steps costs.
"""

import argparse
import dataclasses
import time

import jax
import jax.numpy as jnp
import timing

import muvo_jax
from muvo_jax import presets


def products_alone(variables, batch, horizon):
    """(function, operations): the matrix products of `horizon` prior steps [batch, ...] and nothing else."""
    kernels = [leaf for name in ("pre_gru", "gru", "prior")
               for leaf in jax.tree.leaves(variables["params"]["transition"][name]) if leaf.ndim == 2]

    @jax.jit
    def run(kernels, inputs):
        def step(carry, _):
            outputs = [(x + carry) @ kernel for x, kernel in zip(inputs, kernels, strict=True)]
            return sum(output[0, 0] for output in outputs) * 1e-20, [output[:1] for output in outputs]

        return jax.lax.scan(step, jnp.float32(0), None, length=horizon)

    inputs = [jax.random.normal(jax.random.key(0), (batch, kernel.shape[0])) for kernel in kernels]
    return lambda: run(kernels, inputs), sum(2 * batch * kernel.size for kernel in kernels) * horizon


def program(model, branches, horizon):
    """`imagine`, lowered for `branches` futures of one state."""
    shapes = jax.eval_shape(lambda: (jax.random.key(0), model.initial_state(1), jnp.zeros((1, horizon, 2))))
    run = jax.jit(lambda variables, key, state, actions: muvo_jax.imagine(model, variables, key, state, actions,
                                                                          branches=branches))
    return run.lower(model.variable_shapes(), *shapes)


def times(model, options):
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    state = model.initial_state(1)
    imagine = lambda branches, horizon: lambda: muvo_jax.imagine(
        model, variables, jax.random.key(0), state, jnp.zeros((1, horizon, 2)), branches=branches)
    branches, horizon = options.branches, options.horizon
    alone, operations = products_alone(variables, branches, horizon)
    sizes = [(branches, horizon), (branches, 2 * horizon), (branches, 4 * horizon), (2 * branches, horizon),
             (4 * branches, horizon)]
    taken = timing.processor_seconds({"alone": alone} | {size: imagine(*size) for size in sizes}, options.rounds)
    first = taken[sizes[0]]
    print(f"matrix products alone: {min(taken['alone']):.3f} s, {operations / min(taken['alone']) / 1e9:.0f} GFLOP "
          f"a processor second; imagine reaches {1 / timing.ratio(first, taken['alone']):.0%} of their speed")
    print("| branches | horizon | processor seconds | latent steps a processor second | times the first row |")
    print("|---:|---:|---:|---:|---:|")
    for size in sizes:
        print(f"| {size[0]} | {size[1]} | {min(taken[size]):.3f} | {size[0] * size[1] / min(taken[size]):,.0f} | "
              f"{timing.ratio(taken[size], first):.2f} |", flush=True)


def compilation(model, options):
    print("| horizon | processor seconds to trace and compile | memory while running (MB) | results (MB) |")
    print("|---:|---:|---:|---:|")
    for horizon in (options.horizon, 4 * options.horizon, 16 * options.horizon):
        start = time.process_time()
        compiled = program(model, options.branches, horizon).compile()
        taken = time.process_time() - start
        memory = compiled.memory_analysis()
        print(f"| {horizon} | {taken:.2f} | {memory.temp_size_in_bytes / 1e6:.1f} | "
              f"{memory.output_size_in_bytes / 1e6:.1f} |", flush=True)


def decoding():
    """Decoding some of 6,400 imagined images; the tiny model, since 6,400 of the paper's take minutes and gigabytes."""
    model = muvo_jax.WorldModel(presets.get("tiny").model)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    dream = muvo_jax.imagine(model, variables, jax.random.key(0), model.initial_state(64), jnp.zeros((64, 100, 2)))
    decode = lambda states: muvo_jax.decode(model, variables, states, heads=("image",))
    steps = [dream.states[:, step] for step in range(0, 100, 10)]
    taken = timing.processor_seconds({"all": lambda: decode(dream.states),
                                      "ten times one step": lambda: [decode(step) for step in steps]}, rounds=10)
    share = timing.ratio(taken["ten times one step"], taken["all"]) / len(steps)
    print(f"decoding a step, 1 % of 6,400 images, takes {share:.1%} of decoding all")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--branches", type=int, default=256)
    parser.add_argument("--horizon", type=int, default=15)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured
    config = presets.get("paper-occupancy").model
    whole = muvo_jax.WorldModel(config)
    bare = muvo_jax.WorldModel(dataclasses.replace(config, heads=("action",)))
    same = program(whole, options.branches, options.horizon).as_text() == program(
        bare, options.branches, options.horizon).as_text()
    print(f"the program of imagine with the heads {', '.join(config.heads)} and with the action's alone: "
          f"{'the same' if same else 'DIFFERENT'}")
    compilation(bare, options)
    times(bare, options)
    decoding()


if __name__ == "__main__":
    main()
