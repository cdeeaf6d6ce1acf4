"""What a model makes of the ranges that its memory shows: Chamfer distances of imagined scans, and of mixtures.

    python -m experiments.memory.ranges RUN [WINDOWS]

"the model's returns at the memory's ranges" asks the model only which pixels return; "but those that doubt the memory"
leaves out its returns that are more than DOUBT_M from the memory's. The truth beside itself says what the measure
costs, which draws other points of each.
"""

import sys

import jax
import numpy as np

import muvo_jax
from experiments.memory import geometry
from muvo_jax import recordings
from muvo_jax.data import pipeline
from muvo_jax.metrics import occupancy, points, protocol
from muvo_jax.model import glimpse
from muvo_jax.ops import reproject
from muvo_jax.types import RANGE_NO_RETURN_M

DOUBT_M = 1.0


def shown(run, batch):
    """What the memory shows the decoders of ranges: (moved, and its small holes filled), [N, Hr, Wr] each."""
    memory, rows, vantage = geometry.sights(run, batch)
    view = glimpse.look(run.model.config, memory, rows, vantage, ("range_view",))[0]["range_view"]
    return view.moved_m, view.filled_m


def on_beams(range_m: np.ndarray, view) -> np.ndarray:
    """Range views [..., 4] whose returns lie on their beams."""
    points_m = reproject.beam_points(range_m.reshape(-1, *range_m.shape[-2:]), view)
    return np.concatenate([np.asarray(points_m).reshape(*range_m.shape, 3), range_m[..., None]], axis=-1)


def mixtures(model: np.ndarray, moved_m: np.ndarray, filled_m: np.ndarray, threshold_m: float, view) -> dict:
    """Name -> range views [B, T, Hr, Wr, 4]."""
    nothing, returns = RANGE_NO_RETURN_M, model[..., 3] > threshold_m
    doubting = (moved_m > 0.0) & (np.abs(moved_m - model[..., 3]) > DOUBT_M)
    return {"the model": model, "the memory, moved": on_beams(moved_m, view),
            "the memory, its small holes filled": on_beams(filled_m, view),
            "the model's returns at the memory's ranges": on_beams(
                np.where(returns & (filled_m > 0.0), filled_m, nothing), view),
            "the model's returns but those that doubt the memory": on_beams(
                np.where(returns & ~doubting, model[..., 3], nothing), view)}


def main(path: str = "builtin:town", windows: str = "16") -> None:
    run = muvo_jax.load(path)
    config, context, horizon = run.config, run.config.data.context, run.config.data.horizon
    recording, threshold_m = recordings.open_configured(config), config.evaluation.return_threshold_m
    frames, look = pipeline.Frames(recording, config), jax.jit(lambda batch: shown(run, batch))
    for split in (name for name in recording.description.splits if name != "train"):
        found: dict[str, list[np.ndarray]] = {}
        for number, entry in enumerate(pipeline.evaluation_batches(frames, split, windows=int(windows))):
            truth = np.asarray(entry.batch.time_slice(context, context + horizon).range_view)
            guess = protocol.predict(run.model, run.variables, jax.random.key(0), entry.batch, context=context,
                                     horizon=horizon, sampled=False)["range_view"][:, context:]
            seen = (np.asarray(value).reshape(truth.shape[:-1]) for value in jax.device_get(look(entry.batch)))
            views = mixtures(np.asarray(guess), *seen, threshold_m, config.model.range_view)
            for name, view in (views | {"the truth itself": truth}).items():
                found.setdefault(name, []).append(np.stack([points.frame_chamfer_m(
                    view, truth, return_threshold_m=threshold_m, points=config.evaluation.chamfer_points,
                    seed=(0, number), above_m=above_m) for above_m in (-np.inf, occupancy.ABOVE_ROAD_M)]))
        for name, distances in found.items():
            every, above = np.nanmean(np.concatenate(distances, axis=1), axis=(1, 2))
            print(f"{split}  {name:52s} Chamfer {every:.3f} m, above the road {above:.3f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
