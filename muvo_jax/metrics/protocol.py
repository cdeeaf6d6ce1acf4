"""The evaluation protocol: observe the context, imagine the horizon under the recorded actions, score every frame.

Scores are kept per step and averaged, for the model and beside it for two baselines: copy-last (the last observed
frame, of imagined steps only) and training mean. A frame for which a score is undefined is counted and left out; what
is undefined as a whole is NaN, never 0. BatchNorm runs on its running statistics.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.metrics import baselines, image, maps, occupancy, points, streaming
from muvo_jax.model import rollout, world_model

VERSION = "muvo_jax-1"
PHASES = ("observed", "imagined")
HEADS = ("image", "range_view", "occupancy")


def identity(config: config_lib.Config) -> str:
    """Names everything that a comparison of two numbers must have in common, apart from the data."""
    data, evaluation = config.data, config.evaluation
    frame_s = data.stride / config.contract.rate_hz
    latents = "sampled" if evaluation.sampled else "mean"
    return (f"{VERSION}: context {data.context}, horizon {data.horizon}, {frame_s:g} s a step, Chamfer on "
            f"{evaluation.chamfer_points or 'all'} points, return above {evaluation.return_threshold_m:g} m, {latents} "
            f"latents, seed {evaluation.seed}")


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
      bool [B, context + horizon, X, Y, Z]}, for the heads that the model has; of optional heads see maps.finish.
    """
    return jax.device_get(_predict(model, variables, key, batch, context, horizon, sampled))


@functools.partial(jax.jit, static_argnums=(0, 4, 5, 6))
def _predict(model, variables, key, batch, context, horizon, sampled):
    key_observe, key_imagine = jax.random.split(key)
    observed = rollout.observe(model, variables, key_observe, batch.time_slice(0, context), sampled=sampled)
    actions = batch.action[:, context - 1 : context + horizon - 1]
    dream = rollout.imagine(model, variables, key_imagine, observed.last, actions, sampled=sampled)
    states = jax.tree.map(lambda *parts: jax.numpy.concatenate(parts, axis=1), observed.states, dream.states)
    heads = shown_heads(model.config)
    return finish(model.decode(variables, states, heads, observed.memory))


def shown_heads(config: config_lib.ModelConfig) -> tuple[str, ...]:
    """The heads of a model whose frames are scored and drawn."""
    return tuple(head for head in (*HEADS, *maps.FIELDS) if head in config.heads)


def finish(predictions: types.Predictions) -> dict[str, types.Array]:
    """Full-scale predictions as frames: the image clipped to [0, 1], occupancy decided at probability 0.5.

    What optional heads draw stands under the names of types.Batch (maps.finish).
    """
    frames = {head: predictions[head] for head in predictions if head not in maps.FIELDS}
    frames |= maps.finish({head: predictions[head] for head in predictions if head in maps.FIELDS})
    if "image" in frames:
        frames["image"] = jax.numpy.clip(frames["image"], 0.0, 1.0)
    if "occupancy" in frames:
        frames["occupancy"] = occupancy.predicted_occupied(frames["occupancy"])
    return frames


