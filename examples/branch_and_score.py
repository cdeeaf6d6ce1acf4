"""Many futures of one moment, each scored by the driving reward: python examples/branch_and_score.py runs/town-tr

The plans hold one steering and one acceleration each; the table says which of them imagination likes, and why.
"""

import sys

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax.agents import environment

STEPS = 6


def main(folder: str = "builtin:town") -> None:
    run = muvo_jax.load(folder)
    batch = muvo_jax.windows(run, "train", count=8)
    observed = muvo_jax.observe(run.model, run.variables, jax.random.key(0), batch)
    world = muvo_jax.Environment.of_run(run)
    params = world.params(run.variables, world.starts(observed, batch, skip=1), horizon=STEPS)
    _, start = world.reset(jax.random.key(1), params)

    held = jnp.stack(jnp.meshgrid(jnp.array([-0.8, 0.0, 0.8]), jnp.array([-0.4, 0.0, 0.4])), axis=-1).reshape(-1, 2)
    plans = jnp.tile(held[:, None], (1, STEPS, 1))  # [9 plans, 6 steps, 2]
    play = lambda plan: environment.play(world, params, jax.random.key(2), start, plan, STEPS)[1]
    drives = jax.vmap(play)(plans)  # the same key: all plans meet the same noise

    print("acceleration  steering  return  metres on the route  collision")
    for plan in jnp.argsort(-drives.reward.sum(axis=1)):
        metres, collision = drives.terms["progress_m"][plan].sum(), drives.terms["collision"][plan].max()
        print(f"{held[plan, 0]:12.1f}  {held[plan, 1]:8.1f}  {drives.reward[plan].sum():6.2f}  {metres:19.1f}  "
              f"{collision:9.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
