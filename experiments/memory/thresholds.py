"""Above which probability voxels are best called occupied (model.occupied_above): scores of imagined training windows.

    python -m experiments.memory.thresholds RUN
"""

import sys

import jax
import numpy as np

import muvo_jax
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import occupancy

ABOVE = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)


def main(path: str = "builtin:town") -> None:
    run = muvo_jax.load(path)
    config, model = run.config, run.model
    context, horizon = config.data.context, config.data.horizon
    frames = pipeline.Frames(recordings.open_configured(config), config)
    above = occupancy.above_road(config.model.voxels)

    @jax.jit
    def imagined(batch):
        key = jax.random.key(0)
        observed = muvo_jax.observe(model, run.variables, key, batch.time_slice(0, context), sampled=False)
        actions = batch.action[:, context - 1:context + horizon - 1]
        dream = muvo_jax.imagine(model, run.variables, key, observed.last, actions, sampled=False)
        return muvo_jax.decode(model, run.variables, dream.states, ("occupancy",), memory=observed.memory).occupancy

    counts: dict[tuple[str, float], dict] = {}
    for entry in pipeline.evaluation_batches(frames, "train", windows=config.evaluation.windows):
        truth = entry.batch.time_slice(context, entry.batch.frames)
        logits = np.asarray(imagined(entry.batch)).reshape(*truth.occupancy.shape, 2)[..., above, :]
        where = {"above the road": None}
        if truth.occupancy_moving_mask is not None:
            where["movers"] = np.asarray(truth.occupancy_moving_mask)[..., above] > 0
        for name, mask in where.items():
            for limit in ABOVE:
                new = occupancy.counts(np.asarray(occupancy.predicted_occupied(logits, limit)),
                                       np.asarray(truth.occupancy)[..., above], unknown_is_empty=False, where=mask)
                old = counts.setdefault((name, limit), dict.fromkeys(new, 0))
                counts[name, limit] = {key: old[key] + new[key].sum() for key in new}
    for (name, limit), sums in counts.items():
        print(f"IoU+ {name}  above {limit:.2f}: {occupancy.SCORES['iou_occ'](sums):.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
