"""Golden files p5_losses_all: every loss term of the reference at once, on given predictions.

Among them are the terms of heads that the released models lack. The two code lines differ in three things: the 2D one
trains occupancy by its geometric affinity alone, weighs structural similarity half as much, and has a perceptual term.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.interop import reference_preprocess as preprocess
from muvo_jax.interop.parity import cases, losses, raw_batch
from muvo_jax.objectives import instances, kl, perceptual, regression, scal, similarity

Checks = Iterator[cases.Check]
Terms = Iterator[tuple[str, Any]]
TOLERANCE = 1e-4
_KL_WEIGHT, _KL_BALANCE = 1e-3, 0.75
_MAP_WEIGHT = 0.1  # of every term of a map, divided by the scale
_INSTANCE_WEIGHT, _CENTRE_WEIGHT, _OFFSET_WEIGHT = 0.5, 200.0, 0.1
_SIMILARITY_WEIGHT = {"1d": 0.6, "2d": 0.3}
# Cross-entropies: weights of the classes, and the share of each frame's pixels, the worst ones, that counts.
_BIRDVIEW: dict[str, Any] = {"weights": losses.SEGMENTATION_WEIGHTS, "top_share": 0.25}
_LIDAR_CLASSES: dict[str, Any] = {"weights": losses.VOXEL_WEIGHTS, "top_share": 0.5}
_IMAGE_CLASSES: dict[str, Any] = {"weights": losses.VOXEL_WEIGHTS}
# Prediction -> channels, the label that has its size at each scale, kind.
_OUTPUTS = {
    "rgb": (3, "rgb_label", "smooth"), "lidar_reconstruction": (4, "range_view_label", "smooth_pm1"),
    "lidar_segmentation": (9, "range_view_label", "smooth_pm1"), "semantic_image": (9, "rgb_label", "smooth_pm1"),
    "depth": (1, "rgb_label", "smooth"), "bev_segmentation": (8, "birdview_label", "smooth_pm1"),
    "bev_instance_offset": (2, "birdview_label", "smooth_pm1"),
    "bev_instance_center": (1, "birdview_label", "smooth"), "voxel": (2, "voxel_label", "smooth_pm1")}


def all_losses(context: cases.Context) -> Checks:
    line = "2d" if context.file.path.stem.endswith("2d") else "1d"
    labels = _labels(context)
    for name, value in _latent_and_action(context, labels["action"]):
        yield cases.Check(f"loss/{name}", value, TOLERANCE)
    for scale in preprocess.SCALES:
        for name, value in _maps(context, labels, scale, line):
            yield cases.Check(f"loss/{name}_{scale}", value, TOLERANCE)


def _labels(context: cases.Context) -> dict[str, np.ndarray]:
    count = context.size("p5", "losses_all_sequence")
    raw = raw_batch.draw_raw(context, count, context.size("p4", "imagine"))
    draw, frames = context.draw, (1, count, 1)
    image_size, cells = context.size("p4", "image_hw"), context.size("p5", "birdview_hw")
    optional = preprocess.optional_labels({
        "birdview": draw("pre_bev", (*frames, *cells), "labels8"),
        "instance": draw("pre_inst", (*frames, *cells), "instance4"),
        "depth": draw("pre_depth", (*frames, *image_size), "smooth"),
        "image_instance_mask": draw("pre_imask", (*frames, *image_size), "mask"),
        "semantic_image": draw("pre_sem", (*frames, *image_size), "labels9"),
        "range_view_pcd_seg": draw("pre_rvs", (*frames, *raw_batch.range_size(context)), "labels9")})
    return preprocess.network_inputs(raw) | optional | {"action": raw["action"][:, :count]}


def _latent_and_action(context: cases.Context, action: np.ndarray) -> Terms:
    frames = action.shape[:2]
    shape = (*frames, config_lib.VectorLatent().stochastic_channels)
    posterior, prior = (types.Gaussian(*(jnp.asarray(context.draw(f"o_{side}_{moment}", shape, kind))
                                         for moment, kind in (("mu", "normal"), ("sigma", "sigma"))))
                        for side in ("posterior", "prior"))
    divergence = kl.balanced_kl_sums(posterior, prior, balance=_KL_BALANCE, numerics="reference")
    yield "probabilistic", _KL_WEIGHT * divergence.value()
    for column, (name, drawn) in enumerate((("throttle_brake", "o_tb"), ("steering", "o_st"))):
        driven = jnp.asarray(context.draw(drawn, (*frames, 1), "pm1"))
        yield name, regression.l1_sums(driven, jnp.asarray(action[..., column:column + 1])).value()


def _maps(context: cases.Context, labels: dict[str, np.ndarray], scale: int, line: str) -> Terms:
    """The terms of one scale, weighted."""
    weight = _MAP_WEIGHT / scale

    def output(name: str) -> np.ndarray:
        channels, label, kind = _OUTPUTS[name]
        batch, frames, _, *size = labels[f"{label}_{scale}"].shape
        return context.draw(f"o_{name}_{scale}", (batch, frames, channels, *size), kind)

    rgb, target = output("rgb"), labels[f"rgb_label_{scale}"]
    of_instances = regression.l1_sums(_last(rgb), _last(target), _true(labels[f"image_instance_mask_{scale}"]))
    everywhere = regression.l1_sums(_last(rgb), _last(target))
    yield "rgb", weight * (everywhere.value() + _INSTANCE_WEIGHT * of_instances.value())
    dissimilarity = jax.jit(similarity.dissimilarity_sums)(_last(rgb), _last(target))
    yield "ssim", weight * _SIMILARITY_WEIGHT[line] * dissimilarity.value()
    if line == "2d":
        yield "perceptual", weight * _perceptual(rgb, target)
    view, returns = _last(output("lidar_reconstruction")), _last(labels[f"range_view_label_{scale}"])
    yield "lidar_re", weight * regression.l2_sums(view[..., :3], returns[..., :3]).value()
    yield "lidar_depth", weight * regression.l1_sums(view[..., 3:], returns[..., 3:]).value()
    for name, drawn, label, options in (
            ("lidar_seg", "lidar_segmentation", "range_view_seg_label", _LIDAR_CLASSES),
            ("semantic_image", "semantic_image", "semantic_image_label", _IMAGE_CLASSES),
            ("bev_segmentation", "bev_segmentation", "birdview_label", _BIRDVIEW)):
        logits, classes = jnp.asarray(output(drawn)), jnp.asarray(labels[f"{label}_{scale}"])
        yield name, weight * losses.cross_entropy(logits, classes, **options)
    yield "depth", weight * regression.l1_sums(_last(output("depth")), _last(labels[f"depth_label_{scale}"])).value()
    yield from _instances(output, labels, scale)
    yield from _occupancy(2 * _last(output("voxel")), labels[f"voxel_label_{scale}"][:, :, 0], weight, line)


def _last(array: np.ndarray) -> jax.Array:
    """Channels last."""
    return jnp.asarray(np.moveaxis(array, 2, -1))


def _true(mask: np.ndarray) -> jax.Array:
    """bool [B, S, 1, H, W] (or numbers) -> [B, S, H, W]"""
    return jnp.asarray(mask[:, :, 0] > 0)


def _instances(output, labels: dict[str, np.ndarray], scale: int) -> Terms:
    """Centres of instances, and the way to them, which only counts on an instance and not less at a smaller scale."""
    numbers = jnp.asarray(np.asarray(labels[f"instance_label_{scale}"], np.int32)[:, :, 0])
    centre, away = instances.sums(_last(output("bev_instance_center")), _last(output("bev_instance_offset")), numbers,
                                  scale)
    yield "bev_center", _MAP_WEIGHT / scale * _CENTRE_WEIGHT * centre.value()
    yield "bev_offset", _MAP_WEIGHT * _OFFSET_WEIGHT * away.value()


def _occupancy(logits: jax.Array, target: np.ndarray, weight: float, line: str) -> Terms:
    sums = jax.jit(scal.occupancy_sums)(logits, target)
    yield "geo_scal", weight * scal.geometric_scal(sums)
    if line == "1d":
        yield "voxel", weight * scal.cross_entropy(sums)
        yield "sem_scal", weight * scal.semantic_scal(sums)


def _perceptual(prediction: np.ndarray, target: np.ndarray) -> jax.Array:
    network, weights = losses.perceptual_network((prediction.shape[1], *prediction.shape[3:], 3))
    maps = jax.jit(lambda weights, picture: losses.perceptual_maps(network, weights, picture))
    return perceptual.distance_sums(maps(weights, prediction), maps(weights, target)).terms("distance")["distance"]


GROUPS: tuple[cases.Group, ...] = (all_losses,)
