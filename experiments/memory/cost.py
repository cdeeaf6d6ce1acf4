"""What the memory costs: processor seconds of decoding with it and without it, and of imagining, as ratios in one run.

    python -m experiments.memory.cost

The town's sizes, a batch of eight windows, fresh weights. Rows: decoding all heads of imagined frames; a planner's
decoding, of occupancy alone for 64 states of one start, with the evidence worked out once; imagining 12 steps.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import glimpse
from muvo_jax.ops import camera, range_view
from muvo_jax.types import Batch

BATCH, CONTEXT, HORIZON, REPEATS = 8, 6, 6, 5


def seconds(function, *arguments) -> float:
    """The least processor seconds of a few calls."""
    jax.block_until_ready(function(*arguments))
    best = float("inf")
    for _ in range(REPEATS):
        start = time.process_time()
        jax.block_until_ready(function(*arguments))
        best = min(best, time.process_time() - start)
    return best


def window(config, batch: int, frames: int) -> Batch:
    random, view = np.random.default_rng(0), config.range_view
    lead = (batch, frames)
    beams = range_view.beam_directions(view)
    road_m = view.position_m[2] / np.maximum(-beams[..., 2], 1e-3)
    range_m = np.minimum(20.0, road_m) * random.uniform(0.9, 1.0, (*lead, 1, 1))
    scan = np.concatenate([beams * range_m[..., None] + view.position_m, range_m[..., None]], -1).astype(np.float32)
    intrinsics = camera.intrinsics_from_fov(config.image_size[1], config.image_size[0], 1.4)
    return Batch(action=random.uniform(-1, 1, (*lead, 2)).astype(np.float32),
                 is_first=np.broadcast_to(np.arange(frames) == 0, lead),
                 image=random.integers(0, 256, (*lead, *config.image_size, 3), np.uint8), range_view=scan,
                 route_map=np.zeros((*lead, 64, 64), np.uint8), speed_mps=np.full(lead, 8.0, np.float32),
                 intrinsics=np.stack([intrinsics] * batch),
                 camera_to_ego=np.stack([camera.level_camera_to_ego((1.0, 0.0, 1.8))] * batch))


def measure(config) -> dict[str, float]:
    model = muvo_jax.WorldModel(config.model)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    batch, key = window(config.model, BATCH, CONTEXT), jax.random.key(1)
    observed = jax.jit(lambda: muvo_jax.observe(model, variables, key, batch))()
    actions = jnp.zeros((BATCH, 12, 2))
    imagine = jax.jit(lambda start: muvo_jax.imagine(model, variables, key, start, actions).states)
    states = imagine(observed.last)
    heads = config.model.heads
    decode = jax.jit(lambda states, memory: muvo_jax.decode(model, variables, states, heads, memory=memory))
    plan = jax.jit(lambda states, memory: muvo_jax.decode(model, variables, states, ("occupancy",), memory=memory,
                                                          rows=None if memory is None else jnp.zeros((64,), jnp.int32)))
    flat = jax.tree.map(lambda leaf: jnp.repeat(leaf[0, :8], 8, axis=0), states)
    first = None if observed.memory is None else glimpse.with_evidence(
        config.model, observed.memory, observed.last.vantage)
    return {"decoding all heads": seconds(decode, jax.tree.map(lambda leaf: leaf[:, :HORIZON], states),
                                          observed.memory),
            "a planner's decoding": seconds(plan, flat, first), "imagining 12 steps": seconds(imagine, observed.last)}


if __name__ == "__main__":
    with_memory = presets.get("town")
    without = dataclasses.replace(with_memory, model=dataclasses.replace(
        with_memory.model, first_guess=config_lib.TrainingMean()))
    with_s, without_s = measure(with_memory), measure(without)
    for name, value in with_s.items():
        ratio = value / without_s[name]
        print(f"{name}: {value:.3f} s with the memory, {without_s[name]:.3f} s without, ratio {ratio:.2f}")
