"""Whether predictions answer to actions as the world does: the same past, the same noise, two plans, two worlds.

From the moment at which the expert hands over, a simulator and the model go on under two plans that differ in one
control. What the sensors show under one plan minus what they show under the other is the response; the model's is
regressed on the simulator's (`uncertainty.action_sensitivity`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import closed_loop, uncertainty
from muvo_jax.model import live, rollout
from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import OCCUPANCY_OCCUPIED, OCCUPANCY_UNKNOWN, Array, ArrayLike, Variables

HEADS = ("image", "range_view", "occupancy", "ego_motion")
Moved = Callable[[Sequence[Any], Sequence[float], int], Mapping[str, np.ndarray]]
Answers = dict[int, dict[str, dict[str, dict[str, dict[str, float]]]]]
# Name -> two actions, each held for the whole horizon.
CONTRASTS = {"brake or accelerate": ((-0.5, 0.0), (0.5, 0.0)), "left or right": ((0.0, -0.15), (0.0, 0.15))}


def measure(simulator: closed_loop.Simulator, truth: Callable[[Any], Mapping[str, ArrayLike]], model: WorldModel,
            variables: Variables, key: Array, seeds: Sequence[int], *, horizons: Sequence[int], context: int,
            moved: Moved | None = None) -> Answers:
    """Scores of every contrast and head over drives of the given seeds.

    Args:
      simulator: whose expert drives for `context` steps, while the model observes.
      truth: state -> {head: what the sensors show}, in the units of types.Batch.
      model, variables: heads of HEADS that it lacks are left out.
      key: of the latents' noise; both plans share it.
      seeds: of the simulator.
      horizons: steps under either plan, each scored on its own.
      context: steps that the expert drives.
      moved: what geometry alone predicts, to be scored beside the model: (states, action, steps) -> head -> values
        [states, steps, ...] as `values` has them.

    Returns:
      horizon -> contrast -> head -> source ("model", "warp_last") -> {"gain", "correlation"}, over all steps up to the
      horizon and all drives; see uncertainty.action_sensitivity.

    Raises:
      ValueError: if there is no seed, no horizon or one below 1.
    """
    if not seeds or not horizons or min(horizons) < 1:
        raise ValueError(f"sensitivity: got {len(seeds)} seeds and horizons {list(horizons)}; expected at least 1 of "
                         f"each, of at least 1 step.")
    horizon = max(horizons)
    heads = tuple(head for head in HEADS if head in model.config.heads)
    key_watch, key_imagine = jax.random.split(key)
    started = [watch(simulator, model, variables, jax.random.fold_in(key_watch, seed), seed, context) for seed in seeds]
    states = [state for state, _ in started]
    join = lambda *leaves: jnp.concatenate(leaves)
    latents, memory = (jax.tree.map(join, *parts) for parts in zip(
        *((stream.latent, stream.memory) for _, stream in started), strict=True))
    scores: Answers = {steps: {} for steps in horizons}
    for name, pair in CONTRASTS.items():
        plans = np.broadcast_to(np.asarray(pair, np.float32)[None, :, None], (len(seeds), 2, horizon, 2))
        dream = rollout.imagine(model, variables, key_imagine, latents, plans, same_noise=True)
        # One drive at a time is decoded, so that many need no more memory than one.
        decoded = [[jax.device_get(rollout.decode(model, variables, dream.states[drive, plan], heads, memory=memory,
                                                  rows=np.full(horizon, drive, np.int32)))
                    for drive in range(len(seeds))] for plan in (0, 1)]
        shown = [[follow(simulator, truth, state, action, horizon) for state in states] for action in pair]
        beside = [moved(states, action, horizon) if moved else {} for action in pair]
        for head in heads:
            true = [np.stack([frames[head] for frames in drives]) for drives in shown]
            sources = {"model": [values(head, np.stack([predictions[head] for predictions in drives]))
                                 for drives in decoded]}
            if head in beside[0]:
                sources["warp_last"] = [frames[head] for frames in beside]
            for steps in horizons:
                cut = lambda pair, steps=steps: [value[:, :steps] for value in pair]
                scores[steps].setdefault(name, {})[head] = {
                    source: score(head, cut(predicted), cut(true)) for source, predicted in sources.items()}
    return scores


def watch(simulator: closed_loop.Simulator, model: WorldModel, variables: Variables, key: Array, seed: int,
          context: int) -> tuple[Any, live.LiveState]:
    """The simulator's state after `context` steps of the expert, and the stream of one that saw all of them."""
    state, stream, previous = simulator.reset(seed), live.start_live(model, key), np.zeros(2, np.float32)
    for step in range(context + 1):
        if step:
            previous = np.asarray(simulator.expert(state), np.float32)
            state = simulator.step(state, previous)
        observation = {name: np.asarray(value)[None] for name, value in simulator.observe(state).items()}
        stream = live.observe_step(model, variables, stream, observation, previous[None], sampled=False)
    return state, stream


def follow(simulator: closed_loop.Simulator, truth: Callable[[Any], Mapping[str, ArrayLike]], state: Any,
           action: Sequence[float], horizon: int) -> dict[str, np.ndarray]:
    """What the sensors show after each step under one action: head -> [H, ...]."""
    held, frames = np.asarray(action, np.float32), []
    for _ in range(horizon):
        state = simulator.step(state, held)
        frames.append(truth(state))
    return {head: np.stack([np.asarray(frame[head]) for frame in frames]) for head in frames[0]}


def score(head: str, predicted: Sequence[ArrayLike], shown: Sequence[ArrayLike]) -> dict[str, float]:
    """Gain and correlation of one head.

    Args:
      head: one of HEADS; images answer in [0, 1], range views in metres of range where both plans return, occupancy in
        probability where both plans know, ego_motion in m/s of speed.
      predicted: `values` of what was predicted under either plan.
      shown: types.Batch's field under either plan, [..., *size, channels] ([..., X, Y, Z] of occupancy).
    """
    first, second = (np.asarray(value) for value in predicted)
    true, known = zip(*(_truth(head, np.asarray(value)) for value in shown), strict=True)
    both = known[0] & known[1]
    mask = lambda value: jnp.asarray(np.where(both, value, 0.0), jnp.float32)
    found = uncertainty.action_sensitivity((mask(first), mask(second)), (mask(true[0]), mask(true[1])))
    return {name: float(value) for name, value in found.items()}


def values(head: str, decoded: np.ndarray) -> np.ndarray:
    """What answers to actions of a decoded head [..., *size, channels]: see `score`."""
    if head in ("range_view", "ego_motion"):
        return decoded[..., 3]
    if head == "occupancy":
        return np.asarray(jax.nn.sigmoid(decoded[..., 1] - decoded[..., 0]))
    return decoded


def _truth(head: str, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values, where they are known)."""
    if head == "range_view":
        return shown[..., 3], shown[..., 3] > 0
    if head == "occupancy":
        return (shown == OCCUPANCY_OCCUPIED).astype(np.float32), shown != OCCUPANCY_UNKNOWN
    if head == "ego_motion":
        return shown[..., 3], np.ones(shown.shape[:-1], bool)
    return shown.astype(np.float32) / 255.0, np.ones(shown.shape, bool)
