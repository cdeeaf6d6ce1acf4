"""What a run looks at now and then: the loss, what it imagines beside baselines, on windows of the splits held out."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import recordings, types
from muvo_jax import run as run_lib
from muvo_jax.data import fitting, pipeline, schema
from muvo_jax.metrics import baselines, protocol, skill
from muvo_jax.model import world_model
from muvo_jax.objectives import perceptual
from muvo_jax.training import checkpoint, together
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

TRAINING_MEAN_FRAMES = 512


class Validator:
    """Validates on the first device; its functions are compiled once and shared with the final evaluation.

    Several processes share the windows, batch by batch, and all of them get the numbers of all.
    """

    def __init__(self, model: world_model.WorldModel, config: config_lib.Config, frames: pipeline.Frames,
                 frozen: perceptual.FrozenEncoder | None = None):
        self.model, self.config, self.frames = model, config, frames
        self.splits = tuple(split for split in frames.recording.description.splits if split != "train")
        self._device = jax.local_devices()[0]
        self._share = protocol.Share(jax.process_index(), jax.process_count(), together.gather)
        self._losses = step_lib.make_validation_step(model, config, batch_size=config.evaluation.batch,
                                                     devices=[self._device], frozen=frozen)
        self._baselines: dict[str, dict[str, Any]] = {}

    def run(self, state: state_lib.TrainState, split: str) -> dict[str, float]:
        """Numbers for the log (NaN where undefined).

        Loss terms and observed PSNR over whole windows; scores of imagined frames, "imagined_*", and of the baselines
        beside them, "copy_last_*" and so on; "action_shuffle_*" of each head (metrics/answers.py); "skill" of the
        imagined frames (metrics/skill.py).
        """
        state = parallel_lib.on_device(state, self._device)
        batches = list(windows(self.frames, split, self.config.train.validation_windows, self._share))
        # A window that fills a batch counts twice here: this is a monitor, not the report.
        losses = [{name: float(value) for name, value in self._losses(state, item.batch).items()} for item in batches]
        losses = list(itertools.chain.from_iterable(self._share.gather(losses)))
        sums = {name: sum(one[name] for one in losses) / len(losses) for name in losses[0]}
        judge = functools.partial(protocol.evaluate, windows=batches, config=self.config, share=self._share)
        report = judge(self.model, state.variables, sources=("model",))
        if split not in self._baselines:  # which see the same windows every time
            others = [source for source in protocol.SOURCES if source != "model"]
            self._baselines[split] = judge(None, None, sources=others)["imagined"]
        imagined = report["imagined"] | self._baselines[split]
        for source, scores in imagined.items():
            for name, metric in logged().items():
                if name in scores:
                    sums[metric.logged if source == "model" else f"{source}_{name}"] = scores[name]["mean"]
        answers = {f"action_shuffle_{head}": ratio["mean"] for head, ratio in report["action_shuffle"].items()}
        return sums | answers | {"skill": skill.skill(imagined)}

    def example(self, split: str, variables: types.Variables) -> tuple[types.Batch, baselines.Frames]:
        """The first windows of a split, always the same, and what the model makes of them (protocol.predict)."""
        batch = next(windows(self.frames, split, self.config.evaluation.batch)).batch
        data, evaluation = self.config.data, self.config.evaluation
        variables = parallel_lib.on_device(variables, self._device)
        frames = protocol.predict(self.model, variables, jax.random.key(evaluation.seed), batch, context=data.context,
                                  horizon=data.horizon, sampled=evaluation.sampled)
        return batch, frames


def windows(frames: pipeline.Frames, split: str, count: int,
            share: protocol.Share = protocol.Share()) -> Iterator[protocol.Windows]:
    """At most `count` windows of a split (0: all) as `protocol.evaluate` takes them; of these a process's share.

    Raises:
      DataError: where scores of scans are asked for and the recording lacks what they read.
    """
    wants_scans, description = bool(frames.config.evaluation.scan_region_m), frames.recording.description
    if wants_scans and (lacking := {"points_m", "pose", "speed_mps"} - description.modalities):
        raise schema.DataError(f"evaluation.scan_region_m asks for scores along the rays of scans, but recording "
                               f"{description.name!r} has no {', '.join(sorted(lacking))}. Judge without them.")
    for entry in pipeline.evaluation_batches(frames, split, windows=count, process=share.process,
                                             processes=share.processes):
        drives = tuple(window.sequence.name for window in entry.windows)
        scans = [frames.scans(window, frames.config.data.context) for window in entry.windows] if wants_scans else None
        yield protocol.Windows(entry.batch, drives, frames.actions(entry.others) if entry.others else None, scans)


def windows_of_run(run: run_lib.Run | str | os.PathLike, split: str | None = None, *, count: int,
                   frames: int | None = None) -> types.Batch:
    """See muvo_jax.windows."""
    whole = lambda given: isinstance(given, int | np.integer) and not isinstance(given, bool) and given >= 1
    if not whole(count) or not (frames is None or whole(frames)):
        raise ValueError(f"windows: count is {count!r}, frames is {frames!r}; expected whole numbers of 1 or more, or "
                         f"no frames for context + horizon.")
    config = (run if isinstance(run, run_lib.Run) else checkpoint.load_run(run)).config
    recording = recordings.open_configured(config, split=split or recordings.HELD_OUT)
    held_out = [name for name in recording.description.splits if name != "train"]
    split = split or (held_out or ["train"])[0]
    fitted = fitting.adapt(config, recording, keep=fitting.OF_TRAINED).config
    source, length = pipeline.Frames(recording, fitted), frames or fitted.data.context + fitted.data.horizon
    found = len(pipeline.evaluation_windows(source, split, windows=count, length=length))
    if found < count:
        raise schema.DataError(f"split {split!r} of {recording.description.name!r} has {found} windows of {length} "
                               f"frames, {count} were asked for. Ask for fewer or shorter ones.")
    return next(pipeline.evaluation_batches(source, split, windows=count, length=length, batch=count)).batch


def sample_scores(run: run_lib.Run, count: int) -> dict[str, float]:
    """What a run scores on a few windows of the first split held out, {metric: its mean over imagined steps}: what a
    model that ships says of itself in its card, so that anybody can recompute it in a minute."""
    recording = recordings.open_configured(run.config, split=recordings.HELD_OUT)
    config = fitting.adapt(run.config, recording, keep=fitting.OF_TRAINED).config
    found = protocol.evaluate(run.model, run.variables, windows(pipeline.Frames(recording, config), recordings.HELD_OUT,
                                                                count), config, sources=("model",))
    return {name: score["mean"] for name, score in found["imagined"]["model"].items() if head_lib.metrics()[name].label}


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


def logged() -> dict[str, head_lib.Metric]:
    """The scores of imagined frames that are logged, by the names that protocol.evaluate gives them."""
    return {name: metric for name, metric in head_lib.metrics().items() if metric.logged}


def text(numbers: Mapping[str, float]) -> str:
    """One line for the screen: the model, behind it in brackets the baseline that the skill refers to."""
    shown = [f"loss {numbers['total']:.4f}"]
    if "psnr_db" in numbers:
        shown.append(f"observed PSNR {numbers['psnr_db']:.2f} dB")
    reference = next((source for source in skill.REFERENCES if any(name.startswith(source) for name in numbers)), "")
    imagined = "imagined "
    for name, metric in logged().items():
        if metric.logged in numbers:
            form = lambda value, metric=metric: f"{value:.{max(2, metric.decimals - 1)}f} {metric.unit}".rstrip()
            beside = numbers.get(f"{reference}_{name}")
            shown.append(f"{imagined}{metric.label} {form(numbers[metric.logged])}"
                         + (f" ({reference.replace('_', '-')} {form(beside)})" if beside is not None else ""))
            imagined = ""
    ratios = [f"{numbers[name]:.2f}" for head in head_lib.shown() if (name := f"action_shuffle_{head}") in numbers]
    shown += [f"action shuffle {' / '.join(ratios)}"] if ratios else []
    return "  ".join([*shown, f"skill {numbers['skill']:+.3f}"] if "skill" in numbers else shown)
