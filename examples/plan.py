"""The best plan from one moment on, by search in imagination: python examples/plan.py runs/town-tr

`muvo_jax.agents.closed_loop.planning_driver` does this at every step of a drive; `python -m muvo_jax.drive` shows it.
"""

import sys

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax.agents import planners

STEPS = 6


def main(folder: str = "builtin:town") -> None:
    run = muvo_jax.load(folder)
    batch = muvo_jax.windows(run, "train", count=8)
    observed = muvo_jax.observe(run.model, run.variables, jax.random.key(0), batch)
    world = muvo_jax.Environment.of_run(run)
    params = world.params(run.variables, world.starts(observed, batch, skip=1), horizon=STEPS)
    _, start = world.reset(jax.random.key(1), params)

    settings = planners.PlannerConfig(plans=32, iterations=3, elites=4)

    @jax.jit
    def search(key, first_guess):
        returns = planners.shared_future_returns(world, params, start)  # one future is imagined for all plans
        return planners.cem(returns, key, first_guess, settings)

    plan = search(jax.random.key(2), jnp.zeros((STEPS, 2)))
    print(f"expected return {plan.value:.2f}; acceleration and steering of each step:")
    print(plan.actions.round(2))


if __name__ == "__main__":
    main(*sys.argv[1:])
