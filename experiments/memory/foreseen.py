"""Can it be foreseen where a moved image will miss? python -m experiments.memory.foreseen RUN [WINDOWS]

An earlier image is moved to the newest one as the memory would move it. Block matching finds how far each pixel misses
(the place up to REACH_PX away that fits its neighbourhood best, far ones at a price), and imagined images are looked up
as far again aside for every step that has passed. Prints PSNR in dB by step, beside the moved newest image as it is.
"""

import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

import muvo_jax
from experiments.memory import ceiling, geometry
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.model import glimpse
from muvo_jax.ops import motion, reproject

REACH_PX, STEP_PX = 2.0, 0.5
AGES, SIDES_PX, PRICES = (1, 2, 3), (9, 15), (0.0, 1e-3)  # frames back; of a neighbourhood; of a pixel, squared error
SMOOTH_PX = 5


def places(run, batch):
    """Where [B, N, H, W, 2] (row, column, px) each pixel of the imagined images looks in the newest one, and of the
    newest in those of AGES before it."""
    config = run.model.config
    memory, rows, vantage = geometry.sights(run, batch)
    count = memory.pose.shape[0]

    def looked_up(range_m, pose, of):
        """By images whose colours are the coordinates of their pixels."""
        sides = memory.image.shape[2:4]
        grid = jnp.stack(jnp.meshgrid(*map(jnp.arange, sides), indexing="ij"), -1).astype(jnp.float32)[None]
        found, _ = reproject.move_image(grid, range_m, pose, memory.intrinsics[of], memory.camera_to_ego[of],
                                        config.range_view, jnp.zeros_like(of))
        return found.reshape(count, -1, *found.shape[1:])

    seen = glimpse.look(config, memory, rows, vantage, ("range_view",))[0]["range_view"].filled_m
    ahead = looked_up(seen, motion.relative(vantage.motion.pose, memory.pose[rows, -1]), rows)
    newest = [looked_up(memory.range_view[:, -1, ..., 3], motion.relative(memory.pose[:, -1], memory.pose[:, -1 - age]),
                        jnp.arange(count)) for age in AGES]
    return ahead, jnp.concatenate(newest, axis=1)


def sampled(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] at places [H, W, 2], bilinear."""
    return np.stack([scipy.ndimage.map_coordinates(image[..., channel], place.transpose(2, 0, 1), order=1,
                                                   mode="nearest") for channel in range(3)], axis=-1)


def misses(earlier: np.ndarray, newest: np.ndarray, place: np.ndarray, side_px: int, price: float) -> np.ndarray:
    """How far aside [H, W, 2] px of its place each pixel of the newest image is found in an earlier one."""
    axis = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    shifts = np.array(list(itertools.product(axis, axis)))
    costs = [scipy.ndimage.uniform_filter(np.square(sampled(earlier, place + shift) - newest).mean(-1), side_px)
             + price * np.abs(shift).sum() for shift in shifts]
    return scipy.ndimage.uniform_filter(shifts[np.argmin(costs, axis=0)], (SMOOTH_PX, SMOOTH_PX, 0))


def main(path: str = "builtin:town", windows: str = "8") -> None:
    run = muvo_jax.load(path)
    context, horizon = run.config.data.context, run.config.data.horizon
    recording = recordings.open_configured(run.config)
    frames, look = pipeline.Frames(recording, run.config), jax.jit(lambda batch: places(run, batch))
    for split in (name for name in recording.description.splits if name != "train"):
        scores: dict[str, list[list[float]]] = {}
        for entry in pipeline.evaluation_batches(frames, split, windows=int(windows)):
            images = np.asarray(entry.batch.image) / 255.0
            ahead, before = map(np.asarray, jax.device_get(look(entry.batch)))
            for sample, seen in enumerate(images[:entry.count]):
                newest, truth = seen[context - 1], seen[context:context + horizon]
                told = {"as it is": np.zeros_like(ahead[sample, 0])}
                for (index, age), side_px, price in itertools.product(enumerate(AGES), SIDES_PX, PRICES):
                    found = misses(seen[context - 1 - age], newest, before[sample, index], side_px, price)
                    told[f"{age} back, {side_px} px, price {price:g}"] = found / age
                for name, miss in told.items():
                    shown = [sampled(newest, place + (step + 1) * np.stack([scipy.ndimage.map_coordinates(
                        miss[..., axis], place.transpose(2, 0, 1), order=1, mode="nearest") for axis in (0, 1)], -1))
                             for step, place in enumerate(ahead[sample])]
                    scores.setdefault(name, []).append(ceiling.psnr_db(np.stack(shown), truth).tolist())
        for name, found in scores.items():
            print(f"{split}  {name:26s} " + " ".join(f"{value:.2f}" for value in np.mean(found, axis=0)))


if __name__ == "__main__":
    main(*sys.argv[1:])
