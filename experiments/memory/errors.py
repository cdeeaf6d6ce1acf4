"""Where the error of imagined images is: shares of the squared error, and the model beside the moved newest image.

    python -m experiments.memory.errors RUN [WINDOWS]

Pixels of road users on the move; of what the newest image did not show; and of the rest, those within a pixel of an
edge of the true image (a step of EDGE in brightness) and the flat ones.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import muvo_jax
from experiments.memory import geometry
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import protocol
from muvo_jax.model import glimpse
from muvo_jax.ops import motion, reproject

EDGE, STEPS = 0.06, (1, 3, 6)


def moved(run, batch):
    """The newest image, moved: float32 [N, H, W, 3], and where it shows something, bool [N, H, W]."""
    memory, rows, vantage = geometry.sights(run, batch)
    config = run.model.config
    view = glimpse.look(config, memory, rows, vantage, ("range_view",))[0]["range_view"]
    newest = memory.pose.shape[1] - 1
    image, inside = reproject.move_image(
        memory.image.reshape(-1, *memory.image.shape[2:]), view.filled_m,
        motion.relative(vantage.motion.pose, memory.pose[rows, newest]), memory.intrinsics[rows],
        memory.camera_to_ego[rows], config.range_view, rows * (newest + 1) + newest)
    return jnp.clip(image / 255.0, 0.0, 1.0), inside


def kinds(truth, image, inside):
    """Kind of pixel -> bool [B, T, H, W]."""
    grey = image.mean(-1)
    steps = [np.abs(np.diff(grey, axis=axis, prepend=np.take(grey, [0], axis))) > EDGE for axis in (2, 3)]
    edge = steps[0] | steps[1]
    near = edge | np.roll(edge, -1, 2) | np.roll(edge, -1, 3) | np.roll(edge, 1, 2) | np.roll(edge, 1, 3)
    movers = np.zeros_like(inside) if truth.image_moving_mask is None else np.asarray(truth.image_moving_mask) > 0
    return {"movers": movers, "new": ~inside & ~movers, "seen, at edges": inside & ~movers & near,
            "seen, flat": inside & ~movers & ~near}


def main(path: str = "builtin:town", windows: str = "16") -> None:
    run = muvo_jax.load(path)
    config, context, horizon = run.config, run.config.data.context, run.config.data.horizon
    recording = recordings.open_configured(config)
    frames, look = pipeline.Frames(recording, config), jax.jit(lambda batch: moved(run, batch))
    for split in (name for name in recording.description.splits if name != "train"):
        sums: dict[tuple[str, int], np.ndarray] = {}  # squared error of model and of the moved image, pixels, all
        for entry in pipeline.evaluation_batches(frames, split, windows=int(windows)):
            truth = entry.batch.time_slice(context, context + horizon)
            image = np.asarray(truth.image) / 255.0
            guess = protocol.predict(run.model, run.variables, jax.random.key(0), entry.batch, context=context,
                                     horizon=horizon, sampled=False)["image"][:, context:]
            seen, inside = (np.asarray(leaf).reshape(image.shape[:-1] + leaf.shape[3:])
                            for leaf in jax.device_get(look(entry.batch)))
            errors = [np.square(frame - image).mean(-1) for frame in (guess, seen)]
            for kind, mask in kinds(truth, image, inside).items():
                for step in STEPS:
                    part = mask[:, step - 1]
                    inside_part = [(error[:, step - 1] * part).sum() for error in errors]
                    sums[kind, step] = sums.get((kind, step), 0.0) + np.array(
                        [*inside_part, part.sum(), errors[0][:, step - 1].sum()])
        for (kind, step), (model, newest, pixels, every) in sums.items():
            print(f"{split}  step {step}  {kind:15s} {model / every:6.1%} of the model's squared error; mean "
                  f"{model / pixels:.4f}, of the moved newest image {newest / pixels:.4f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
