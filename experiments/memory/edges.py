"""Can edges of ranges be chosen? python -m experiments.memory.edges RUN [UPDATES] [TRAINING WINDOWS]

A network of its own sees what the memory shows, the scans of AGES frames ago alone, where each of their returns lies
beside its beam, and the model's ranges. It chooses the range of each pixel that the model says returns among these and
those of its eight neighbours, by the expected absolute error. Prints, on 16 windows of each split held out, Chamfer
distances and the mean absolute error of ranges of the model, of the memory and of what was chosen, and the distances
where the true range chooses among the neighbours.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen

import muvo_jax
from experiments.memory import geometry, ranges
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import occupancy, points, protocol
from muvo_jax.model import glimpse
from muvo_jax.ops import motion, reproject

AGES, BATCH, RATE, JUDGED, NEAR_M = (1, 2, 4), 12, 2e-3, 16, 10.0
NEIGHBOURS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]


def shown(run, batch):
    """Ranges [N, Hr, Wr] that the memory shows, filled and newest and unmoved, those of the scans alone [N, Hr, Wr, A],
    and how far their returns lie beside their beams [N, Hr, Wr, 3 A]."""
    config = run.model.config
    memory, rows, vantage = geometry.sights(run, batch)
    seen = glimpse.look(config, memory, rows, vantage, ("range_view",))[0]["range_view"]
    alone, beside = [], []
    for age in AGES:
        moved = reproject.move_range_view(memory.range_view[rows, -age],
                                          motion.relative(vantage.motion.pose, memory.pose[rows, -age]),
                                          config.range_view)
        away_m = moved[..., :3] - reproject.beam_points(moved[..., 3], config.range_view)
        beside.append(jnp.where(moved[..., 3:] > 0.0, away_m / jnp.maximum(moved[..., 3:], 1.0), 0.0) * 20.0)
        alone.append(reproject.onto_beams(moved, config.range_view)[..., 3])
    return seen.filled_m, seen.newest_m, seen.still_m, jnp.stack(alone, -1), jnp.concatenate(beside, -1)


def collected(run, frames, look, split: str, windows: int):
    """(true ranges, model's ranges, inputs, candidates) of the imagined frames of windows, [N, Hr, Wr, ...]."""
    data, parts = run.config.data, []
    for entry in pipeline.evaluation_batches(frames, split, windows=windows):
        truth = np.asarray(entry.batch.range_view)[:, data.context:data.context + data.horizon, ..., 3]
        guess = protocol.predict(run.model, run.variables, jax.random.key(0), entry.batch, context=data.context,
                                 horizon=data.horizon, sampled=False)["range_view"][:, data.context:, ..., 3]
        truth, guess = (np.asarray(value).reshape(-1, *truth.shape[2:]) for value in (truth, guess))
        filled, newest, still, alone, beside = map(np.asarray, jax.device_get(look(entry.batch)))
        around = np.pad(filled, ((0, 0), (1, 1), (1, 1)), constant_values=-1.0)
        rows, columns = filled.shape[1:]
        moved = [around[:, 1 + down:1 + down + rows, 1 + right:1 + right + columns] for down, right in NEIGHBOURS]
        candidates = np.stack([*moved, guess, *np.moveaxis(alone, -1, 0)], axis=-1)
        given = np.stack([guess, filled, newest, still, *np.moveaxis(alone, -1, 0)], axis=-1)
        inputs = np.concatenate([np.where(given > 0.0, NEAR_M / (NEAR_M + np.maximum(given, 0.0)), 0.0), given > 0.0,
                                 beside], axis=-1)
        count = entry.count * data.horizon
        parts.append([value[:count].astype(np.float32) for value in (truth, guess, inputs, candidates)])
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


class Chooser(linen.Module):
    """Inputs [N, Hr, Wr, C] -> logits of the candidates, at three sizes and back."""

    candidates: int

    @linen.compact
    def __call__(self, x):
        conv = lambda x, width, stride=1: jax.nn.leaky_relu(linen.Conv(width, (3, 3), (stride, stride))(x), 0.1)
        twice = lambda x: jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
        full = conv(conv(x, 32), 32)
        half = conv(conv(full, 64, 2), 64)
        quarter = conv(conv(half, 96, 2), 96)
        half = conv(jnp.concatenate([twice(quarter), half], -1), 64)
        full = conv(jnp.concatenate([twice(half), full], -1), 32)
        model_first = jnp.zeros(self.candidates).at[len(NEIGHBOURS)].set(2.0)
        return linen.Dense(self.candidates, kernel_init=linen.initializers.zeros)(full) + model_first


def judged(run, name: str, split: str, range_m: np.ndarray, truth: np.ndarray) -> None:
    view, evaluation = run.model.config.range_view, run.config.evaluation
    shape = (-1, run.config.data.horizon, *truth.shape[1:])
    scan, true = (ranges.on_beams(value.reshape(shape).astype(np.float32), view) for value in (range_m, truth))
    every, above = (np.nanmean(points.frame_chamfer_m(
        scan, true, return_threshold_m=evaluation.return_threshold_m, points=evaluation.chamfer_points, seed=(0, 0),
        above_m=above_m)) for above_m in (-np.inf, occupancy.ABOVE_ROAD_M))
    both = (range_m > 0.0) & (truth > 0.0)
    print(f"{split}  {name:20s} Chamfer {every:.3f} m, above the road {above:.3f} m, ranges off by "
          f"{np.abs(range_m - truth)[both].mean():.3f} m", flush=True)


def main(path: str = "builtin:town", updates: str = "600", windows: str = "144") -> None:
    run = muvo_jax.load(path)
    recording = recordings.open_configured(run.config)
    frames, look = pipeline.Frames(recording, run.config), jax.jit(lambda batch: shown(run, batch))
    truth, _, inputs, candidates = collected(run, frames, look, "train", int(windows))
    chooser, optimizer = Chooser(candidates.shape[-1]), optax.adam(optax.cosine_decay_schedule(RATE, int(updates)))
    params = chooser.init(jax.random.key(0), jnp.asarray(inputs[:1]))
    state, rng = optimizer.init(params), np.random.default_rng(0)

    def loss(params, inputs, candidates, truth):
        there = candidates > 0.0
        chances = jax.nn.softmax(jnp.where(there, chooser.apply(params, inputs), -1e9))
        errors = jnp.where(there, jnp.abs(candidates - jnp.expand_dims(truth, -1)), 0.0)
        counts = (truth > 0.0) & there.any(-1)
        return ((chances * errors).sum(-1) * counts).sum() / counts.sum()

    @jax.jit
    def update(params, state, inputs, candidates, truth):
        changes, state = optimizer.update(jax.grad(loss)(params, inputs, candidates, truth), state)
        return optax.apply_updates(params, changes), state

    for _ in range(int(updates)):
        chosen = rng.integers(0, len(inputs), BATCH)
        params, state = update(params, state, inputs[chosen], candidates[chosen], truth[chosen])
    choose = jax.jit(chooser.apply)
    for split in (name for name in recording.description.splits if name != "train"):
        truth, guess, inputs, candidates = collected(run, frames, look, split, JUDGED)
        logits = np.concatenate([choose(params, part) for part in np.array_split(inputs, len(inputs) // BATCH)])
        pick = lambda place, of=candidates: np.take_along_axis(of, place[..., None], -1)[..., 0]
        returns, nearest = guess > run.config.evaluation.return_threshold_m, len(NEIGHBOURS)
        best = np.where(candidates > 0.0, np.abs(candidates - truth[..., None]), np.inf)[..., :nearest].argmin(-1)
        filled = candidates[..., nearest // 2]
        for name, picked in (("the model", guess), ("the memory", np.where(filled > 0.0, filled, guess)),
                             ("chosen", pick(np.where(candidates > 0.0, logits, -np.inf).argmax(-1))),
                             ("chosen by the truth", np.where(truth > 0.0, pick(best), guess))):
            judged(run, name, split, np.where(returns, picked, -1.0), truth)


if __name__ == "__main__":
    main(*sys.argv[1:])
