"""The world that the scripts of this folder train in: a run, or fresh weights where none is named."""

import jax
import jax.numpy as jnp

import muvo_jax
from muvo_jax import drive, presets, town_drive, train_agent
from muvo_jax.agents import closed_loop, drive_scores, environment, futures, rewards
from muvo_jax.town import settings, simulator
from muvo_jax.training import checkpoint, screen


def load(run: str | None, horizon: int) -> tuple[environment.Environment, environment.EnvParams]:
    """Environment and params of a run; without one those of untrained weights and random starts.

    Untrained weights show that an agent runs through a door, not that it learns to drive: their reward leaves out the
    collision, so that no occupancy is decoded.
    """
    if run is None:
        config = presets.get("tiny")
        model = muvo_jax.WorldModel(config.model)
        fresh = muvo_jax.Run(model, model.init(jax.random.key(0)), config)
        world = muvo_jax.Environment.of_run(fresh, reward_config=rewards.RewardConfig(collision=0.0))
        latent = jax.tree.map(lambda leaf: 0.5 * jax.random.normal(jax.random.key(0), leaf.shape),
                              model.initial_state(64))
        bank = environment.StartBank(latent, jnp.linspace(0.0, 8.0, 64))
        return world, world.params(fresh.variables, bank, horizon)
    loaded = muvo_jax.load(run)
    batch = muvo_jax.windows(loaded, "train", count=16)
    observed = muvo_jax.observe(loaded.model, loaded.variables, jax.random.key(0), batch)
    world = muvo_jax.Environment.of_run(loaded)
    bank = world.starts(observed, batch, skip=loaded.config.data.context - 1)
    return world, world.params(loaded.variables, bank, horizon)


class Dreams:
    """A run as train_agent uses it: recorded moments from which policies imagine futures, in which agents then drive.

    Policies are jax.tree_util.Partial (key, observation "road") -> action.
    """

    def __init__(self, run: str, starts: int = 128):
        self.run = checkpoint.load_run(run, "latest")
        self.world = environment.Environment.of_run(self.run, observation="road", reward_config=rewards.RewardConfig(
            speed_limit_mps=train_agent.Options.speed_limit_mps))
        self.recorded = train_agent.recorded_params(self.world, self.run, starts)
        self.core = futures.SharedFutures(self.world)

    def futures(self, key, policy) -> futures.Futures:
        """One from each recorded moment, 16 at a time: each takes some ten MB of evidence."""
        starts = jnp.arange(self.recorded.bank.size).reshape(-1, 16)
        parts = [futures.imagine(self.world, self.recorded, jax.random.fold_in(key, index), part, policy,
                                 train_agent.HORIZON) for index, part in enumerate(starts)]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)

    def judge(self, policy, drives: int) -> str:
        """What a policy is worth in the town, by the loop, the seeds and the scores of muvo_jax.drive."""
        town = simulator.Town(settings.from_config(self.run.config))
        simulated = town_drive.town_simulator(town, self.run.config)
        drivers = {"policy": closed_loop.policy_driver(simulated, self.world, self.run.variables, policy),
                   "expert": closed_loop.expert_driver(simulated)}
        seeds = list(range(town_drive.FIRST_SEED, town_drive.FIRST_SEED + drives))
        driven = drive.drive_all(drive.Options(self.run.folder), self.run, simulated, drivers, seeds, screen.Screen())
        found = drive_scores.summarise(driven, route_m=town.config.route_m, step_s=simulated.step_s, expert="expert")
        score = found["policy"]
        low, high = score["success_interval"]
        return (f"{drives} drives in the town: success {score['success']:.0%} [{low:.0%}..{high:.0%}], "
                f"{score['collisions']} collisions, {score['lost']} off route, {score['progress_m']:.1f} m, "
                f"{score['progress']:.0%} of the expert's metres, {score['hard_share']:.1%} of steps above 3 m/s2")


def told(index: int, futures_: futures.Futures, steps: int) -> str:
    """A round's line: what a step of imagination earned under the policy that imagined these futures."""
    scores = train_agent.imagined_scores(futures_)
    return (f"round {index}, after {steps} steps: a step of imagination earns {scores['imagined_reward']:.3f}, "
            f"{scores['imagined_ends']:.0%} of drives end early")
