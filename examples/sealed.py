"""A sealed world model (python -m muvo_jax.export RUN SEALED) without muvo_jax: python examples/sealed.py SEALED

Needs jax, flatbuffers and safetensors. It filters a stream of observations, here of zeros, then imagines braking and
accelerating from the last one.
"""

import json
import pathlib
import re
import sys

import jax
import jax.export
import numpy as np
from safetensors.numpy import load_file


def zeros(signature: str, batch: int) -> np.ndarray:
    """An array of what signatures.json describes, such as "float32[b, 10, 2]"."""
    dtype, sizes = re.fullmatch(r"(\w+)\[(.*)\]", signature).groups()
    return np.zeros([batch if size == "b" else int(size) for size in sizes.split(", ") if size], dtype)


def main(folder: pathlib.Path) -> None:
    weights = load_file(folder / "weights.safetensors")
    signatures = json.loads((folder / "signatures.json").read_text())["functions"]
    sealed = {name: jax.jit(jax.export.deserialize(bytearray((folder / f"{name}.bin").read_bytes())).call)
              for name in signatures}

    stream, observation, action = jax.tree.map(lambda text: zeros(text, 1), signatures["observe_step"]["arguments"])
    stream["keys"] = jax.random.key_data(jax.random.split(jax.random.key(0), 1))
    for _ in range(3):
        stream = sealed["observe_step"](weights, stream, observation, action)

    _, state, plans, _ = signatures["imagine"]["arguments"]
    state, plans = {name: np.repeat(stream[name], 2, axis=0) for name in state}, zeros(plans, 2)
    memory = {name.removeprefix("memory/"): np.repeat(value, 2, axis=0) for name, value in stream.items()
              if name.startswith("memory/")}
    plans[:, :, 0] = [[-0.5], [0.5]]
    keys = jax.random.key_data(jax.random.split(jax.random.key(1), 2))
    dream = sealed["imagine"](weights, keys, state, plans, np.float32(1))
    last = {name: value[:, -1] for name, value in dream.items()}
    for name in sorted(signatures):
        if name.startswith("decode_"):
            looks = [memory] * (len(signatures[name]["arguments"]) - 1)
            print(f"{name} after {plans.shape[1]} steps: {sealed[name](weights, last, *looks).shape}")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
