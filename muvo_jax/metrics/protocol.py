"""The evaluation protocol: observe the context, imagine the horizon under the recorded actions, score every frame.

Scores are kept per step and averaged, for the model and beside it for the baselines of baselines.py: copy-last and the
moved last frames (of imagined steps only) and the training mean. A frame for which a score is undefined is counted and
left out; what is undefined as a whole is NaN, never 0. BatchNorm runs on its running statistics, but for a comparison
with the authors' figures (evaluation.batch_norm). cards.py has protocols by name.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.metrics import answers, baselines, tally, warp
from muvo_jax.model import rollout, world_model

VERSION = "muvo_jax-2"
PHASES = ("observed", "imagined")
# What is judged, in the order of tables.
SOURCES = ("model", "copy_last", "warp_last", "warp_fused", "training_mean")
_MOTION = {"bicycle": "motion from actions", "none": "motion as recorded"}


class Windows(NamedTuple):
    """What `evaluate` takes at a time.

    Attributes:
      batch: [B, context + horizon, ...], of always the same size; it may be filled up behind the real windows.
      drives: of each real window the name of its drive.
      other_action: float32 [B, context + horizon, 2], of each window the actions of another one, of another drive
        where there is one; None to leave the answer to actions unmeasured.
      scans: of each real window the recorded scans of the steps behind the context, float32 [P, 3] each; None where
        no score asks for them (evaluation.scan_region_m).
    """

    batch: types.Batch
    drives: tuple[str, ...]
    other_action: types.ArrayLike | None = None
    scans: Sequence[Sequence[np.ndarray]] | None = None


Look = Callable[[Windows, Mapping[str, Mapping[str, baselines.Frames]]], None]


def _alone(value: Any) -> list[Any]:
    return [value]


class Share(NamedTuple):
    """Which windows of a split `evaluate` gets, where several processes judge it together.

    Attributes:
      process, processes: every `processes`-th batch, from `process` on.
      gather: what each process has -> what all of them have; called once.
    """

    process: int = 0
    processes: int = 1
    gather: Callable[[Any], list[Any]] = _alone


def identity(config: config_lib.Config) -> str:
    """Names everything that a comparison of two numbers must have in common, apart from the data."""
    data, evaluation = config.data, config.evaluation
    frame_s = data.stride / config.contract.rate_hz
    latents = "sampled" if evaluation.sampled else "mean"
    more = "" if evaluation.batch_norm == "running" else f", BatchNorm on each {evaluation.batch} windows' statistics"
    more += f", Chamfer of {evaluation.pixel_chamfer} random pixels" if evaluation.pixel_chamfer else ""
    more += f", scans inside {list(evaluation.scan_region_m)} m" if evaluation.scan_region_m else ""
    return (f"{VERSION}: context {data.context}, horizon {data.horizon}, {frame_s:g} s a step, Chamfer on "
            f"{evaluation.chamfer_points or 'all'} points, return above {evaluation.return_threshold_m:g} m, "
            f"occupied above {config.model.occupied_above:g}, {latents} latents, "
            f"{_MOTION[config.contract.kinematics]}, seed {evaluation.seed}{more}")


def predict(model: world_model.WorldModel, variables: types.Variables, key: types.Array, batch: types.Batch, *,
            context: int, horizon: int, sampled: bool) -> baselines.Frames:
    """Decoded frames of observed and imagined steps, as the metrics and pictures want them.

    Args:
      key: typed key, for sampled latents.
      batch: windows [B, context + horizon, ...]; later frames are used for their actions alone.
      context: frames that are observed.
      horizon: frames that are imagined.
      sampled: draw the latents; otherwise their means.

    Returns:
      {"image": float32 [B, context + horizon, H, W, 3] in [0, 1], "range_view": float32 [...] in metres, "occupancy":
      bool [B, context + horizon, X, Y, Z]}, for the heads that the model has; of optional heads as types.Batch holds
      what they predict.
    """
    return jax.device_get(_predict(model, variables, key, batch, None, context, horizon, sampled, "running")[0])


@functools.partial(jax.jit, static_argnums=(0, 5, 6, 7, 8))
def _predict(model, variables, key, batch, other_action, context, horizon, sampled, batch_norm):
    """Frames of observed and imagined steps, and of the steps imagined under other actions (None without them)."""
    key_observe, key_imagine = jax.random.split(key)
    seen = batch.time_slice(0, context)
    if batch_norm == "batch":
        observed, _ = rollout.observe_window(_without_dropout(model), variables, seen,
                                             rollout.sample_keys(key_observe, batch.batch_size), train=True,
                                             sampled=sampled)
    else:
        observed = rollout.observe(model, variables, key_observe, seen, sampled=sampled)
    steps = slice(context - 1, context + horizon - 1)
    plans = [batch.action[:, steps]] + ([] if other_action is None else [other_action[:, steps]])
    dream = rollout.imagine(model, variables, key_imagine, observed.last, jnp.stack(plans, axis=1), sampled=sampled,
                            same_noise=True)
    states = jax.tree.map(lambda seen, dreamt: jnp.concatenate([seen, *jnp.unstack(dreamt, axis=1)], axis=1),
                          observed.states, dream.states)
    frames = finish(model.decode(variables, states, shown_heads(model.config), observed.memory), model.config)
    end = context + horizon
    return ({name: value[:, :end] for name, value in frames.items()},
            None if other_action is None else {name: value[:, end:] for name, value in frames.items()})


def _without_dropout(model: world_model.WorldModel) -> world_model.WorldModel:
    """As it trains, but for the dropout of its transformers."""
    fusion = model.config.fusion
    if isinstance(fusion, config_lib.TransformerFusion):
        fusion = dataclasses.replace(fusion, dropout=0.0)
    return world_model.WorldModel(dataclasses.replace(model.config, fusion=fusion))


def shown_heads(config: config_lib.ModelConfig) -> tuple[str, ...]:
    """The heads of a model whose frames are scored and drawn."""
    return tuple(head_lib.shown(config.heads))


def finish(predictions: types.Predictions, model: config_lib.ModelConfig) -> dict[str, types.Array]:
    """Full-scale predictions of shown heads as frames (head.Frames.of): the image clipped to [0, 1], occupancy decided
    as the model says, classes instead of logits."""
    return {name: frames.of(predictions[name], model) for name, frames in head_lib.shown(predictions.heads).items()}


def evaluate(model: world_model.WorldModel | None, variables: types.Variables | None, windows: Iterable[Windows],
             config: config_lib.Config, training_mean: baselines.Frames | None = None, *,
             sources: Collection[str] = SOURCES, look: Look | None = None,
             share: Share = Share()) -> dict[str, Any]:
    """Scores a model and the baselines on the windows of one split.

    Args:
      model, variables: what is judged; None where `sources` lacks "model".
      windows: of the split.
      config: of the run; `data` and `evaluation` say how.
      training_mean: from baselines.TrainingMean.prediction, or None to leave that baseline out.
      sources: which of SOURCES to judge.
      look: called once with the first windows and what all sources make of them, {phase: {source: frames}}.
      share: where `windows` are those of this process alone; the scores are of all.

    Returns:
      JSON-ready {"protocol", "windows", "drives", "observed": {source: scores}, "imagined": {source: scores},
      "action_shuffle": {head: ratio} (answers.py), "copy_last_unknown_voxels", "movers"}; baselines that repeat or move
      the last observed frame have imagined steps only. "movers" says what their scores look at, None for nothing.
    """
    judge = _Judge(config, training_mean, sources, look)
    key = jax.random.key(config.evaluation.seed)
    data, evaluation = config.data, config.evaluation
    dispatched = ((index, item, _predict(model, variables, jax.random.fold_in(key, index), item.batch,
                                         item.other_action, data.context, data.horizon, evaluation.sampled,
                                         evaluation.batch_norm)
                    if "model" in sources else None)
                   for index, item in zip(itertools.count(share.process, share.processes), windows, strict=False))
    for index, item, future in _one_ahead(dispatched):  # the device predicts while the host scores
        judge.add(index, item, jax.device_get(future))
    first, *others = share.gather(judge)
    for other in others:
        first.merge(other)
    return first.report()


class _Judge:
    """Tallies of all sources over one split."""

    def __init__(self, config: config_lib.Config, training_mean: baselines.Frames | None, sources: Collection[str],
                 look: Look | None):
        self._config, self._mean, self._sources, self._look = config, training_mean, sources, look
        self._tallies: dict[str, dict[str, tally.Tally]] = {phase: {} for phase in PHASES}
        self._answers = answers.Answers(config)
        self._windows = self._unknown = 0
        self._drives: set[str] = set()
        self._movers: str | None = None

    def add(self, index: int, item: Windows, predicted: tuple[Mapping[str, np.ndarray], Any] | None) -> None:
        """With one batch and what the model made of it."""
        context, count = self._config.data.context, len(item.drives)
        truth = item.batch[:count]
        steps = {"observed": (0, context), "imagined": (context, context + self._config.data.horizon)}
        moved = self._moved(item.batch, count)
        guesses = self._baselines(truth, count, moved)
        if predicted is not None:
            frames, other = ({name: value[:count] for name, value in (part or {}).items()} for part in predicted)
            for phase, (start, stop) in steps.items():
                guesses[phase] = {"model": {name: value[:, start:stop] for name, value in frames.items()},
                                  **guesses[phase]}
            if other:
                self._answers.add(guesses["imagined"]["model"], other, truth.time_slice(*steps["imagined"]),
                                  item.drives)
        if self._look is not None and index == 0:
            self._look(item, guesses)
        for phase, (start, stop) in steps.items():
            part = truth.time_slice(start, stop)
            movers = self._movers_of(part, moved.get("warp_last", {}) if phase == "imagined" else {})
            scans = item.scans if phase == "imagined" else None
            for source, guess in guesses[phase].items():
                threshold_m = self._config.evaluation.return_threshold_m if source == "model" else 0.0
                self._tallies[phase].setdefault(source, tally.Tally(self._config)).add(
                    guess, part, item.drives, seed=(self._config.evaluation.seed, index, start),
                    threshold_m=threshold_m, movers=movers, scans=scans)
        self._windows += count
        self._drives.update(item.drives)

    def merge(self, other: _Judge) -> None:
        """With what another one has seen."""
        for phase, tallies in other._tallies.items():
            for source, one in tallies.items():
                self._tallies[phase].setdefault(source, tally.Tally(self._config)).merge(one)
        self._answers.merge(other._answers)
        self._windows += other._windows
        self._unknown += other._unknown
        self._drives |= other._drives
        self._movers = self._movers or other._movers

    def report(self) -> dict[str, Any]:
        """See `evaluate`."""
        scores = {phase: {source: one.scores() for source, one in tallies.items()}
                  for phase, tallies in self._tallies.items()}
        return {"protocol": identity(self._config), "windows": self._windows, "drives": len(self._drives),
                "copy_last_unknown_voxels": self._unknown, "movers": self._movers, **scores,
                "action_shuffle": self._answers.ratios()}

    def _movers_of(self, truth: types.Batch, moved: baselines.Frames) -> np.ndarray | None:
        """Which voxels count as movers': the recording's labels, else where the moved last frame is wrong."""
        if truth.occupancy_moving_mask is not None:
            self._movers = "road users on the move"
            return np.asarray(truth.occupancy_moving_mask)
        if truth.occupancy is None or "occupancy" not in moved:
            return None
        self._movers = "voxels that warp-last gets wrong"
        return moved["occupancy"] != (np.asarray(truth.occupancy) == types.OCCUPANCY_OCCUPIED)

    def _moved(self, batch: types.Batch, count: int) -> dict[str, baselines.Frames]:
        """The moved frames of the real windows, as far as the motion is known and they are asked for."""
        data, config = self._config.data, self._config
        if warp.motion_source(batch, config) is None:
            return {}
        labelled = batch.occupancy is None or batch.occupancy_moving_mask is not None
        wanted = [source for source in ("warp_last", "warp_fused")
                  if source in self._sources or (source == "warp_last" and not labelled)]
        return {source: {name: value[:count] for name, value in warp.warp(
            batch, data.context, data.horizon, config, fused=source == "warp_fused").items()} for source in wanted}

    def _baselines(self, truth: types.Batch, count: int,
                   moved: Mapping[str, baselines.Frames]) -> dict[str, dict[str, baselines.Frames]]:
        """Phase -> source -> frames [B, steps, ...]."""
        data = self._config.data
        guesses: dict[str, dict[str, baselines.Frames]] = {phase: {} for phase in PHASES}
        if "copy_last" in self._sources:
            guesses["imagined"]["copy_last"], unknown = baselines.copy_last(truth, data.context, data.horizon)
            self._unknown += unknown
        guesses["imagined"] |= {source: frames for source, frames in moved.items() if source in self._sources}
        if "training_mean" in self._sources and self._mean:
            guesses["observed"]["training_mean"] = _repeat(self._mean, count, data.context)
            guesses["imagined"]["training_mean"] = _repeat(self._mean, count, data.horizon)
        return guesses


def _one_ahead(items: Iterable[Any]) -> Iterator[Any]:
    """The same items, each handed out after the next one was asked for."""
    iterator = iter(items)
    for held in iterator:
        for following in iterator:
            yield held
            held = following
        yield held


def _repeat(mean: baselines.Frames, count: int, steps: int) -> baselines.Frames:
    return {name: np.broadcast_to(value[None, None], (count, steps, *value.shape)) for name, value in mean.items()}
