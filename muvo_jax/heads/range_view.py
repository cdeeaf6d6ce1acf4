"""The lidar's scan as a picture of ranges and points (paper section III-D)."""

from __future__ import annotations

import numpy as np

from muvo_jax import head, types
from muvo_jax.config import LossConfig, ModelConfig, VoxelGrid
from muvo_jax.metrics import baselines, occupancy, points, streaming
from muvo_jax.model import decoders, outputs
from muvo_jax.objectives import chamfer, labels, regression


def _finish(value: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """In metres."""
    if config.range_view_points == "beams":
        value = outputs.along_beams(value, scale, config)
    return value * config.range_scale_m


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    model, loss, range_view = learned.model, learned.loss, learned.truth("range_view")
    sums: dict[str, head.Sums] = {}
    for scale, target in labels.range_view_labels(range_view).items():
        sums[f"range_xyz_{scale}"], sums[f"range_depth_{scale}"] = regression.range_view_sums(
            learned.predictions[scale], target, scale_m=model.range_scale_m, mask_holes=model.numerics == "standard")
    if loss.chamfer:
        sums["chamfer_1"] = chamfer.chamfer_sums(
            learned.predictions[1], range_view, learned.keys, points=loss.chamfer_points, scale_m=model.range_scale_m,
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
    return {"all": streaming.mean_sums(distances(-np.inf)),
            "above": streaming.mean_sums(distances(occupancy.ABOVE_ROAD_M))}


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
                            side_px=columns_px, height_span_m=panels.height_span(scene.grid))


HEAD = head.Head(
    targets=lambda model: {"range_view": (model.range_view.rows, model.range_view.columns, 4)},
    build=lambda model: decoders.of_range_view(model, 4), scales=head.SCALES, tokens="range_view", finish=_finish,
    initial_bias=0.0, losses=_losses, weights=_weights, average=_average,
    frames=head.Frames(
        field="range_view", of=lambda value, model: value, sums=_sums, error=_error, error_name="range",
        metrics={"chamfer_m": head.Metric("all", streaming.mean, "Chamfer", "m", 3, higher=False, on_screen=True,
                                          by_step=True, logged="imagined_chamfer_m", error=lambda metres: metres),
                 "chamfer_above_m": head.Metric("above", streaming.mean, "Chamfer above the road", "m", 3,
                                                higher=False, on_screen=True)},
        pictures=(head.Picture("range", _draw_ranges, legend=("range",)),
                  head.Picture("points", _draw_points, "above", ("height",)))))
