"""The one table of loss terms: for each head how they are computed and what weighs them.

A term is reduced to sums that add over samples and devices; `total` adds them over devices and asks each for its value
only then. What a new head takes is written in config/heads.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Protocol

import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.objectives import chamfer, classification, instances, labels, perceptual, regression, scal, similarity


class Sums(Protocol):
    """A pytree of numbers that add over samples and devices, such as regression.MeanSums."""

    def terms(self, name: str) -> dict[str, types.Array]:
        """{term: value} from the sums of a whole batch that stand under `name`."""
        ...


@dataclasses.dataclass(frozen=True)
class Inputs:
    """What the terms of a head are computed from.

    Attributes:
      predictions: scale -> [B, T, ...], at every scale of the head.
      batch: has every field that config.head_targets names for the head.
      model, loss: units and settings.
      keys: typed keys [B], one per sample, for terms that draw.
      frozen: the network of the perceptual term, None where it is off.
    """

    predictions: Mapping[int, types.Array]
    batch: types.Batch
    model: config_lib.ModelConfig
    loss: config_lib.LossConfig
    keys: types.Array
    frozen: perceptual.FrozenEncoder | None = None

    def truth(self, field: str) -> types.Array:
        """[B, T, ...], a field of the batch that config.head_targets names for the head."""
        return jnp.asarray(getattr(self.batch, field))


@dataclasses.dataclass(frozen=True)
class HeadTerms:
    """The loss terms of one head.

    Attributes:
      sums: computes them, {name: Sums}; together their `terms` are at most the keys of `weights`.
      weights: term -> (the field of LossConfig that weighs it, a factor on that).
    """

    sums: Callable[[Inputs], dict[str, Sums]]
    weights: Mapping[str, tuple[str, float]]


def scaled(*fields: str) -> dict[str, tuple[str, float]]:
    """A term at every scale f for each of these fields of LossConfig, named field_f, at 1/f of its weight."""
    return {f"{field}_{scale}": (field, 1.0 / scale) for field in fields for scale in labels.SCALES}


def single(*fields: str) -> dict[str, tuple[str, float]]:
    """One term for each of these fields of LossConfig, of the same name and weight."""
    return {field: (field, 1.0) for field in fields}


def _image(inputs: Inputs) -> dict[str, Sums]:
    sums: dict[str, Sums] = {}
    masks = labels.map_labels(inputs.truth("image_instance_mask")) if inputs.loss.image_instance else None
    for scale, target in labels.image_labels(inputs.truth("image")).items():
        sums[f"image_{scale}"] = regression.l1_sums(inputs.predictions[scale], target)
        sums[f"image_squared_{scale}"] = regression.l2_sums(inputs.predictions[scale], target)
        if masks is not None:
            sums[f"image_instance_{scale}"] = regression.l1_sums(inputs.predictions[scale], target, masks[scale])
        if inputs.loss.image_similarity:
            sums[f"image_similarity_{scale}"] = similarity.dissimilarity_sums(inputs.predictions[scale], target)
        if inputs.loss.image_perceptual:
            if inputs.frozen is None:
                raise ValueError("losses: loss.image_perceptual is on, but there is no frozen image network. Train "
                                 "with --perceptual and --backbone-weights=PATH or --perceptual-from=RUN.")
            sums[f"image_perceptual_{scale}"] = inputs.frozen.distance_sums(inputs.predictions[scale], target)
    return sums


def _range_view(inputs: Inputs) -> dict[str, Sums]:
    model, loss, range_view = inputs.model, inputs.loss, inputs.truth("range_view")
    sums: dict[str, Sums] = {}
    for scale, target in labels.range_view_labels(range_view).items():
        sums[f"range_xyz_{scale}"], sums[f"range_depth_{scale}"] = regression.range_view_sums(
            inputs.predictions[scale], target, scale_m=model.range_scale_m, mask_holes=model.numerics == "standard")
    if loss.chamfer:
        sums["chamfer_1"] = chamfer.chamfer_sums(
            inputs.predictions[1], range_view, inputs.keys, points=loss.chamfer_points, scale_m=model.range_scale_m,
            return_threshold_m=loss.return_threshold_m)
    return sums


def _occupancy(inputs: Inputs) -> dict[str, Sums]:
    unknown_is_empty = inputs.loss.occupancy_unknown == "empty"
    sums: dict[str, Sums] = {}
    for scale, target in labels.occupancy_labels(
            inputs.truth("occupancy"), pooled=inputs.model.numerics == "standard").items():
        sums[f"occupancy_{scale}"] = scal.occupancy_sums(inputs.predictions[scale], target, unknown_is_empty,
                                                         inputs.loss.occupancy_unknown_weight)
        if inputs.loss.occupancy_dice:
            sums[f"occupancy_dice_{scale}"] = classification.occupancy_dice_sums(inputs.predictions[scale], target,
                                                                                 unknown_is_empty)
    return sums


def _action(inputs: Inputs) -> dict[str, Sums]:
    return {"action": regression.l1_sums(inputs.predictions[1], inputs.truth("action"))}


def _depth(inputs: Inputs) -> dict[str, Sums]:
    """In units of range_scale_m, where nothing is measured too, so that the model learns where that is."""
    scale_m = inputs.model.range_scale_m
    return {f"depth_{scale}": regression.l1_sums(inputs.predictions[scale] / scale_m, target[..., None] / scale_m)
            for scale, target in labels.map_labels(inputs.truth("depth_m")).items()}


def _semantic(term: str, field: str, share: str) -> Callable[[Inputs], dict[str, Sums]]:
    """Cross-entropies of a class map; `share` names the field of LossConfig."""
    def sums(inputs: Inputs) -> dict[str, Sums]:
        loss = inputs.loss
        return {f"{term}_{scale}": classification.cross_entropy_sums(
                    inputs.predictions[scale], target, weights=loss.semantic_weights, top_share=getattr(loss, share))
                for scale, target in labels.map_labels(inputs.truth(field)).items()}
    return sums


def _birds_eye(inputs: Inputs) -> dict[str, Sums]:
    loss, count = inputs.loss, config_lib.BIRDS_EYE_CLASSES
    sums: dict[str, Sums] = {}
    numbers = labels.map_labels(inputs.truth("birds_eye_instances"))
    for scale, target in labels.map_labels(inputs.truth("birds_eye_classes")).items():
        prediction = inputs.predictions[scale]
        sums[f"birds_eye_{scale}"] = classification.cross_entropy_sums(
            prediction[..., :count], target, weights=loss.birds_eye_weights, top_share=loss.birds_eye_share)
        sums[f"birds_eye_centre_{scale}"], sums[f"birds_eye_offset_{scale}"] = instances.sums(
            prediction[..., count + 2:], prediction[..., count:count + 2], numbers[scale], scale)
    return sums


def _reward(inputs: Inputs) -> dict[str, Sums]:
    return {"reward": regression.l2_sums(inputs.predictions[1], inputs.truth("reward")[..., None])}


def _continue(inputs: Inputs) -> dict[str, Sums]:
    going_on = ~inputs.truth("is_terminal")
    return {"continue": regression.binary_cross_entropy_sums(inputs.predictions[1][..., 0], going_on)}


def _ego_motion(inputs: Inputs) -> dict[str, Sums]:
    """The speed of every frame, the motion of those that have a frame before them in the window."""
    unit = jnp.asarray(config_lib.EGO_MOTION_UNITS, jnp.float32).reshape(1, 1, -1)
    prediction, target = inputs.predictions[1] / unit, inputs.truth("ego_motion") / unit
    moved = ~jnp.asarray(inputs.batch.is_first)
    return {"ego_motion": regression.l1_sums(prediction[..., :3], target[..., :3], moved),
            "ego_speed": regression.l1_sums(prediction[..., 3:], target[..., 3:])}


TABLE: dict[str, HeadTerms] = {
    "image": HeadTerms(_image, scaled("image", "image_squared", "image_similarity", "image_perceptual",
                                       "image_instance")),
    "range_view": HeadTerms(_range_view, scaled("range_xyz", "range_depth") | {"chamfer_1": ("chamfer", 1.0)}),
    "occupancy": HeadTerms(_occupancy, scaled("occupancy_cross_entropy", "occupancy_semantic_scal",
                                              "occupancy_geometric_scal", "occupancy_dice")),
    "action": HeadTerms(_action, single("action")),
    "depth": HeadTerms(_depth, scaled("depth")),
    "semantic_image": HeadTerms(_semantic("semantic_image", "image_classes", "semantic_image_share"),
                                scaled("semantic_image")),
    "semantic_range_view": HeadTerms(
        _semantic("semantic_range_view", "range_view_classes", "semantic_range_view_share"),
        scaled("semantic_range_view")),
    "birds_eye": HeadTerms(_birds_eye, scaled("birds_eye", "birds_eye_centre")
                           | {f"birds_eye_offset_{scale}": ("birds_eye_offset", 1.0) for scale in labels.SCALES}),
    "reward": HeadTerms(_reward, single("reward")),
    "continue": HeadTerms(_continue, {"continue": ("continue_", 1.0)}),
    "ego_motion": HeadTerms(_ego_motion, single("ego_motion") | {"ego_speed": ("ego_motion", 1.0)}),
}
