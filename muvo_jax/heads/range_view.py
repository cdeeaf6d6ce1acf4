"""The lidar's scan as a picture of ranges and points (paper section III-D)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import head, types
from muvo_jax.config import LastSeen, LossConfig, ModelConfig, VoxelGrid, as_kind
from muvo_jax.metrics import baselines, occupancy, points, scans, streaming
from muvo_jax.model import decoders, glimpse, tokens
from muvo_jax.objectives import chamfer, labels, regression
from muvo_jax.ops import range_view, reproject

_NEAR_M = 10.0  # ranges are seen as 10 m / (10 m + range) too: near ones matter


def along_beams(raw: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """Raw range view [N, Hr/scale, Wr/scale, 4] (units of range_scale_m): x, y, z become differences from the beam.

    With range_view_points="beams" the three coordinates of a pixel are drawn as the difference from the point at the
    predicted range along its beam: geometry that is known need not be learned.
    """
    geometry = config.range_view
    beams = range_view.beam_directions(geometry)[::scale, ::scale]
    position = np.asarray(geometry.position_m, np.float32) / np.float32(config.range_scale_m)
    ranges = raw[..., 3:]
    points = raw[..., :3] + jnp.asarray(beams)[None] * ranges + jnp.asarray(position).reshape(1, 1, 1, 3)
    return jnp.concatenate([points, ranges], axis=-1)


def _apart(view: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """How far the points of a range view [..., Hr/scale, Wr/scale, 4] lie from their pixels' beams [..., 3], m."""
    return view[..., :3] - reproject.beam_points(view[..., 3], config.range_view, scale)


