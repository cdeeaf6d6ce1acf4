"""python -m muvo_jax.drive RUN: planners, learned agents and baselines drive in the built-in town."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import pathlib
import sys
import time
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import drive_report, evaluation_report, town_drive
    from muvo_jax import run as run_lib
    from muvo_jax.agents import (
        closed_loop,
        drive_scores,
        environment,
        planners,
        policy_file,
        rewards,
        sensitivity,
        uncertainty,
    )
    from muvo_jax.data import words
    from muvo_jax.town import settings, simulator
    from muvo_jax.training import checkpoint_meta, screen
    from muvo_jax.viz import canvas

COASTING = (0.0, 0.0)
AGENTS = ("planner", "learned", "expert", "constant", "random")
EXPERT = "expert"


@dataclasses.dataclass(frozen=True)
class Options:
    """Drives in the built-in town closed loop: filter the sensors, act, again.

    The expert drives while the model observes its first frames; then each agent takes over, in drives of the same
    seeds. Agents: planner (searches in imagination at every step), learned (a policy that learned there), expert (the
    town's own driver), constant (coasts straight on), random. Also measures how far imagination answers to actions as
    the town does. Prints tables, writes drive.json, drive.md and drive.gif (the first drive of the first agent).
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    agent: str = "planner,expert,constant,random"
    """Who drives: one or several of planner, learned, expert, constant, random, separated by commas."""
    policy: Annotated[pathlib.Path | None, command_line.shown("PATH", "RUN/agent")] = None
    """The folder of the learned agent."""
    episodes: int = 16
    """Drives of each agent, each with a seed of its own."""
    seconds: float = 10.0
    """How long to drive after the takeover."""
    planner: Literal["icem", "cem", "mppi", "gradient"] = "icem"
    """How to search: improved or plain cross-entropy method, path integrals, gradient ascent."""
    horizon: int = 10
    """Steps to plan ahead."""
    plans: int = 64
    """Candidate plans of an iteration; gradient ascends from an eighth as many."""
    iterations: int = 3
    """Refinements of a plan."""
    futures: Literal["one", "each"] = "one"
    """Imagine one future for all plans of an iteration, or one for each plan: plans times the work."""
    speed_limit_mps: float = 8.0
    """What the planner's reward calls too fast; drivers of the town like 8 to 10 m/s."""
    occupancy_scale: Literal[1, 2, 4] = 1
    """Look for collisions in the occupancy at 1, 1/2 or 1/4 of its resolution: coarser is faster and more cautious, and
    too coarse is refused."""
    trust: tuple[float, ...] = ()
    """What a reward of imagined step 1, 2, ... counts, such as the trust of evaluate --uncertainty; later ones count as
    the last. By default all count in full."""
    branches: int = 1
    """Futures drawn of each step; obstacles are where the worst of them has one. So many times the decoding."""
    sensitivity: bool = True
    """Measure how imagination answers to actions."""
    seed: int = 0
    """Of the drives and of the planner."""
    out: Annotated[pathlib.Path | None, command_line.shown("PATH", "RUN/drive")] = None
    """Where to write."""


EXAMPLES = """
python -m muvo_jax.drive runs/town-tr
python -m muvo_jax.drive runs/town-tr --agent=learned,planner,expert --policy=runs/town-tr/agent
python -m muvo_jax.drive runs/town-tr --agent=planner --planner=mppi --horizon=15 --no-sensitivity
python -m muvo_jax.drive runs/town-tr --episodes=2 --seconds=8 --seed=1
"""


def drive(options: Options, show: screen.Screen) -> dict[str, Any]:
    """Does what the command line asks for; returns what drive.json holds."""
    names = agents_of(options.agent)
    if min(options.episodes, options.horizon) < 1 or not 0 < options.seconds < math.inf:
        raise ValueError(f"--episodes is {options.episodes}, --horizon {options.horizon} and --seconds "
                         f"{options.seconds}; all must be positive and finite.")
    if options.policy is not None and "learned" not in names:
        raise ValueError(f"--policy={options.policy} is for an agent that learned, and --agent={options.agent} names "
                         f"none: add it, as in --agent=learned,{options.agent}.")
    if not 0 <= options.seed < 10**6:
        raise ValueError(f"--seed is {options.seed}; it must be at least 0 and below a million.")
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    folder = options.out or loaded.folder / "drive"
    folder.mkdir(parents=True, exist_ok=True)  # now, not after all drives
    policy = None
    if "learned" in names:
        policy = policy_file.load(options.policy or loaded.folder / policy_file.FOLDER, loaded)
    town = simulator.Town(settings.from_config(loaded.config))
    world = town_drive.town_simulator(town, loaded.config)
    drivers = {name: driver_of(name, options, loaded, world, policy, show) for name in names}
    seeds = [town_drive.FIRST_SEED + 100 * options.seed + episode for episode in range(options.episodes)]
    began_s = time.perf_counter()
    drives = drive_all(options, loaded, world, drivers, seeds, show)
    scores = drive_scores.summarise(drives, route_m=town.config.route_m, step_s=world.step_s,
                                    expert=EXPERT if EXPERT in names else None)
    report = {"run": str(loaded.folder), "step": loaded.step, "agents": names, "planner": options.planner,
              "horizon": options.horizon, "plans": options.plans, "iterations": options.iterations,
              "occupancy_scale": options.occupancy_scale, "futures": options.futures,
              "trust": options.trust, "branches": options.branches,
              "speed_limit_mps": options.speed_limit_mps, "step_s": world.step_s, "seconds": options.seconds,
              "seeds": seeds, "route_m": town.config.route_m, "scores": scores,
              "drives": {name: [drive_report.describe(one, seed) for one, seed in zip(runs, seeds, strict=True)]
                         for name, runs in drives.items()},
              "packages": checkpoint_meta.package_versions()}
    if options.sensitivity:
        report["sensitivity"] = sensitivity.measure(
            world, lambda state: town_drive.town_truth(town, state), loaded.model, loaded.variables,
            jax.random.key(options.seed), seeds, horizons=town_drive.contrast_horizons(loaded.config),
            context=loaded.config.data.context, moved=functools.partial(town_drive.moved_views, town, loaded.config))
        show.line(f"sensitivity to actions, {time.perf_counter() - began_s:.0f} s so far", style="dim")
    show.console.print(drive_report.screen_table(report))
    for line in drive_report.sensitivity_rows(report):
        show.line(line)
    numbers, page = folder / "drive.json", folder / "drive.md"
    numbers.write_text(json.dumps(evaluation_report.json_ready(report), indent=1) + "\n", encoding="utf-8")
    page.write_text(drive_report.markdown(report), encoding="utf-8")
    pictures = drive_report.film(loaded, town, drives[names[0]][0], jax.random.key(options.seed),
                                 policy if names[0] == "learned" else None, options.horizon)
    for path in (numbers, page, canvas.save_gif(folder / "drive.gif", pictures, world.step_s)):
        show.line(f"wrote {path}")
    return report


def agents_of(text: str) -> tuple[str, ...]:
    """The agents that --agent names, in its order.

    Raises:
      ValueError: for one that does not exist or comes twice, or none at all.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    unknown = [name for name in names if name not in AGENTS]
    if not names or unknown or len(set(names)) < len(names):
        raise ValueError(f"--agent={text}: expected one or several of {', '.join(AGENTS)}, each once, separated by "
                         f"commas" + (f"; {', '.join(unknown)} is none of them." if unknown else "."))
    return names


def driver_of(name: str, options: Options, loaded: run_lib.Run, world: closed_loop.Simulator,
              policy: policy_file.StoredPolicy | None, show: screen.Screen) -> closed_loop.Driver:
    """Who drives under this name; `policy` is that of the learned agent.

    Raises:
      ValueError: for planner settings that make no sense.
    """
    if name == "planner":
        return _planner(options, loaded, world, show)
    if policy is not None and name == "learned":
        return closed_loop.policy_driver(world, policy.environment(loaded), loaded.variables, policy.policy())
    return {EXPERT: closed_loop.expert_driver(world), "constant": closed_loop.constant_driver(COASTING),
            "random": closed_loop.random_driver()}[name]


def _planner(options, loaded, world, show):
    sees = "occupancy" in loaded.model.config.heads
    if not sees:
        show.warn("this run has no head occupancy: the planner sees no obstacles and drives into them (train with "
                  "--with-heads=occupancy).")
    if options.horizon > loaded.config.imagined_steps:
        show.line(f"planning {options.horizon} steps ahead; training imagined {loaded.config.imagined_steps}",
                  style="dim")
    imagination = environment.Environment.of_run(loaded, reward_config=rewards.RewardConfig(
        occupancy_scale=options.occupancy_scale, speed_limit_mps=options.speed_limit_mps,
        collision=rewards.RewardConfig.collision if sees else 0.0),
        caution=uncertainty.Caution(options.trust, options.branches))
    return closed_loop.planning_driver(world, imagination, loaded.variables, *planner_of(options),
                                       horizon=options.horizon, shared_future=options.futures == "one")


def planner_of(options: Options) -> tuple[str, planners.PlannerConfig]:
    """The planner's name in planners.PLANNERS and its settings; iCEM is CEM with kept elites and coloured noise."""
    elites = max(1, min(8, options.plans // 4))
    own = {"icem": {"kept": min(3, elites)}, "gradient": {"kept": 0, "starts": max(1, options.plans // 8)}}
    settings_ = planners.PlannerConfig(plans=options.plans, iterations=options.iterations, elites=elites,
                                       **own.get(options.planner, {"kept": 0, "noise_exponent": 0.0}))
    return "cem" if options.planner == "icem" else options.planner, settings_


def drive_all(options: Options, loaded: run_lib.Run, world: closed_loop.Simulator,
              drivers: Mapping[str, closed_loop.Driver], seeds: list[int],
              show: screen.Screen) -> dict[str, list[closed_loop.Drive]]:
    """The drives of each driver; of all but the first one the moments, whose memories are large, are dropped."""
    steps, drives = max(1, round(options.seconds / world.step_s)), dict[str, list[closed_loop.Drive]]()
    began_s = time.perf_counter()
    for name, driver in drivers.items():
        drives[name] = []
        for seed in seeds:
            key = jax.random.fold_in(jax.random.key(options.seed), seed)
            done = closed_loop.drive(world, driver, key, seed, steps, context=loaded.config.data.context)
            filmed = len(drives) == 1 and seed == seeds[0]
            drives[name].append(done if filmed else dataclasses.replace(done, moments=()))
        show.line(f"{name}: {words.counted(len(seeds), 'drive')}, {time.perf_counter() - began_s:.0f} s so far",
                  style="dim")
    return drives


def main() -> int:
    return command_line.run(Options, drive, program="drive", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
