"""python -m muvo_jax.plan_drive RUN: a trained world model drives in the built-in town, by planning in imagination."""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import rich.table
import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax import evaluation_report, types
    from muvo_jax import run as run_lib
    from muvo_jax.agents import closed_loop, environment, planners, rewards, sensitivity
    from muvo_jax.data import prepare, words
    from muvo_jax.metrics import baselines, protocol, warp
    from muvo_jax.model import rollout
    from muvo_jax.town import record, settings, simulator
    from muvo_jax.training import checkpoint_meta, screen
    from muvo_jax.viz import canvas, sheets

FIRST_SEED = 5_000  # no recorded drive has these seeds
COASTING = (0.0, 0.0)
EXPERT, PLANNED = "expert", "planner"
COLUMNS = {"success": ("success", "{:.0%}"), "collisions": ("collisions", "{}"), "lost": ("off route", "{}"),
           "route_share": ("route share", "{:.1%}"), "progress_m": ("metres", "{:.1f}"),
           "progress": ("of expert's metres", "{:.0%}")}


@dataclasses.dataclass(frozen=True)
class Options:
    """Drives in the built-in town closed loop: filter the sensors, plan in imagination, apply the first action, again.

    The expert drives while the model observes its first frames; then the planner takes over. The expert, coasting and
    random actions drive the same seeds. Also measures how far imagination answers to actions as the town does. Prints
    tables, writes plan_drive.json, plan_drive.md and plan_drive.gif (the first planned drive).
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""
    episodes: int = 5
    """Drives of each driver, each with a seed of its own."""
    seconds: float = 20.0
    """How long to drive after the takeover."""
    planner: Literal["icem", "cem", "mppi", "gradient"] = "icem"
    """How to search: improved or plain cross-entropy method, path integrals, gradient ascent."""
    horizon: int = 10
    """Steps to plan ahead."""
    plans: int = 64
    """Candidate plans of an iteration (icem, cem, mppi)."""
    iterations: int = 3
    """Refinements of a plan."""
    futures: Literal["one", "each"] = "one"
    """Imagine one future for all plans of an iteration, or one for each plan: plans times the work."""
    speed_limit_mps: float = 8.0
    """What the reward calls too fast; drivers of the town like 8 to 10 m/s."""
    occupancy_scale: Literal[1, 2, 4] = 1
    """Look for collisions in the occupancy at 1, 1/2 or 1/4 of its resolution: coarser is faster and more cautious, and
    too coarse is refused."""
    seed: int = 0
    """Of the drives and of the planner."""
    out: Annotated[pathlib.Path | None, command_line.shown("PATH", "RUN/plan_drive")] = None
    """Where to write."""


EXAMPLES = """
python -m muvo_jax.plan_drive runs/town-tr
python -m muvo_jax.plan_drive runs/town-tr --planner=mppi --horizon=15
python -m muvo_jax.plan_drive runs/town-tr --episodes=2 --seconds=8 --seed=1
"""


def plan_drive(options: Options, show: screen.Screen) -> dict[str, Any]:
    """Does what the command line asks for; returns what plan_drive.json holds."""
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    config = loaded.config
    if options.episodes < 1 or options.seconds <= 0:
        raise ValueError(f"--episodes is {options.episodes} and --seconds {options.seconds}; both must be positive.")
    town = simulator.Town(settings.from_config(config))
    world = town_simulator(town, config)
    imagination = environment.Environment.of_run(loaded, reward_config=rewards.RewardConfig(
        occupancy_scale=options.occupancy_scale, speed_limit_mps=options.speed_limit_mps,
        collision=rewards.RewardConfig.collision if "occupancy" in config.model.heads else 0.0))
    planner = closed_loop.planning_driver(world, imagination, loaded.variables, *planner_of(options),
                                          horizon=options.horizon, shared_future=options.futures == "one")
    drivers = {PLANNED: planner, EXPERT: closed_loop.expert_driver(world),
               "constant": closed_loop.constant_driver(COASTING), "random": closed_loop.random_driver()}
    steps, context = max(1, round(options.seconds / world.step_s)), config.data.context
    seeds = [FIRST_SEED + 100 * options.seed + episode for episode in range(options.episodes)]
    drives: dict[str, list[closed_loop.Drive]] = {name: [] for name in drivers}
    began_s = time.perf_counter()
    for name, driver in drivers.items():
        for seed in seeds:
            key = jax.random.fold_in(jax.random.key(options.seed), seed)
            drives[name].append(closed_loop.drive(world, driver, key, seed, steps, context=context))
        show.line(f"{name}: {words.counted(len(seeds), 'drive')}, {time.perf_counter() - began_s:.0f} s so far",
                  style="dim")
    scores = closed_loop.summarise(drives, EXPERT, town.config.route_m)
    answers = sensitivity.measure(world, lambda state: town_truth(town, state), loaded.model, loaded.variables,
                                  jax.random.key(options.seed), seeds, horizons=contrast_horizons(config),
                                  context=context, moved=functools.partial(moved_views, town, config))
    show.line(f"sensitivity to actions, {time.perf_counter() - began_s:.0f} s so far", style="dim")
    report = {"run": str(loaded.folder), "step": loaded.step, "planner": options.planner, "horizon": options.horizon,
              "plans": options.plans, "iterations": options.iterations, "occupancy_scale": options.occupancy_scale,
              "futures": options.futures, "speed_limit_mps": options.speed_limit_mps,
              "step_s": world.step_s, "seconds": options.seconds, "seeds": seeds, "route_m": town.config.route_m,
              "scores": scores, "sensitivity": answers,
              "drives": {name: [describe(one, seed) for one, seed in zip(runs, seeds, strict=True)]
                         for name, runs in drives.items()},
              "packages": checkpoint_meta.package_versions()}
    show.console.print(screen_table(scores, options))
    for line in sensitivity_rows(answers):
        show.line(line)
    folder = options.out or loaded.folder / "plan_drive"
    folder.mkdir(parents=True, exist_ok=True)
    numbers, page = folder / "plan_drive.json", folder / "plan_drive.md"
    numbers.write_text(json.dumps(evaluation_report.json_ready(report), indent=1) + "\n", encoding="utf-8")
    page.write_text(markdown(report), encoding="utf-8")
    pictures = film(loaded, town, drives[PLANNED][0], options)
    for path in (numbers, page, canvas.save_gif(folder / "plan_drive.gif", pictures, world.step_s)):
        show.line(f"wrote {path}")
    return report


def planner_of(options: Options) -> tuple[str, planners.PlannerConfig]:
    """The planner's name in planners.PLANNERS and its settings; iCEM is CEM with kept elites and coloured noise."""
    elites = max(1, min(8, options.plans // 4))
    improved = {"kept": min(3, elites)} if options.planner == "icem" else {"kept": 0, "noise_exponent": 0.0}
    settings_ = planners.PlannerConfig(plans=options.plans, iterations=options.iterations, elites=elites, **improved)
    return "cem" if options.planner == "icem" else options.planner, settings_


def town_simulator(town: simulator.Town, config: config_lib.Config) -> closed_loop.Simulator:
    """The town at the model's rate: an action is held for data.stride periods. As in recordings, the expert first
    settles in."""
    def reset(seed):
        state = town.reset(seed)
        for _ in range(record.WARM_UP_FRAMES):
            state = town.step(state, town.expert(state))
        return state

    def step(state, action):
        for _ in range(config.data.stride):
            if state.collided:  # whatever comes later in the step, it stays collided
                break
            state = town.step(state, action)
        return state

    def situation(state):
        collided, over = bool(state.collided), town.is_terminal(state)
        arrived = over and int(state.progress) >= len(state.route_m) - simulator.ROUTE_END_POINTS
        return closed_loop.Situation(float(state.progress) * simulator.ROUTE_STEP_M, collided,
                                     over and not collided and not arrived, arrived and not collided)

    return closed_loop.Simulator(reset, step, lambda state: observation(town, state, config), situation,
                                 town.expert, config.data.stride / config.contract.rate_hz)


def observation(town: simulator.Town, state: simulator.TownState, config: config_lib.Config) -> dict[str, Any]:
    """What the model reads of a moment in the town, and what rewards need: fields of types.Batch without B and T."""
    seen = town.render(state)
    fields = {"image": seen["image"], "range_view": seen["range_view"], "route_map": seen["route_map"],
              "speed_mps": np.float32(seen["speed_mps"])}
    lidar, camera, guess = config.model.lidar, config.model.camera, config.model.first_guess
    if isinstance(lidar, config_lib.PillarLidar):
        fields["points"], fields["point_count"] = prepare.padded_points(seen["points_m"], lidar.grid.points, 0)
    if isinstance(camera, config_lib.BirdsEyeCamera) or isinstance(guess, config_lib.LastSeen):
        fields |= {"intrinsics": town.renderer.intrinsics, "camera_to_ego": town.renderer.camera_to_ego}
    return fields


def town_truth(town: simulator.Town, state: simulator.TownState) -> dict[str, np.ndarray]:
    """What the sensors show, the occupancy, and of the motion the speed, in the units of types.Batch."""
    seen = town.render(state)
    return {"image": seen["image"], "range_view": seen["range_view"], "occupancy": town.occupancy(seen),
            "ego_motion": np.array([0.0, 0.0, 0.0, seen["speed_mps"]], np.float32)}


def contrast_horizons(config: config_lib.Config) -> tuple[int, int]:
    """As many steps as training imagines (where it imagines none, as evaluation does), and twice as many."""
    data, observed = config.data, config.train.observe_frames
    steps = data.frames - observed if 0 < observed < data.frames else data.horizon
    return steps, 2 * steps


def moved_views(town: simulator.Town, config: config_lib.Config, states: Sequence[simulator.TownState],
                action: Sequence[float], steps: int) -> dict[str, np.ndarray]:
    """What geometry alone says of the sensors under an action, from each state on: see sensitivity.measure.

    A pixel of the range view to which no return was moved keeps its range: it answers to no action.
    """
    count, truths = len(states), [town_truth(town, state) for state in states]
    now = lambda head: np.stack([truth[head] for truth in truths])[:, None]
    calibration = {name: np.stack([getattr(town.renderer, name)] * count) for name in ("intrinsics", "camera_to_ego")}
    held = np.broadcast_to(np.asarray(action, np.float32), (count, 1 + steps, 2))
    batch = types.Batch(action=held, is_first=np.zeros(held.shape[:2], bool), speed_mps=now("ego_motion")[..., 3],
                        **{head: now(head) for head in baselines.SENSORS}, **calibration)
    frames = warp.warp(batch, 1, steps, config)
    range_m = frames["range_view"][..., 3]
    return {"image": frames["image"], "range_view": np.where(range_m > 0.0, range_m, now("range_view")[..., 3]),
            "occupancy": frames["occupancy"].astype(np.float32)}


def film(loaded: run_lib.Run, town: simulator.Town, drive: closed_loop.Drive,
         options: Options) -> list[np.ndarray]:
    """Frames of a planned drive: the town, what the model makes of it, what it expects at the end of its plan."""
    model, variables, key = loaded.model, loaded.variables, jax.random.key(options.seed)
    heads = tuple(head for head in baselines.SENSORS if head in model.config.heads)
    states, memory, plans = closed_loop.latents(drive.moments)
    dreamt = rollout.imagine(model, variables, key, states, plans, sampled=False)
    views = []
    for latent in (states, jax.tree.map(lambda leaf: leaf[:, -1], dreamt.states)):
        decoded = rollout.decode(model, variables, latent, heads, memory=memory)
        frames = jax.device_get(protocol.finish(decoded, model.config))
        views.append(sheets.views_of_frames({head: value[None] for head, value in frames.items()}, 0))
    scene = sheets.Scene.of(loaded.config)
    pictures = []
    for index, moment in enumerate(drive.moments):
        seen = town.render(moment.state)
        truth = sheets.View(image=seen["image"], range_view=seen["range_view"], occupancy=town.occupancy(seen))
        columns = [("town", truth), ("world model, now", views[0][index]),
                   (f"imagined under the plan, in {options.horizon * scene.frame_s:.1f} s", views[1][index])]
        caption = (f"{index * scene.frame_s:4.1f} s   {3.6 * float(moment.state.speed_mps):3.0f} km/h   "
                   f"expected return {float(moment.memory.value):+.2f}")
        pictures.append(sheets.dream_frame(columns, scene, badge="observed", caption=caption, action=moment.action))
    return pictures


def describe(drive: closed_loop.Drive, seed: int) -> dict[str, Any]:
    """One drive for the report."""
    end = drive.end
    return {"seed": seed, "progress_m": drive.progress_m, "steps": drive.steps, "collided": end.collided,
            "lost": end.lost, "arrived": end.arrived}


def rows(scores) -> list[list[str]]:
    return [[name, *(form.format(score[column]) for column, (_, form) in COLUMNS.items())]
            for name, score in scores.items()]


def screen_table(scores, options: Options) -> rich.table.Table:
    """A row for each driver."""
    drives = words.counted(options.episodes, "drive")
    table = rich.table.Table(title=f"{drives} of {options.seconds:g} s, {options.planner}", title_justify="left")
    for name in ("driver", *(label for label, _ in COLUMNS.values())):
        table.add_column(name, justify="left" if name == "driver" else "right")
    for row in rows(scores):
        table.add_row(*row)
    return table


def sensitivity_rows(answers) -> list[str]:
    """The sensitivity to actions as a Markdown table."""
    return ["| response to | steps | of | source | gain (1 is right, 0 ignores actions) | correlation |",
            "|---|---:|---|---|---:|---:|",
            *(f"| {contrast} | {steps} | {head} | {evaluation_report.SOURCES[source]} | {score['gain']:.2f} | "
              f"{score['correlation']:.2f} |" for steps, contrasts in answers.items()
              for contrast, heads in contrasts.items() for head, sources in heads.items()
              for source, score in sources.items())]


def markdown(report) -> str:
    """The report as a page."""
    lines = [f"# {pathlib.Path(report['run']).name}: driving by imagination", "",
             f"Step {report['step']}; {report['planner']}, {report['horizon']} steps of {report['step_s']:g} s, "
             f"{report['plans']} plans, {report['iterations']} iterations. "
             f"{words.counted(len(report['seeds']), 'drive')} of {report['seconds']:g} s with the seeds "
             f"{', '.join(map(str, report['seeds']))}.", "",
             "| driver | " + " | ".join(label for label, _ in COLUMNS.values()) + " |",
             "|---|" + "---:|" * len(COLUMNS)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(report["scores"])]
    lines += ["", f"Success: driven to the end of the time without a collision and without leaving the route. Metres "
                  f"count along the route until then; its whole length is {report['route_m']:g} m.", "",
              "Does imagination answer to actions? From each takeover on, the same noise under two plans: the "
              "difference that the model predicts between them, regressed on the town's. Warp-last moves what was last "
              "seen by what the plan does to the car, and has learned nothing.", "",
              *sensitivity_rows(report["sensitivity"]), ""]
    return "\n".join(lines)


def main() -> int:
    return command_line.run(Options, plan_drive, program="plan_drive", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
