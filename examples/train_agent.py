"""An actor-critic that learns in imagination alone: python examples/train_agent.py runs/town-tr [OUT [UPDATES]]

The agent is written to OUT, by default RUN/example_agent. Then it drives in the town:
python -m muvo_jax.drive runs/town-tr --agent=learned,expert --policy=runs/town-tr/example_agent
"""

import sys

import jax

import muvo_jax
from muvo_jax.agents import actor_critic, policy_file


def main(folder: str = "builtin:town", out: str = "", updates: str = "20") -> None:
    run = muvo_jax.load(folder)
    batch = muvo_jax.windows(run, "train", count=8)
    observed = muvo_jax.observe(run.model, run.variables, jax.random.key(0), batch)
    world = muvo_jax.Environment.of_run(run)
    params = world.params(run.variables, world.starts(observed, batch, skip=1), horizon=6)

    settings = actor_critic.ActorCriticConfig(starts=64, horizon=6)
    learner = actor_critic.init(jax.random.key(1), world, settings)
    for update in range(int(updates)):
        learner, metrics = actor_critic.update(world, settings, params, jax.random.key(2 + update), learner)
        print(f"update {update + 1}: imagined return {metrics['return']:.2f}, reward of a step {metrics['reward']:.3f}")

    written = policy_file.save(out or run.folder / "example_agent", run, settings, learner.actor, {"updates": updates})
    print(f"wrote {written}")


if __name__ == "__main__":
    main(*sys.argv[1:])