def _finish(value: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """In metres."""
    if config.range_view_points == "beams":
        value = along_beams(value, scale, config)
    return value * config.range_scale_m


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    model, loss, truth = learned.model, learned.loss, learned.truth("range_view")
    beams, sums = model.range_view_points == "beams", dict[str, head.Sums]()
    for scale, target in labels.range_view_labels(truth).items():
        prediction = learned.predictions[scale]
        if beams:
            # The L2 of points would learn the range too, as a mean: between the two sides of an edge, where nothing is.
            prediction, target = (jnp.concatenate([_apart(view, scale, model), view[..., 3:]], axis=-1)
                                  for view in (prediction, target))
        sums[f"range_xyz_{scale}"], sums[f"range_depth_{scale}"] = regression.range_view_sums(
            prediction, target, scale_m=model.range_scale_m, mask_holes=model.numerics == "standard")
    if loss.chamfer:
        prediction = learned.predictions[1]
        if beams:  # and a neighbour that is nearer must not pull a point off its beam
            apart = _apart(prediction, 1, model)
            points = prediction[..., :3] - apart + jax.lax.stop_gradient(apart)
            prediction = jnp.concatenate([points, prediction[..., 3:]], axis=-1)
        sums["chamfer_1"] = chamfer.chamfer_sums(
            prediction, truth, learned.keys, points=loss.chamfer_points, scale_m=model.range_scale_m,
            return_threshold_m=loss.return_threshold_m)
    return sums


def _weights(loss: LossConfig) -> dict[str, float]:
    return head.scaled(loss, "range_xyz", "range_depth") | {"chamfer_1": loss.chamfer}


def _average(mean: baselines.TrainingMean, config: ModelConfig) -> dict[int, types.Array]:
    """The mean range of the pixels that return in more than half of the frames, a hole elsewhere."""
    view = mean.prediction()["range_view"] / np.float32(config.range_scale_m)
    if config.range_view_points == "beams":
        view[..., :3] = 0.0
    return labels.range_view_labels(view)


def _sums(judged: head.Judged) -> dict[str, streaming.Sums]:
    distances = lambda above_m: points.frame_chamfer_m(
        judged.frames, np.asarray(judged.truth.range_view), seed=judged.seed, return_threshold_m=judged.threshold_m,
        points=judged.config.evaluation.chamfer_points, above_m=above_m)
    scores = {"all": distances(-np.inf), "above": distances(occupancy.ABOVE_ROAD_M)}
    evaluation = judged.config.evaluation
    if evaluation.pixel_chamfer:
        scores["pixels"] = points.pixel_chamfer_m(judged.frames, np.asarray(judged.truth.range_view),
                                                  pixels=evaluation.pixel_chamfer, seed=judged.seed)
    if judged.scans is not None:
        scores |= scans.frame_scores(judged.frames, judged.scans, np.asarray(judged.truth.ego_motion),
                                     geometry=judged.config.model.range_view, evaluation=evaluation,
                                     threshold_m=judged.threshold_m)
    return {name: streaming.mean_sums(values) for name, values in scores.items()}


def _error(frames: np.ndarray, truth: types.Batch, grid: VoxelGrid) -> np.ndarray:
    """The absolute errors of the range where the recording has a return, m."""
    del grid
    target = np.asarray(truth.range_view)[..., 3]
    return np.where(target > 0.0, np.abs(frames[..., 3] - target), 0.0).sum(axis=(2, 3), dtype=np.float64)


def _draw_ranges(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import canvas, panels  # with Pillow, which imagining does not need
    return canvas.resize_hard(panels.range_image(frame, far_m=scene.far_m, threshold_m=scene.threshold_m), columns_px)


def _draw_points(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import panels
    return panels.birds_eye(points.range_view_points(frame, scene.threshold_m), extent_m=scene.extent_m,
                            side_px=columns_px, height_span_m=panels.height_span(scene.grid), ego_m=scene.ego_m)


def _nearness(range_m: types.Array) -> types.Array:
    return jnp.where(range_m > 0.0, _NEAR_M / (_NEAR_M + jnp.maximum(range_m, 0.0)), 0.0)


def _see(seen: glimpse.RangeGlimpse, config: ModelConfig) -> types.Array:
    scale_m = config.range_scale_m
    given = [seen.filled_m, seen.newest_m, seen.still_m]
    channels = [*map(_nearness, given), *(jnp.maximum(value, 0.0) / scale_m for value in (given[0], given[2])),
                *((value > 0.0).astype(jnp.float32) for value in (seen.moved_m, *given)), seen.sky,
                seen.height_m / 5.0]
    return jnp.stack(channels, axis=-1)


def _compose(raw, seen: glimpse.RangeGlimpse, mean, config: ModelConfig) -> dict[int, types.Array]:
    """x, y, z and range in units of range_scale_m; the range is -1 m where nothing is expected to return."""
    average = mean({scale: jnp.zeros_like(value[..., :4]) for scale, value in raw.items()})
    nothing, result = types.RANGE_NO_RETURN_M / config.range_scale_m, {}
    for scale, value in raw.items():
        moved, filled, sky = (array[:, ::scale, ::scale] for array in (seen.moved_m, seen.filled_m, seen.sky))
        usual = average[scale][..., 3]
        range_ = jnp.where(filled > 0.0, filled / config.range_scale_m, jnp.maximum(usual, 0.0)) + value[..., 3]
        prior = jnp.where(moved > 0.0, 2.0, jnp.where(filled > 0.0, 1.0, jnp.where(usual > 0.0, 0.5, -1.0)))
        logit = value[..., 4] + jnp.where(sky > 0.0, -2.0, prior)
        soft = jax.nn.sigmoid(logit)
        # Decided, because half a range is no range; the gradient is that of the probability.
        returned = jax.lax.stop_gradient((logit > 0.0).astype(jnp.float32) - soft) + soft
        expected = nothing + returned * (range_ - nothing)
        points = average[scale][..., :3]  # with range_view_points="beams" they are differences from the beam already
        if config.range_view_points == "free":
            on_beam = along_beams(jnp.concatenate([jnp.zeros_like(points), jnp.expand_dims(range_, -1)], -1), scale,
                                  config)
            points = jnp.where(jnp.expand_dims(filled > 0.0, -1), on_beam[..., :3], points)
        points = value[..., :3] + points + seen.off_beam_m[:, ::scale, ::scale] / config.range_scale_m
        result[scale] = jnp.concatenate([points, jnp.expand_dims(expected, -1)], axis=-1)
    return result


HEAD = head.Head(
    targets=lambda model: {"range_view": (model.range_view.rows, model.range_view.columns, 4)},
    build=lambda model: decoders.of_range_view(model, 4), scales=head.SCALES, tokens="range_view", finish=_finish,
    initial_bias=0.0, losses=_losses, weights=_weights, average=_average,
    guide=head.Guide(view="range_view", plane=lambda model: (model.range_view.rows, model.range_view.columns),
                     width=lambda model: as_kind(model.first_guess, LastSeen).widths["range_view"],
                     channels=lambda model, scale: 5, shrink=tokens.RANGE_VIEW_SHRINK, see=_see, compose=_compose),
    frames=head.Frames(
        field="range_view", of=lambda value, model: value, sums=_sums, error=_error, error_name="range",
        metrics={"chamfer_m": head.Metric("all", streaming.mean, "Chamfer", "m", 3, higher=False, on_screen=True,
                                          by_step=True, logged="imagined_chamfer_m", error=lambda metres: metres),
                 "chamfer_above_m": head.Metric("above", streaming.mean, "Chamfer above the road", "m", 3,
                                                higher=False, on_screen=True),
                 "chamfer_pixels_m": head.Metric("pixels", streaming.mean, "Chamfer of random pixels", "m", 3,
                                                 higher=False, on_screen=True, by_step=True),
                 "scan_chamfer_near_m2": head.Metric("near_m2", streaming.mean, "near-field Chamfer of scans", "m^2",
                                                     3, higher=False, on_screen=True, by_step=True),
                 "scan_l1_m": head.Metric("l1_m", streaming.mean, "L1 along rays", "m", 3, higher=False,
                                          on_screen=True, by_step=True),
                 "scan_absrel_percent": head.Metric("absrel_percent", streaming.mean, "AbsRel along rays", "%", 2,
                                                    higher=False, on_screen=True, by_step=True)},
        pictures=(head.Picture("range", _draw_ranges, legend=("range",)),
                  head.Picture("points", _draw_points, "above", ("height",)))))
