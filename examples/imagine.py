"""From a trained run to imagined futures of one moment, braking or going: python examples/imagine.py runs/town-tr"""

import sys

import jax
import jax.numpy as jnp

import muvo_jax


def main(folder: str = "builtin:town") -> None:
    run = muvo_jax.load(folder)
    model, variables = run.model, run.variables
    batch = muvo_jax.windows(run, count=2)
    past = batch.time_slice(0, batch.frames // 2)

    key_observe, key_imagine = jax.random.split(jax.random.key(0))
    observed = muvo_jax.observe(model, variables, key_observe, past)
    brake, go = jnp.tile(jnp.array([-0.5, 0.0]), (8, 1)), jnp.tile(jnp.array([0.5, 0.0]), (8, 1))  # [8 steps, 2]
    plans = jnp.stack([jnp.stack([brake, go])] * 2)  # [2 starts, 2 plans, 8 steps, 2]: each start under both plans

    # With the same noise the two futures of a start differ by their actions alone.
    dream = muvo_jax.imagine(model, variables, key_imagine, observed.last, plans, same_noise=True)
    print("states of 2 starts under 2 plans of 8 steps:", dream.features.shape)
    braked, went = (muvo_jax.decode(model, variables, dream.states[:, plan, -1:], heads=("image", "occupancy"),
                                    memory=observed.memory) for plan in (0, 1))
    occupied = [jax.nn.softmax(seen.occupancy)[..., 1].mean() for seen in (braked, went)]
    print(f"after them: mean difference of the images {jnp.abs(braked.image - went.image).mean():.4f}, "
          f"share of occupied voxels {occupied[0]:.3f} braking, {occupied[1]:.3f} going")


if __name__ == "__main__":
    main(*sys.argv[1:])