class Tally:
    """Running scores of one source of predictions over the steps of one phase."""

    def __init__(self, steps: int, evaluation: config_lib.EvaluationConfig):
        self._evaluation = evaluation
        self._means = {name: streaming.StreamingMean.zeros(steps) for name in (
            "psnr_db", "chamfer_m", *(score for _, score in maps.FIELDS.values()))}
        self._occupancy = occupancy.OccupancyScores.zeros(steps)
        self._seen: set[str] = set()

    def add(self, prediction: Mapping[str, np.ndarray], truth: types.Batch, seed: tuple[int, ...],
            threshold_m: float) -> None:
        """Scores frames [B, steps, ...] against the recorded ones; a modality that either lacks is not scored."""
        present = [head for head in HEADS if head in prediction and getattr(truth, head) is not None]
        self._seen.update(present)
        if "image" in present and truth.image is not None:
            values = np.asarray(image.frame_psnr_db(prediction["image"], truth.image))
            self._means["psnr_db"] = self._means["psnr_db"].add(values)
        if "range_view" in present and truth.range_view is not None:
            distances = points.frame_chamfer_m(prediction["range_view"], truth.range_view, seed=seed,
                                               return_threshold_m=threshold_m, points=self._evaluation.chamfer_points)
            self._means["chamfer_m"] = self._means["chamfer_m"].add(distances)
        if "occupancy" in present:
            self._occupancy = self._occupancy.add(prediction["occupancy"], np.asarray(truth.occupancy))
        for head, (field, score) in maps.FIELDS.items():
            if field in prediction and getattr(truth, field) is not None:
                values = maps.frame_scores(head, np.asarray(prediction[field]), np.asarray(getattr(truth, field)))
                self._means[score] = self._means[score].add(values)
                self._seen.add(head)

    def scores(self) -> dict[str, dict[str, Any]]:
        """{metric: {"mean", "per_step", "frames", "undefined"}}; NaN where nothing was defined."""
        result: dict[str, dict[str, Any]] = {}
        optional = tuple((score, head) for head, (_, score) in maps.FIELDS.items())
        for name, head in (("psnr_db", "image"), ("chamfer_m", "range_view"), *optional):
            if head in self._seen:
                mean = self._means[name]
                result[name] = {"mean": mean.overall(), "per_step": mean.per_step().tolist(),
                                "frames": int(mean.count.sum()), "undefined": int(mean.undefined.sum())}
        if "occupancy" in self._seen:
            overall = self._occupancy.overall()
            for name, values in self._occupancy.per_step().items():
                result[name] = {"mean": overall[name], "per_step": values.tolist()}
        return result


def evaluate(model: world_model.WorldModel, variables: types.Variables, batches: Iterable[tuple[types.Batch, int]],
             config: config_lib.Config, training_mean: baselines.Frames | None = None) -> dict[str, Any]:
    """Scores a model and the baselines on the windows of one split.

    Args:
      model, variables: what is judged.
      batches: (windows [B, context + horizon, ...], how many of them are real; the rest fills the batch).
      config: of the run; `data` and `evaluation` say how.
      training_mean: from baselines.TrainingMean.prediction, or None to leave that baseline out.

    Returns:
      JSON-ready {"protocol", "windows", "observed": {source: scores}, "imagined": {source: scores},
      "copy_last_unknown_voxels"} with sources "model", "copy_last" (imagined steps only) and "training_mean".
    """
    data, evaluation = config.data, config.evaluation
    spans = {"observed": (0, data.context), "imagined": (data.context, data.context + data.horizon)}
    sources = {phase: ["model"] + (["copy_last"] if phase == "imagined" else [])
               + (["training_mean"] if training_mean else []) for phase in PHASES}
    tallies = {(phase, source): Tally(stop - start, evaluation)
               for phase, (start, stop) in spans.items() for source in sources[phase]}
    windows = unknown = 0
    key = jax.random.key(evaluation.seed)
    dispatched = ((index, batch, count, _predict(model, variables, jax.random.fold_in(key, index), batch, data.context,
                                                 data.horizon, evaluation.sampled))
                  for index, (batch, count) in enumerate(batches))
    for index, batch, count, future in _one_ahead(dispatched):  # the device predicts while the host scores
        frames, truth = jax.device_get(future), batch[:count]
        copied, copied_unknown = baselines.copy_last(truth, data.context, data.horizon)
        unknown += copied_unknown
        windows += count
        for (phase, source), tally in tallies.items():
            start, stop = spans[phase]
            if source == "model":
                guess, threshold_m = {name: value[:count, start:stop] for name, value in frames.items()}, \
                    evaluation.return_threshold_m
            elif source == "copy_last":
                guess, threshold_m = copied, 0.0
            else:
                guess, threshold_m = _repeat(training_mean or {}, count, stop - start), 0.0
            tally.add(guess, truth.time_slice(start, stop), (evaluation.seed, index, start), threshold_m)
    result: dict[str, Any] = {"protocol": identity(config), "windows": windows, "copy_last_unknown_voxels": unknown}
    for phase in PHASES:
        result[phase] = {source: tallies[phase, source].scores() for source in sources[phase]}
    return result


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
