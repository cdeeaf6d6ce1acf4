"""What drive reports: tables for the screen, the page drive.md, and the film of a drive."""

from __future__ import annotations

import math
import pathlib
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rich.table

from muvo_jax import evaluation_report
from muvo_jax import run as run_lib
from muvo_jax.agents import closed_loop, drive_scores, environment, policy_file
from muvo_jax.data import words
from muvo_jax.metrics import baselines, protocol
from muvo_jax.model import rollout
from muvo_jax.town import simulator
from muvo_jax.viz import sheets

# score -> (label, how a number is written); those with an interval have it behind them.
COLUMNS = {"success": ("success", "{:.0%}"), "collisions": ("collisions", "{}"), "lost": ("off route", "{}"),
           "progress_m": ("metres", "{:.1f}"), "progress": ("of expert's metres", "{:.0%}"),
           "acceleration_mps2": ("along, m/s2", "{:.2f}"), "lateral_mps2": ("across, m/s2", "{:.2f}"),
           "hard_share": (f"steps above {drive_scores.HARD_MPS2:g} m/s2", "{:.1%}")}
ON_SCREEN = ("success", "progress_m")  # with their intervals; the page has all


def describe(drive: closed_loop.Drive, seed: int) -> dict[str, Any]:
    """One drive for the report."""
    end = drive.end
    return {"seed": seed, "progress_m": drive.progress_m, "steps": drive.steps, "collided": end.collided,
            "lost": end.lost, "arrived": end.arrived}


def table(scores: Mapping[str, Mapping[str, Any]], with_interval: tuple[str, ...]) -> list[list[str]]:
    """The header, then a row for each driver; columns that no driver has are left out."""
    columns = {score: label for score, label in COLUMNS.items() if any(score in found for found in scores.values())}
    header = ["driver", *(label for label, _ in columns.values())]
    return [header, *([name, *(_cell(found, score, form, score in with_interval)
                               for score, (_, form) in columns.items())] for name, found in scores.items())]


def _cell(found, score, form, with_interval):
    text = form.format(found[score])
    low, high = (form.format(end).rstrip("%") for end in found.get(f"{score}_interval", (math.nan, math.nan)))
    return text if not with_interval or low == "nan" else f"{text} [{low}..{high}]"


def screen_table(report: Mapping[str, Any]) -> rich.table.Table:
    """A row for each driver."""
    drives = words.counted(len(report["seeds"]), "drive")
    shown = rich.table.Table(title=f"{drives} of {report['seconds']:g} s", title_justify="left")
    header, *rows = table(report["scores"], ON_SCREEN)
    for index, name in enumerate(header):  # headers wrap, numbers do not
        shown.add_column(name, justify="right" if index else "left", min_width=max(len(row[index]) for row in rows))
    for row in rows:
        shown.add_row(*row)
    return shown


def sensitivity_rows(report: Mapping[str, Any]) -> list[str]:
    """The sensitivity to actions as a Markdown table; nothing where it was not measured, or of no head."""
    rows = [f"| {contrast} | {steps} | {head} | {evaluation_report.SOURCES[source]} | {score['gain']:.2f} | "
            f"{score['correlation']:.2f} |" for steps, contrasts in report.get("sensitivity", {}).items()
            for contrast, heads in contrasts.items() for head, sources in heads.items()
            for source, score in sources.items()]
    header = ["| response to | steps | of | source | gain (1 is right, 0 ignores actions) | correlation |",
              "|---|---:|---|---|---:|---:|"]
    return header + rows if rows else []


def markdown(report: Mapping[str, Any]) -> str:
    """The report as a page."""
    planner = (f"{report['planner']}, {report['horizon']} steps of {report['step_s']:g} s, {report['plans']} plans, "
               f"{report['iterations']} iterations. ") if "planner" in report["agents"] else ""
    header, *rows = table(report["scores"], tuple(COLUMNS))
    lines = [f"# {pathlib.Path(report['run']).name}: driving in the town", "",
             f"Step {report['step']}. {'Planner: ' if planner else ''}{planner}"
             f"{words.counted(len(report['seeds']), 'drive')} of {report['seconds']:g} s with the seeds "
             f"{', '.join(map(str, report['seeds']))}.", "",
             "| " + " | ".join(header) + " |", "|---|" + "---:|" * (len(header) - 1),
             *("| " + " | ".join(row) + " |" for row in rows), "",
             f"Success: driven to the end of the time without a collision and without leaving the route. Metres count "
             f"along the route until then; its whole length is {report['route_m']:g} m. Along and across: root mean "
             f"squares of the accelerations, per step of {report['step_s']:g} s. In brackets 95 % intervals over the "
             f"drives: Wilson's of success, bootstrap of the others.", ""]
    if answers := sensitivity_rows(report):
        lines += ["Does imagination answer to actions? From each takeover on, the same noise under two plans: the "
                  "difference that the model predicts between them, regressed on the town's. Warp-last moves what was "
                  "last seen by what the plan does to the car, and has learned nothing.", "",
                  *answers, ""]
    return "\n".join(lines)


