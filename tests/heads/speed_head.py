"""A made-up head: all that a new one takes beside its line in config.KNOWN_HEADS (test_made_up_head.py adds that)."""

import numpy as np

from muvo_jax import head
from muvo_jax.metrics import streaming
from muvo_jax.model import decoders
from muvo_jax.objectives import regression


def losses(learned):
    return {"speed": regression.l1_sums(learned.predictions[1], learned.truth("speed_mps")[..., None])}


def off_mps(frames, truth, grid):
    del grid
    return np.abs(frames - np.asarray(truth.speed_mps, np.float64))


def sums(judged):
    return {"frames": streaming.mean_sums(off_mps(judged.frames, judged.truth, None))}


def draw(frame, scene, columns_px):
    picture = np.zeros((12, columns_px, 3), np.uint8)
    picture[:, :round(columns_px * float(frame) / 20.0)] = (0, 200, 255)
    return picture


HEAD = head.Head(
    targets=lambda model: {"speed_mps": ()}, build=lambda model: decoders.of_numbers(model, 1),
    finish=lambda value, scale, config: value * config.speed_scale_mps,
    losses=losses, weights=lambda loss: {"speed": 0.5},
    frames=head.Frames(
        field="speed_mps", of=lambda value, model: value[..., 0], sums=sums, error=off_mps, error_name="speed",
        metrics={"speed_error_mps": head.Metric("frames", streaming.mean, "speed error", "m/s", 2, higher=False,
                                                on_screen=True, logged="imagined_speed_error_mps")},
        pictures=(head.Picture("speed", draw),)))
