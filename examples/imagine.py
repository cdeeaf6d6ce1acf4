"""From a trained run to imagined futures: python examples/imagine.py runs/town-tr"""

import sys

import jax
import jax.numpy as jnp

import muvo_jax


def main(folder: str) -> None:
    run = muvo_jax.load(folder)
    model, variables = run.model, run.variables
    batch = muvo_jax.windows(run, count=2)
    past = batch.time_slice(0, batch.frames // 2)

    key_observe, key_imagine = jax.random.split(jax.random.key(0))
    observed = muvo_jax.observe(model, variables, key_observe, past)
    brake_or_go = jnp.stack([jnp.full((8, 2), -0.5), jnp.full((8, 2), 0.5)])  # [B = 2, horizon = 8, 2]
    dream = muvo_jax.imagine(model, variables, key_imagine, observed.last, brake_or_go.at[..., 1].set(0.0), branches=16)
    print("16 futures of 8 steps for 2 starts:", dream.features.shape)
    predictions = muvo_jax.decode(model, variables, dream.states[:, 0, ::4], heads=("image", "occupancy"),
                                  memory=observed.memory)
    print("decoded, 1 branch, every fourth step:", {head: predictions[head].shape for head in predictions})


if __name__ == "__main__":
    main(sys.argv[1])
