"""Fresh parameters by rules over names and shapes, in NumPy: nothing is traced or compiled.

| leaf | values |
|---|---|
| kernel of a backbone's convolution | normal, variance 2 / fan_out (He) |
| in_proj kernel of an attention | uniform (Xavier) |
| other kernel; its bias | uniform, variance 1 / fan_in (LeCun); 0 |
| seed_kernel, transposed_kernel | uniform, variance 1.5 / (inputs that reach one output); their bias 0 |
| bias of an adaptive norm's style map | 1 for the scale, 0 for the shift |
| GRU kernels and biases | uniform within 1 / sqrt(hidden channels) |
| scale of the norm that ends a residual branch (bn2), of another norm; its bias | 0, 1; 0 |
| constant and query_*; type_embedding | standard normal; 0 |
| running mean; running variance, spread of actions | 0; 1 |

Torch's defaults (uniform within 1 / sqrt(fan_in)) shrink the signal in every dense layer and several times in every
transposed one, and start adaptive norms at a scale near 0: what a latent says then drowns in its noise, and decoders
are slow to listen to it. So these rules depart from the reference, which matters to fresh models only. 1.5 makes up for
ELU's loss of variance.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

_ELU_VARIANCE_GAIN = 1.5


def fill(shapes: Mapping[str, Any], key: jax.Array, constants: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Returns float32 arrays for a tree of shapes.

    Args:
      shapes: {"params": ..., "batch_stats": ...} with leaves that have a `shape`, as jax.eval_shape gives.
      key: typed PRNG key; each leaf depends on the key and its own path only.
      constants: path of a parameter ("decoders/image/head_1/bias") -> number or array that replaces the rule.

    Raises:
      ValueError: for a traced key, under jit, vmap or grad.
    """
    if isinstance(key, jax.core.Tracer):
        raise ValueError("init: got a traced key (under jit, vmap or the like), but it draws with NumPy, on the host; "
                         "call it outside. For shapes alone use model.variable_shapes(); for several models stack what "
                         "a loop over keys gives.")
    words = [int(word) for word in np.asarray(jax.random.key_data(key)).ravel()]
    constants = constants or {}

    def visit(node, path):
        if not hasattr(node, "shape"):
            return {name: visit(child, (*path, name)) for name, child in node.items()}
        name = "/".join(path[1:])
        if path[0] == "params" and name in constants:
            return np.broadcast_to(np.float32(constants[name]), node.shape).copy()
        random = np.random.default_rng([*words, zlib.crc32("/".join(path).encode())])
        siblings = shapes
        for part in path[:-1]:
            siblings = siblings[part]
        return _leaf(path, {name: leaf.shape for name, leaf in siblings.items() if hasattr(leaf, "shape")}, random)

    return {name: visit(child, (name,)) for name, child in shapes.items()}


def _uniform(random: np.random.Generator, shape: tuple[int, ...], bound: float) -> np.ndarray:
    return np.float32(bound) * (2 * random.random(shape, np.float32) - 1)


def _leaf(path: tuple[str, ...], siblings: Mapping[str, tuple[int, ...]], random: np.random.Generator) -> np.ndarray:
    leaf, shape = path[-1], siblings[path[-1]]
    if path[0] == "batch_stats":
        return np.full(shape, 1.0 if leaf in ("var", "action_spread") else 0.0, np.float32)
    if leaf == "constant" or leaf.startswith("query_"):
        return random.standard_normal(shape, np.float32)
    if leaf == "scale":
        return np.zeros(shape, np.float32) if path[-2] == "bn2" else np.ones(shape, np.float32)
    if leaf == "bias" and path[-2] == "style":
        return np.repeat(np.array([1, 0], np.float32), shape[0] // 2)
    if leaf in ("type_embedding", "bias"):
        return np.zeros(shape, np.float32)
    if "hidden_kernel" in siblings:
        return _uniform(random, shape, siblings["hidden_kernel"][0] ** -0.5)
    if leaf in ("seed_kernel", "transposed_kernel"):
        return _uniform(random, shape, math.sqrt(3 * _ELU_VARIANCE_GAIN / _reaching_inputs(leaf, shape)))
    if path[-2] == "in_proj":
        return _uniform(random, shape, math.sqrt(6 / (shape[0] + shape[1])))
    if "backbone" in path and len(shape) == 4:
        fan_out = math.prod(shape[:-2]) * shape[-1]
        return np.float32(math.sqrt(2 / fan_out)) * random.standard_normal(shape, np.float32)
    return _uniform(random, shape, math.sqrt(3 / math.prod(shape[:-1])))


def _reaching_inputs(leaf: str, shape: tuple[int, ...]) -> float:
    """Input values that reach one output value: all of a seed's one pixel, at stride 2 one tap in 2**d of each."""
    if leaf == "seed_kernel":
        return shape[-2]
    return shape[-2] * math.prod(shape[:-2]) / 2 ** (len(shape) - 2)
