"""python -m muvo_jax.train_agent RUN: an agent learns to drive in the imagination of a trained run."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import sys
import time
from typing import Annotated, Any

import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax
    import numpy as np

    from muvo_jax import evaluation_report, town_drive
    from muvo_jax import run as run_lib
    from muvo_jax.agents import (
        actor_critic,
        closed_loop,
        environment,
        policy_file,
        real_rewards,
        rewards,
        uncertainty,
    )
    from muvo_jax.agents import futures as futures_lib
    from muvo_jax.data import words
    from muvo_jax.model import rollout
    from muvo_jax.town import settings, simulator
    from muvo_jax.training import checkpoint_meta, screen, validation
    from muvo_jax.viz import curves

TUNING_SEED = 4_000  # of the drives that are judged on the way: neither recorded nor, from 5,000 on, those of drive
OBSERVED_AT_ONCE = 64  # windows
POOL_ROUNDS = 6  # so many rounds' futures are driven again
HORIZON = 12  # steps of a future: as far as the memory foresees what moves


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains a driving agent in imagination alone: no step of a simulator, nothing but a run and its recording.

    Each round the agent drives in imagination from recorded moments, and what the model decodes on the way is kept;
    then it learns in these futures (agents/futures.py, agents/actor_critic.py). Every so often it drives in the
    built-in town, to be judged, not to learn. Writes actor.safetensors, agent.json and learning_curves.png; the agent
    is saved after each round, so it may be interrupted. Then: python -m muvo_jax.drive RUN --agent=learned,expert
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    rounds: int = 13
    """Rounds of imagining and learning."""
    updates: int = 60
    """Updates of the agent in each round."""
    minutes: float = 30.0
    """Stop after the round in which so many minutes have passed."""
    starts: int = 384
    """Recorded moments from which imagined drives start."""
    futures: int = 64
    """Drives imagined in each round."""
    batch: int = 128
    """Drives that one update learns from."""
    learning_rate: float = 1e-3
    """Of the agent's optimiser."""
    speed_limit_mps: float = 8.0
    """What the reward calls too fast; drivers of the town like 8 to 10 m/s."""
    trust: tuple[float, ...] = ()
    """What a reward of imagined step 1, 2, ... counts, such as the trust of evaluate --uncertainty; later ones count as
    the last. By default all count in full."""
    branches: int = 1
    """Futures drawn of each step; obstacles are where the worst of them has one. So many times the decoding."""
    judge_every: int = 5
    """Judge in the town after each so many rounds; 0: never."""
    judge_drives: int = 4
    """Drives of 10 s that judge it."""
    seed: int = 0
    """Of everything random."""
    out: Annotated[pathlib.Path | None, command_line.shown("PATH", "RUN/agent")] = None
    """Where to write."""


EXAMPLES = """
python -m muvo_jax.train_agent runs/town-tr
python -m muvo_jax.train_agent runs/town-tr --rounds=8 --judge-every=0
python -m muvo_jax.drive runs/town-tr --agent=learned,expert,constant,random
"""