def film(loaded: run_lib.Run, town: simulator.Town, drive: closed_loop.Drive, key: jax.Array,
         policy: policy_file.StoredPolicy | None, horizon: int) -> list[np.ndarray]:
    """Frames of a drive: the town; of a driver with a model also what it makes of that, and what it expects to come.

    Args:
      loaded: the run.
      town: where it drove.
      drive: with its moments.
      key: of the policy.
      policy: a learned agent, which drives on in imagination for `horizon` steps; a planner has its plans.
      horizon: see policy.
    """
    scene, pictures = sheets.Scene.of(loaded.config), []
    views = _imagined(loaded, drive, key, policy, horizon, scene) if drive.moments[0].memory is not None else {}
    for index, moment in enumerate(drive.moments):
        seen = town.render(moment.state)
        truth: sheets.View = {"image": seen["image"], "range_view": seen["range_view"],
                              "occupancy": town.occupancy(seen)}
        columns = [("town", truth), *((title, frames[index]) for title, frames in views.items())]
        caption = f"{index * scene.frame_s:4.1f} s   {3.6 * float(moment.state.speed_mps):3.0f} km/h"
        if isinstance(moment.memory, closed_loop.PlanMemory):
            caption += f"   expected return {float(moment.memory.value):+.2f}"
        pictures.append(sheets.dream_frame(columns, scene, badge="observed", caption=caption, action=moment.action))
    return pictures


def _imagined(loaded, drive, key, policy, horizon, scene) -> dict[str, list[sheets.View]]:
    """Title -> a view of each moment: what the model makes of it now, and at the end of what is planned; nothing where
    no head of the model predicts what the town shows."""
    model, variables = loaded.model, loaded.variables
    heads = tuple(head for head in baselines.SENSORS if head in model.config.heads)
    if not heads:
        return {}
    states, memory = closed_loop.latents(drive.moments)
    if policy is None:
        plans = closed_loop.plans(drive.moments)
        dreamt = rollout.imagine(model, variables, key, states, plans, sampled=False).states
        title = f"imagined under the plan, in {plans.shape[1] * scene.frame_s:.1f} s"
    else:
        dreamt = _policys_dream(loaded, drive, key, policy, states, memory, horizon)
        title = f"imagined under the policy, in {horizon * scene.frame_s:.1f} s"
    views = {}
    for name, latent in (("world model, now", states), (title, jax.tree.map(lambda leaf: leaf[:, -1], dreamt))):
        decoded = rollout.decode(model, variables, latent, heads, memory=memory)
        frames = jax.device_get(protocol.finish(decoded, model.config))
        views[name] = sheets.views_of_frames({head: value[None] for head, value in frames.items()}, 0)
    return views


def _policys_dream(loaded, drive, key, policy, states, memory, horizon):
    """LatentState [T, H, ...]: how a policy drives on in imagination from each of T moments."""
    world = policy.environment(loaded)
    speeds = jnp.concatenate([moment.memory.speed_mps for moment in drive.moments])
    maps = [moment.memory.route_map for moment in drive.moments]
    rows = jnp.arange(len(maps))
    bank = environment.StartBank(states, speeds, None if maps[0] is None else jnp.concatenate(maps), memory, rows)
    with warnings.catch_warnings():  # as the command says of a planner's horizon
        warnings.simplefilter("ignore")
        params = world.params(loaded.variables, bank, horizon, temperature=0.0)
    first = jax.vmap(world.state_at, (0, None))(rows, params)
    onward = lambda key, state: environment.play(world, params, key, state, policy.policy(), horizon)[0].latent
    return jax.vmap(onward)(jax.random.split(key, len(maps)), first)
