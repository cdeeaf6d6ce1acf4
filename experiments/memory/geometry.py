"""What geometry alone says, by one choice of the memory after the other (docs/memory.md): nothing is learned.

    python -m experiments.memory.geometry RUN

Prints scores of the imagined frames of a trained run's validation windows, as model/glimpse.py shows them to the
decoders and as other rules would. The run gives windows, actions and the average frame; its parameters are not used.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import occupancy
from muvo_jax.model import glimpse
from muvo_jax.ops import motion, reproject
from muvo_jax.types import Batch

MOVED = "what moved and goes on, alone"


def sights(run, batch: Batch):
    """The memory of the observed frames and what each imagined state looks at in it."""
    context, horizon = run.config.data.context, run.config.data.horizon
    model, variables, key = run.model, run.variables, jax.random.key(0)
    observed = muvo_jax.observe(model, variables, key, batch.time_slice(0, context), sampled=False)
    actions = jnp.asarray(batch.action)[:, context - 1:context + horizon - 1]
    dream = muvo_jax.imagine(model, variables, key, observed.last, actions, sampled=False)
    vantage = dream.states.vantage
    lead = vantage.last.ndim
    vantage = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[lead:]), vantage)
    rows = jnp.repeat(jnp.arange(batch.batch_size), horizon)
    return observed.memory, rows, vantage


def voxels(run, batch: Batch) -> dict[str, jax.Array]:
    """Rule -> occupied, bool [N, X, Y, Z]."""
    config = run.model.config
    places = config_lib.as_kind(config.first_guess, config_lib.LastSeen).memory_frames
    memory, rows, vantage = sights(run, batch)
    shown = glimpse.look(config, memory, rows, vantage, ("occupancy",))[0]["occupancy"]
    priority = lambda newest, older: newest + (1.0 - jnp.abs(newest)) * older
    first = priority(shown.newest, shown.older)
    memory_frames = memory.pose.shape[1] + jnp.arange(-places, 0)
    index = jnp.broadcast_to(jnp.maximum(memory_frames, 0)[None], (rows.shape[0], places))
    pose = motion.relative(jnp.broadcast_to(vantage.motion.pose[:, None], (*index.shape, 3)),
                           memory.pose[rows[:, None], index])
    view = config.range_view
    beams = reproject.scan_evidence(memory.range_view[..., 3].reshape(-1, view.rows, view.columns),
                                    (rows[:, None] * memory.pose.shape[1] + index).reshape(-1), pose.reshape(-1, 3),
                                    config.voxels, view).reshape(*index.shape, *config.voxels.shape)
    beams = jnp.where((memory_frames >= 0).reshape(1, -1, 1, 1, 1), beams, 0.0)
    fading = glimpse.FADE ** jnp.arange(places - 2, -1, -1).reshape(1, -1, 1, 1, 1)
    rules = {"beams through the voxels' centres alone": priority(beams[:, -1], (beams[:, :-1] * fading).sum(axis=1)),
             "and voxels that hold a return, all scans added up": shown.newest + shown.older,
             "the newest scan first": first}
    if shown.onward is not None:
        rules["and what moved goes on"] = jnp.maximum(first, shown.onward)
        rules[MOVED] = shown.onward
    return {name: value > 0.0 for name, value in rules.items()}


def images(run, batch: Batch) -> dict[str, jax.Array]:
    """What fills the places that the newest image does not show -> float32 [N, H, W, 3]."""
    config = run.model.config
    memory, rows, vantage = sights(run, batch)
    view = glimpse.look(config, memory, rows, vantage, ("range_view",))[0]["range_view"]
    frames = memory.pose.shape[1]
    pose = motion.relative(vantage.motion.pose, memory.pose[rows, -1])
    moved, inside = reproject.move_image(memory.image.reshape(-1, *memory.image.shape[2:]), view.filled_m, pose,
                                         memory.intrinsics[rows], memory.camera_to_ego[rows], config.range_view,
                                         rows * frames + frames - 1)
    edge, inside = moved / 255.0, inside[..., None]
    average = jnp.asarray(run.variables["batch_stats"]["first_guess_image"]["scale_1"])[None]
    light = (memory.image[rows, -1] / 255.0).mean((1, 2), keepdims=True) / average.mean((1, 2), keepdims=True)
    fills = {"the average frame": average, "in the light of the newest": light * average, "the edge": edge,
             "half of either": 0.5 * (edge + light * average)}
    return {name: jnp.where(inside, edge, fill) for name, fill in fills.items()}


def main(path: str = "builtin:town") -> None:
    run = muvo_jax.load(path)
    config = run.config
    recording = recordings.open_configured(config)
    frames, above = pipeline.Frames(recording, config), occupancy.above_road(config.model.voxels)
    guesses = jax.jit(lambda batch: (voxels(run, batch), images(run, batch)))
    for split in (name for name in recording.description.splits if name != "train"):
        counts: dict[tuple[str, str], dict] = {}
        decibels: dict[str, list] = {}
        for entry in pipeline.evaluation_batches(frames, split, windows=config.evaluation.windows):
            truth = entry.batch.time_slice(config.data.context, entry.batch.frames)
            occupied, pictures = jax.device_get(guesses(entry.batch))
            where = {"above the road": None}
            if truth.occupancy_moving_mask is not None:
                where["movers"] = np.asarray(truth.occupancy_moving_mask)[..., above] > 0
            for rule, value in occupied.items():
                value = value.reshape(truth.occupancy.shape)[..., above]
                for name, mask in where.items():
                    new = occupancy.counts(value, np.asarray(truth.occupancy)[..., above], unknown_is_empty=False,
                                           where=mask)
                    old = counts.setdefault((rule, name), dict.fromkeys(new, 0))
                    counts[rule, name] = {key: old[key] + new[key].sum() for key in new}
            for fill, value in pictures.items():
                error = np.clip(value, 0, 1).reshape(truth.image.shape) - np.asarray(truth.image) / 255.0
                decibels.setdefault(fill, []).append(-10.0 * np.log10(np.square(error).mean(axis=(2, 3, 4))))
        for (rule, name), sums in counts.items():
            score = "precision" if rule == MOVED else "iou_occ"
            print(f"{split}  {score} {name}  {occupancy.SCORES[score](sums):.3f}  {rule}")
        for fill, values in decibels.items():
            print(f"{split}  PSNR  {np.concatenate(values).mean():.2f} dB  {fill}")


if __name__ == "__main__":
    main(*sys.argv[1:])
