"""What a run looks at now and then: the loss and the evaluation metrics on a few windows of each validation split."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping

import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax import types
from muvo_jax.data import pipeline, prepare, schema, sources
from muvo_jax.metrics import baselines, protocol
from muvo_jax.model import world_model
from muvo_jax.objectives import perceptual
from muvo_jax.training import checkpoint
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

TRAINING_MEAN_FRAMES = 512


class Validator:
    """Validates on the first device; its functions are compiled once and shared with the final evaluation."""

    def __init__(self, model: world_model.WorldModel, config: config_lib.Config, frames: pipeline.Frames,
                 frozen: perceptual.FrozenEncoder | None = None):
        self.model, self.config, self.frames = model, config, frames
        self.splits = tuple(split for split in frames.recording.description.splits if split != "train")
        self._device = jax.devices()[0]
        self._losses = step_lib.make_validation_step(model, config, batch_size=config.evaluation.batch,
                                                     devices=[self._device], frozen=frozen)

    def run(self, state: state_lib.TrainState, split: str) -> dict[str, float]:
        """Loss terms and observed PSNR over whole windows, and the scores of imagined frames (NaN where undefined)."""
        state = jax.device_put(state, self._device)
        sums: dict[str, float] = {}
        batches = list(windows(self.frames, split, self.config.train.validation_windows))
        for batch, _ in batches:  # a window that fills a batch counts twice here: this is a monitor, not the report
            for name, value in self._losses(state, batch).items():
                sums[name] = sums.get(name, 0.0) + float(value) / len(batches)
        report = protocol.evaluate(self.model, state.variables, batches, self.config)
        scores = report["imagined"]["model"]
        names = {"psnr_db": "imagined_psnr_db", "chamfer_m": "imagined_chamfer_m",
                 "iou_occ_observed": "imagined_iou_occ"}
        return sums | {shown: scores[name]["mean"] for name, shown in names.items() if name in scores}

    def example(self, split: str, variables: types.Variables) -> tuple[types.Batch, baselines.Frames]:
        """The first windows of a split, always the same, and what the model makes of them (protocol.predict)."""
        batch, _ = next(windows(self.frames, split, self.config.evaluation.batch))
        data, evaluation = self.config.data, self.config.evaluation
        frames = protocol.predict(self.model, jax.device_put(variables, self._device), jax.random.key(evaluation.seed),
                                  batch, context=data.context, horizon=data.horizon, sampled=evaluation.sampled)
        return batch, frames


def windows(frames: pipeline.Frames, split: str, count: int) -> Iterator[tuple[types.Batch, int]]:
    """At most `count` windows of a split (0: all) as `protocol.evaluate` takes them."""
    return ((entry.batch, entry.count) for entry in pipeline.evaluation_batches(frames, split, windows=count))


def windows_of_run(run: run_lib.Run | str | os.PathLike, split: str | None = None, *, count: int,
                   frames: int | None = None) -> types.Batch:
    """See muvo_jax.windows."""
    config = (run if isinstance(run, run_lib.Run) else checkpoint.load_run(run)).config
    recording = sources.open_configured(config)
    held_out = [name for name in recording.description.splits if name != "train"]
    split = split or (held_out or ["train"])[0]
    entry = next(pipeline.evaluation_batches(pipeline.Frames(recording, prepare.adapt(config, recording).config), split,
                                             windows=count, length=frames, batch=count))
    if entry.count < count:
        raise schema.DataError(f"split {split!r} of {recording.description.name!r} has {entry.count} windows of "
                               f"{entry.batch.frames} frames, {count} were asked for. Ask for fewer or shorter ones.")
    return entry.batch


def training_mean(frames: pipeline.Frames, most_frames: int = TRAINING_MEAN_FRAMES) -> tuple[baselines.Frames, int]:
    """The mean training frame over at most `most_frames` evenly spread frames, and how many went in."""
    mean = training_sums(frames, most_frames)
    return mean.prediction(), mean.frames


def training_sums(frames: pipeline.Frames, most_frames: int = TRAINING_MEAN_FRAMES) -> baselines.TrainingMean:
    """The sums behind `training_mean`."""
    mean = baselines.TrainingMean()
    for entry in pipeline.evaluation_batches(frames, "train", windows=most_frames, length=1):
        mean = mean.add(jax.tree.map(np.asarray, entry.batch)[: entry.count])
    return mean


def text(numbers: Mapping[str, float]) -> str:
    """One line for the screen."""
    shown = [f"loss {numbers['total']:.4f}"]
    labels = {"psnr_db": ("observed PSNR", "{:.2f} dB"), "imagined_psnr_db": ("imagined PSNR", "{:.2f} dB"),
              "imagined_chamfer_m": ("Chamfer", "{:.2f} m"), "imagined_iou_occ": ("IoU+", "{:.3f}")}
    shown += [f"{label} {style.format(numbers[name])}" for name, (label, style) in labels.items() if name in numbers]
    return "  ".join(shown)