def train_agent(options: Options, show: screen.Screen) -> dict[str, Any]:
    """Does what the command line asks for; returns what agent.json says of the training."""
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    for name in ("rounds", "updates", "starts", "futures", "batch", "judge_drives"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {getattr(options, name)}; it must be at least 1.")
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    world = environment.Environment.of_run(loaded, observation="road", reward_config=rewards.RewardConfig(
        speed_limit_mps=options.speed_limit_mps), caution=uncertainty.Caution(options.trust, options.branches))
    futures_lib.check(world)
    config = actor_critic.ActorCriticConfig(starts=options.batch, horizon=HORIZON, discount=0.97, clip_norm=1.0,
                                            learning_rate=options.learning_rate)
    show.line(f"observing {words.counted(options.starts, 'recorded window')}", style="dim")
    params = recorded_params(world, loaded, options.starts)
    judge = town_judge(world, loaded, options) if options.judge_every and loaded.config.data.path == "town" else None
    learner = actor_critic.init(jax.random.key(options.seed), world, config)
    history: list[dict[str, float]] = []
    folder = options.out or loaded.folder / policy_file.FOLDER
    pool: list[futures_lib.Futures] = []
    for index in range(options.rounds):
        key_imagine, key_learn = jax.random.split(jax.random.fold_in(jax.random.key(options.seed), index))
        pool = [*pool[1 - POOL_ROUNDS:], dreamt(world, params, config, learner, key_imagine, options)]
        learner, metrics = lessons(world, config, pool, key_learn, learner, options)
        row = {"round": index + 1, "updates": int(learner.step), "minutes": (time.perf_counter() - began_s) / 60,
               "processor_minutes": (time.process_time() - began_cpu_s) / 60, **imagined_scores(pool[-1]), **metrics}
        last = index + 1 == options.rounds or row["minutes"] >= options.minutes
        if judge is not None and ((index + 1) % options.judge_every == 0 or last):
            row |= judge(learner.actor, config)
        history.append(row)
        show.line(told(row))
        training = {"options": {name: value if isinstance(value, int | float | str) else str(value)
                                for name, value in dataclasses.asdict(options).items()},
                    "history": evaluation_report.json_ready(history), "packages": checkpoint_meta.package_versions()}
        policy_file.save(folder, loaded, config, learner.actor, training, observation="road")
        draw(folder / "learning_curves.png", history)
        if last:
            break
    show.line(f"wrote {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    return training


def recorded_params(world: environment.Environment, loaded: run_lib.Run, count: int) -> environment.EnvParams:
    """The environment's params on `count` recorded moments, each the last of its context; means, not samples."""
    batch = validation.windows_of_run(loaded, "train", count=count, frames=loaded.config.data.context)
    observed = []
    for first in range(0, count, OBSERVED_AT_ONCE):
        part = jax.tree.map(lambda leaf, first=first: leaf[first:first + OBSERVED_AT_ONCE], batch)
        observed.append(rollout.observe(loaded.model, loaded.variables, jax.random.key(0), part, sampled=False))
    together = jax.tree.map(lambda *leaves: jax.numpy.concatenate(leaves), *observed)
    return world.params(loaded.variables, world.starts(together, batch, skip=batch.frames - 1), horizon=1,
                        temperature=0.0)


def dreamt(world, params, config, learner, key, options) -> futures_lib.Futures:
    """A round's futures, under the actor's sampled actions; of distinct starts where there are as many."""
    key_starts, key_drive = jax.random.split(key)
    size = params.bank.size
    starts = jax.random.choice(key_starts, size, (options.futures,), replace=options.futures > size)
    return futures_lib.imagine(world, params, key_drive, starts, actor_critic.policy(config, learner.actor),
                               config.horizon)


def lessons(world, config, pool, key, learner, options):
    """A round's updates: the learner after them, and the mean of their metrics over the last ten."""
    together = jax.tree.map(lambda *leaves: jax.numpy.concatenate(leaves), *pool)
    seen = []
    for update in range(options.updates):
        key_choice, key_update = jax.random.split(jax.random.fold_in(key, update))
        chosen = together[jax.random.randint(key_choice, (options.batch,), 0, together.count)]
        learner, metrics = actor_critic.improve(world, config, chosen, key_update, learner)
        seen.append(metrics)
    means = {name: float(np.mean([metrics[name] for metrics in seen[-10:]])) for name in seen[0]}
    wrong = [name for name, value in means.items() if not math.isfinite(value)]
    if wrong:
        raise ValueError(f"train_agent: after {int(learner.step)} updates {', '.join(wrong)} is no number; try a "
                         f"smaller --learning-rate than {options.learning_rate:g}.")
    return learner, means


def imagined_scores(futures: futures_lib.Futures) -> dict[str, float]:
    """What the drives that imagined earned, per step until they ended, and how many ended."""
    ended = np.asarray(futures.terminated)
    alive = np.concatenate([np.ones_like(ended[:, :1]), ~np.logical_or.accumulate(ended, axis=1)[:, :-1]], axis=1)
    mean = lambda values: float((np.asarray(values) * alive).sum() / alive.sum())
    return {"imagined_reward": mean(futures.reward), "imagined_progress_m": mean(futures.progress_m),
            "imagined_ends": float(ended.any(axis=1).mean())}


def town_judge(world: environment.Environment, loaded: run_lib.Run, options: Options):
    """(actor, config) -> scores of drives in the town: reward of a step, metres of a step, success."""
    town = simulator.Town(settings.from_config(loaded.config))
    driven = town_drive.town_simulator(town, loaded.config)
    steps, context = round(10.0 / driven.step_s), loaded.config.data.context

    def judge(actor, config):
        policy = actor_critic.policy(config, actor, sampled=False)
        driver = closed_loop.policy_driver(driven, world, loaded.variables, policy)
        drives = [closed_loop.drive(driven, driver, jax.random.key(seed), seed, steps, context=context)
                  for seed in range(TUNING_SEED, TUNING_SEED + options.judge_drives)]
        earned = [real_rewards.town_rewards(world, one) for one in drives]
        return {"town_reward": float(np.concatenate(earned).mean()),
                "town_progress_m": sum(one.progress_m for one in drives) / sum(one.steps for one in drives),
                "town_success": float(np.mean([one.unharmed for one in drives]))}

    return judge


def told(row: dict[str, float]) -> str:
    """A round on the screen."""
    town = (f"; in the town {row['town_reward']:.2f}, {row['town_progress_m']:.2f} m, success "
            f"{row['town_success']:.0%}") if "town_success" in row else ""
    return (f"round {row['round']:.0f}, {row['minutes']:.1f} min: a step of imagination earns "
            f"{row['imagined_reward']:.2f} ({row['imagined_progress_m']:.2f} m), {row['imagined_ends']:.0%} of drives "
            f"end early{town}")


def draw(path: pathlib.Path, history: list[dict[str, float]]) -> None:
    """Imagined and real reward, metres and ends over the updates, on one picture."""
    def series(names):
        known = {label: [(row["updates"], row[name]) for row in history if name in row]
                 for label, name in names.items()}
        return {label: tuple(zip(*points, strict=True)) for label, points in known.items() if points}

    plots = [curves.curve(series({"imagined": "imagined_reward", "town": "town_reward"}), "reward of a step"),
             curves.curve(series({"imagined": "imagined_progress_m", "town": "town_progress_m"}), "metres of a step"),
             curves.curve(series({"imagined, ended early": "imagined_ends", "town, success": "town_success"}),
                          "share of drives")]
    curves.write_curves(path, plots, "Learning in imagination, judged in the town; over updates")


def main() -> int:
    return command_line.run(Options, train_agent, program="train_agent", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
