"""3x3 convolutions in Winograd's form (muvo_jax.ops.conv_winograd) beside the form with all products, at the paper's
sizes; both take turns: python experiments/speed/fewer_products.py [--frames 6 --rounds 3]

Processor milliseconds; without XLA's fusion emitters, as commands run.
"""

import argparse
import math

import jax
import timing

from muvo_jax.ops import conv_cpu, conv_winograd
from muvo_jax.training import host

# rows, columns, channels of input and output: the six layers of the image decoder, whose transposed kernels of 5x5 or
# 6x6 and stride 2 are 3x3 ones to four times the channels, and the encoder's.
LAYERS = ((5, 13, 512, 2048), (10, 26, 512, 2048), (20, 52, 512, 2048), (40, 104, 512, 1024), (80, 208, 256, 512),
          (160, 416, 128, 256), (80, 208, 64, 64), (40, 104, 128, 128), (20, 52, 256, 256), (10, 26, 512, 512))
SAME = ((1, 1), (1, 1))


def both_ways(function):
    def run(x, kernel, gradient):
        found, pull_back = jax.vjp(function, x, kernel)
        return found, pull_back(gradient)

    return jax.jit(run)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    host.restart_with_huge_pages()  # as `train` does
    host.use_plain_emitters()
    forms = {"all": lambda x, kernel: conv_cpu.all_products(x, kernel, SAME),
             "fewer": lambda x, kernel: conv_winograd.dense(x, kernel, SAME)}
    print("| layer | taken | forward: all products | fewer | times | with gradients: all products | fewer | times |")
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for rows, columns, channels, outputs in LAYERS:
        keys = jax.random.split(jax.random.key(0), 3)
        x = jax.random.normal(keys[0], (options.frames, rows, columns, channels))
        kernel = jax.random.normal(keys[1], (3, 3, channels, outputs)) / math.sqrt(9 * channels)
        gradient = jax.random.normal(keys[2], (options.frames, rows, columns, outputs))
        given = {"forward": (x, kernel), "gradients": (x, kernel, gradient)}
        runs = {(what, name): (jax.jit(form) if what == "forward" else both_ways(form))
                for what in given for name, form in forms.items()}
        took = timing.processor_seconds({key: lambda run=run, given=given[key[0]]: run(*given)
                                         for key, run in runs.items()}, options.rounds)
        cells = []
        for what in given:
            before, after = (1e3 * min(took[what, name]) for name in forms)
            cells += [f"{before:.0f}", f"{after:.0f}", f"{before / after:.2f}"]
        taken = "yes" if conv_winograd.pays(x, kernel, SAME) else "no"
        layer = f"{options.frames}x{rows}x{columns}, {channels} -> {outputs}"
        print(f"| {layer} | {taken} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
