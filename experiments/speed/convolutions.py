"""Compares the convolutions of muvo_jax.ops.conv with plain XLA, layer by layer, in one run.

    python experiments/speed/convolutions.py [--height 20 --width 52 --batch 1 --repeats 3 --output results.md]

Both forms of a layer take turns, so that a busy machine slows both; what counts is the ratio.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.ops import conv as conv_ops
from muvo_jax.ops import conv_doubled


@dataclasses.dataclass(frozen=True)
class Layer:
    name: str
    function: Callable
    x_shape: tuple[int, ...]
    kernel_shape: tuple[int, ...]

    def operations(self) -> int:
        """Of the forward pass; a transposed layer works at the input's positions, the others at the output's."""
        out = jax.eval_shape(self.function, jnp.zeros(self.x_shape), jnp.zeros(self.kernel_shape)).shape
        positions = np.prod(self.x_shape[:-1] if self.function.func is conv_ops.conv_transpose else out[:-1])
        return 2 * int(positions) * int(np.prod(self.kernel_shape))


def layers(batch: int, height: int, width: int) -> list[Layer]:
    """The reference's kinds of layers; `height` and `width` are those of the transposed layer's input."""
    conv, conv_transpose = conv_ops.conv, conv_ops.conv_transpose
    side, depth = max(8, height), max(4, height // 3)
    return [
        Layer("transposed 6x6 stride 2, 256 -> 128", functools.partial(conv_transpose, stride=2, padding=2),
              (batch, height, width, 256), (6, 6, 256, 128)),
        Layer("3x3, 128 -> 128", functools.partial(conv, padding=1), (batch, height, width, 128), (3, 3, 128, 128)),
        Layer("3x3 stride 2, 64 -> 128", functools.partial(conv, stride=2, padding=1),
              (batch, 2 * height, 2 * width, 64), (3, 3, 64, 128)),
        Layer("7x7 stride 2, 3 -> 64", functools.partial(conv, stride=2, padding=3),
              (batch, 4 * height, 4 * width, 3), (7, 7, 3, 64)),
        Layer("3x3x3, 16 -> 8", functools.partial(conv, padding=1),
              (batch, 2 * side, 2 * side, 2 * depth, 16), (3, 3, 3, 16, 8)),
        Layer("3x3x3 of what is doubled, 16 -> 8", functools.partial(conv_doubled.conv_doubled),
              (batch, side, side, depth, 16), (3, 3, 3, 16, 8)),
        Layer("3x3x3, 64 -> 64", functools.partial(conv, padding=1),
              (batch, side, side, depth, 64), (3, 3, 3, 64, 64)),
        Layer("3x3, 512 -> 512, of one pixel", functools.partial(conv, padding=1),
              (24 * batch, 1, 1, 512), (3, 3, 512, 512)),
        Layer("3x3 stride 2, 64 -> 512, of 2x4 pixels", functools.partial(conv, stride=2, padding=1),
              (24 * batch, 2, 4, 64), (3, 3, 64, 512)),
    ]


def forward(function, x, kernel, cotangent):
    return function(x, kernel)


def forward_and_backward(function, x, kernel, cotangent):
    value, pull_back = jax.vjp(function, x, kernel)
    return value, pull_back(cotangent)


def seconds(measure, layer: Layer, repeats: int) -> tuple[float, float]:
    """The shortest of `repeats` runs of our form and of plain XLA, taking turns."""
    random = np.random.default_rng(0)
    draw = lambda shape: jnp.asarray(random.normal(size=shape), jnp.float32)
    x, kernel = draw(layer.x_shape), draw(layer.kernel_shape)
    cotangent = draw(jax.eval_shape(layer.function, x, kernel).shape)
    compiled = []
    for implementation in ("auto", "xla"):
        function = functools.partial(layer.function, implementation=implementation)
        compiled.append(jax.jit(functools.partial(measure, function)).lower(x, kernel, cotangent).compile())
        jax.block_until_ready(compiled[-1](x, kernel, cotangent))
    best = [float("inf"), float("inf")]
    for _ in range(repeats):
        for index, run in enumerate(compiled):
            start = time.perf_counter()
            jax.block_until_ready(run(x, kernel, cotangent))
            best[index] = min(best[index], time.perf_counter() - start)
    return best[0], best[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=20, help="rows of the transposed layer's input (paper: 80)")
    parser.add_argument("--width", type=int, default=52, help="its columns (paper: 208)")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--output", type=pathlib.Path, help="also write the table to this file")
    arguments = parser.parse_args()
    lines = [f"Backend {jax.default_backend()}, batch {arguments.batch}, transposed layer from "
             f"{arguments.height}x{arguments.width}; milliseconds, and how many times faster than plain XLA.", "",
             "| layer | input | GFLOP | forward | XLA | times | forward + backward | XLA | times |",
             "|---|---|---|---|---|---|---|---|---|"]
    print("\n".join(lines))
    for layer in layers(arguments.batch, arguments.height, arguments.width):
        cells = [layer.name, "x".join(map(str, layer.x_shape)), f"{layer.operations() / 1e9:.2f}"]
        for measure in (forward, forward_and_backward):
            ours, xla = seconds(measure, layer, arguments.repeats)
            cells += [f"{1e3 * ours:.1f}", f"{1e3 * xla:.1f}", f"{xla / ours:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    if arguments.output:
        arguments.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
