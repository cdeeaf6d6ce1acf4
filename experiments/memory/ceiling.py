"""How good a moved image can be: python -m experiments.memory.ceiling RUN [WINDOWS]

PSNR of imagined steps, in dB: of the model, of the newest image as the memory moves it, of that with the best shift of
half and whole pixels around each pixel (chosen by the true image, which nobody has), and of the true image itself after
half a pixel there and back, which is what any resampling costs.
"""

import sys

import jax
import numpy as np
import scipy.ndimage

import muvo_jax
from experiments.memory import errors
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import protocol

SHIFTS_PX = (-1.0, -0.5, 0.0, 0.5, 1.0)
NEIGHBOURHOOD_PX = 9  # over which a shift is chosen


def psnr_db(frames: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of each frame [B, H, W, 3] in [0, 1]."""
    return -10.0 * np.log10(np.square(frames - truth).mean(axis=(1, 2, 3)))


def shifted(frames: np.ndarray, down_px: float, right_px: float) -> np.ndarray:
    return scipy.ndimage.shift(frames, (0.0, down_px, right_px, 0.0), order=1, mode="nearest")


def best_shifts(frames: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Each pixel of frames [B, H, W, 3] from where it fits its neighbourhood in the truth best."""
    candidates = np.stack([shifted(frames, down, right) for down in SHIFTS_PX for right in SHIFTS_PX])
    error = scipy.ndimage.uniform_filter(np.square(candidates - truth).mean(-1),
                                         (0, 0, NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX))
    return np.take_along_axis(candidates, error.argmin(axis=0)[None, ..., None], axis=0)[0]


def main(path: str = "builtin:town", windows: str = "16") -> None:
    run = muvo_jax.load(path)
    config, context, horizon = run.config, run.config.data.context, run.config.data.horizon
    recording = recordings.open_configured(config)
    frames, look = pipeline.Frames(recording, config), jax.jit(lambda batch: errors.moved(run, batch)[0])
    for split in (name for name in recording.description.splits if name != "train"):
        scores: dict[int, list[np.ndarray]] = {step: [] for step in errors.STEPS}
        for entry in pipeline.evaluation_batches(frames, split, windows=int(windows)):
            truth = np.asarray(entry.batch.time_slice(context, context + horizon).image) / 255.0
            guess = protocol.predict(run.model, run.variables, jax.random.key(0), entry.batch, context=context,
                                     horizon=horizon, sampled=False)["image"][:, context:]
            moved = np.asarray(look(entry.batch)).reshape(truth.shape)
            for step, found in scores.items():
                true, newest = truth[:entry.count, step - 1], moved[:entry.count, step - 1]
                there_and_back = shifted(shifted(true, 0.5, 0.5), -0.5, -0.5)
                found.append(np.stack([psnr_db(image, true) for image in (
                    guess[:entry.count, step - 1], newest, best_shifts(newest, true), there_and_back)]))
        for step, found in scores.items():
            model, newest, best, resampled = np.concatenate(found, axis=1).mean(axis=1)
            print(f"{split}  step {step}  model {model:.2f}, moved {newest:.2f}, with the best shifts {best:.2f}; the "
                  f"truth half a pixel there and back {resampled:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
