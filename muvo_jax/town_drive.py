"""The built-in town as a simulator that a model's drivers drive: at the model's rate, seen through its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.agents import closed_loop
from muvo_jax.data import prepare
from muvo_jax.metrics import baselines, warp
from muvo_jax.town import record, simulator

FIRST_SEED = 5_000  # no recorded drive has these seeds


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
                                     over and not collided and not arrived, arrived and not collided,
                                     float(state.speed_mps), float(state.pose[2]))

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
    """As many steps as training imagines (Config.imagined_steps), and twice as many."""
    return config.imagined_steps, 2 * config.imagined_steps


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
