"""The whole table of speed and memory: python experiments/speed/table.py [--sizes town paper] [--latents 1d 2d]
[--sections remat use parts growth imagination data] [--remats none heads frames]

For each size and latent: the parts of a training step; its memory, arithmetic and compilation under each train.remat;
encoding, an imagined step of the latent alone and with all heads. Then how the step and imagination grow, and the data
path. Processor seconds, the least of several rounds, beside what a float32 product reaches in the same run.

At the paper's size the table needs about 20 GiB (`--sizes=town` 6 GiB): estimates come first.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Sequence

import data
import imagine
import jax
import jax.numpy as jnp
import step
import timing

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import rollout
from muvo_jax.training import cost, host, loop, preparation

SIZES = {"tiny": "tiny", "town": "town", "paper": "paper-occupancy"}
REMATS = ("none", "heads", "frames")
SECTIONS = ("remat", "use", "parts", "growth", "imagination", "data")


def config_of(size: str, latent: str) -> config_lib.Config:
    """Of one micro-batch an update: what is measured is a step."""
    return config_lib.override_all(presets.get(SIZES[size]), {"model.latent": latent, "optimizer.accumulate": 1,
                                                              "train.remat": "none"})


def of_step(config: config_lib.Config) -> cost.StepCost:
    return cost.of_step(config, preparation.expected_batch(config, loop.windows_per_step(config)))


def memory(config: config_lib.Config, rounds: int, remats: Sequence[str]) -> None:
    """What the step takes under each policy: memory as XLA plans it, time as measured."""
    print("\n| train.remat | memory of the step (GiB) | arithmetic (GFLOP) | tracing and compiling (processor s) "
          "| a step (processor s) |")
    print("|---|---:|---:|---:|---:|")
    for remat in remats:
        start_s = time.process_time()
        changed = config_lib.override(config, "train.remat", remat)
        found = of_step(changed)
        compiling_s = time.process_time() - start_s
        print(f"| {remat} | {found.total_bytes / 2**30:.2f} | {found.operations / 1e9:.0f} | {compiling_s:.1f} | "
              f"{whole_step_s(changed, rounds):.2f} |", flush=True)


def using(config: config_lib.Config, rounds: int, rate: float) -> None:
    """Encoding a window, and imagining one step."""
    model, batch = muvo_jax.WorldModel(config.model), step.random_batch(config)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    encode = jax.jit(lambda variables, batch: model.encode(variables, batch)[0])
    observed = muvo_jax.observe(model, variables, jax.random.key(0), batch)
    of_window = observed.memory and jax.tree.map(lambda leaf: leaf[:1], observed.memory)
    last = jax.tree.map(lambda leaf: leaf[:1], observed.last)

    def imagined(states, decoded):
        state = jax.tree.map(lambda leaf: jnp.repeat(leaf, states, axis=0), last)
        after = rollout.imagine_step(model, variables, jax.random.key(0), state, jnp.zeros((states, 2)))
        return muvo_jax.decode(model, variables, after, memory=of_window) if decoded else after

    works = {f"encoding {batch.frames} frames of {batch.batch_size} windows": lambda: encode(variables, batch),
             "an imagined step, latent alone": functools.partial(imagined, 1, False),
             "an imagined step, latent alone, 256 states": functools.partial(imagined, 256, False),
             "an imagined step with all heads": functools.partial(imagined, 1, True)}
    if config.preset != "town" and isinstance(config.model.latent, config_lib.TokenLatent):
        del works["an imagined step, latent alone, 256 states"]  # 256 x 1,093 tokens take minutes and gigabytes
    print("\n| what | processor s | products of the same time (GFLOP) |")
    print("|---|---:|---:|")
    for name, seconds in timing.processor_seconds(works, rounds).items():
        print(f"| {name} | {min(seconds):.4f} | {min(seconds) * rate / 1e9:.1f} |", flush=True)


def growth(config: config_lib.Config, rounds: int) -> None:
    """A step's time and memory over batch, frames and picture, each beside the config's own."""
    rows, columns = config.model.image_size
    changes = {"as it is": {}, "twice the windows": {"train.batch": 2 * config.train.batch},
               "twice the frames": {"data.frames": 2 * config.data.frames},
               "twice the pixels": {"model.image_size": (rows, 2 * columns)}}
    print("\n| step | memory (GiB) | processor s | times the first row |")
    print("|---|---:|---:|---:|")
    first = None
    for name, change in changes.items():
        changed = config_lib.override_all(config, change)
        seconds = whole_step_s(changed, rounds)
        first = first or seconds
        print(f"| {name} | {of_step(changed).total_bytes / 2**30:.2f} | {seconds:.2f} | {seconds / first:.2f} |",
              flush=True)


def whole_step_s(config: config_lib.Config, rounds: int) -> float:
    """Of the fastest round."""
    return min(timing.processor_seconds({"step": step.updates(config, step.random_batch(config))[0]}, rounds)["step"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["town", "paper"], choices=SIZES)
    parser.add_argument("--latents", nargs="+", default=["1d", "2d"], choices=["1d", "2d"])
    parser.add_argument("--sections", nargs="+", default=SECTIONS, choices=SECTIONS)
    parser.add_argument("--remats", nargs="+", default=REMATS, choices=REMATS)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    host.restart_with_huge_pages()  # as `train` does
    host.use_plain_emitters()
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured
    rate = cost.product_rate()
    print(f"float32 product of {cost.GEMM_SIDE}x{cost.GEMM_SIDE}: {rate / 1e9:.0f} GFLOP a processor second")
    for size in options.sizes:
        for latent in options.latents:
            config = config_of(size, latent)
            print(f"\n## {size}, {latent}: {config.train.batch} windows of {config.data.frames} frames\n")
            if "remat" in options.sections:
                memory(config, options.rounds, options.remats)
            if "use" in options.sections:
                using(config, options.rounds, rate)
            if "parts" in options.sections:
                print()
                step.profile(config, options.rounds, rate)
    small = config_of("town" if "town" in options.sizes else options.sizes[0], options.latents[0])
    if "growth" in options.sections:
        print(f"\n## How it grows ({small.preset}, {options.latents[0]})")
        growth(small, options.rounds)
    if "imagination" in options.sections:
        print()
        bare = muvo_jax.WorldModel(dataclasses.replace(
            presets.get("paper-occupancy" if "paper" in options.sizes else small.preset).model,
            latent=config_of(options.sizes[-1], "1d").model.latent, heads=("action",)))
        imagine.times(bare, argparse.Namespace(branches=256, horizon=15, rounds=options.rounds))
    if "data" in options.sections:
        print("\n## Data\n\n| what | plain | here | ratio |\n|---|---|---|---|")
        print(data.projection(), data.voxelisation(), sep="\n")
    print(f"\nfloat32 product at the end: {cost.product_rate() / 1e9:.0f} GFLOP a processor second; another "
          "number than at the start says that the machine was not steady")


if __name__ == "__main__":
    main()
