"""The training loss (paper Eq. 1): every term named, weighted and checked as a set.

All terms are first reduced to sums that add over samples; `axis_name` sums these over devices, and only then are
ratios, logarithms and means taken. So the loss of a batch does not depend on how many devices share it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.objectives import chamfer, kl, labels, regression, scal

_SCALED_TERMS = {
    "image": ("image", "image_squared"),
    "range_view": ("range_xyz", "range_depth"),
    "occupancy": ("occupancy_cross_entropy", "occupancy_semantic_scal", "occupancy_geometric_scal"),
}
_OCCUPANCY_FINISH = {
    "occupancy_cross_entropy": scal.cross_entropy,
    "occupancy_semantic_scal": scal.semantic_scal,
    "occupancy_geometric_scal": scal.geometric_scal,
}


def term_weights(loss: config_lib.LossConfig, heads: tuple[str, ...]) -> dict[str, float]:
    """{term: weight} of every term these heads have; scale f counts 1/f, a weight of 0 leaves the term out."""
    weights = {f"{term}_{scale}": getattr(loss, term) / scale
               for head, terms in _SCALED_TERMS.items() if head in heads for term in terms for scale in labels.SCALES}
    weights["kl"] = loss.kl
    if "action" in heads:
        weights["action"] = loss.action
    if "range_view" in heads:
        weights["chamfer_1"] = loss.chamfer
    return weights


def loss_sums(predictions: types.Predictions, batch: types.Batch, observed: types.Observed, *,
              model: config_lib.ModelConfig, loss: config_lib.LossConfig, keys: types.Array) -> dict[str, Any]:
    """Reduces predictions and targets to sums that add over samples and devices.

    Args:
      predictions: what `decode` returns for the states of every frame: {head: {scale: [B, T, ...]}}.
      batch: the targets.
      observed: posterior and prior of every frame.
      model, loss: weights and units.
      keys: typed keys [B], one per sample (for the optional Chamfer term).

    Raises:
      ValueError: where a head has no target or lacks a scale.
    """
    targets = _checked_targets(predictions, batch, model.heads)
    sums: dict[str, Any] = {"kl": kl.balanced_kl_sums(observed.posterior, observed.prior, balance=loss.kl_balance,
                                                      numerics=model.numerics)}
    if "action" in model.heads:
        sums["action"] = regression.l1_sums(predictions["action"][1], targets["action"])
    if "image" in model.heads:
        for scale, target in labels.image_labels(targets["image"]).items():
            sums[f"image_{scale}"] = regression.l1_sums(predictions["image"][scale], target)
            sums[f"image_squared_{scale}"] = regression.l2_sums(predictions["image"][scale], target)
    if "range_view" in model.heads:
        sums |= _range_view_sums(predictions["range_view"], targets["range_view"], keys, model, loss)
    if "occupancy" in model.heads:
        for scale, target in labels.occupancy_labels(targets["occupancy"]).items():
            sums[f"occupancy_{scale}"] = scal.occupancy_sums(predictions["occupancy"][scale], target,
                                                             loss.occupancy_unknown == "empty")
    return sums


def _range_view_sums(predictions: Mapping[int, types.Array], range_view: types.Array, keys: types.Array,
                     model: config_lib.ModelConfig, loss: config_lib.LossConfig) -> dict[str, regression.MeanSums]:
    sums = {}
    for scale, target in labels.range_view_labels(range_view).items():
        sums[f"range_xyz_{scale}"], sums[f"range_depth_{scale}"] = regression.range_view_sums(
            predictions[scale], target, scale_m=model.range_scale_m, mask_holes=model.numerics == "standard")
    if loss.chamfer:
        sums["chamfer_1"] = chamfer.chamfer_sums(
            predictions[1], range_view, keys, points=loss.chamfer_points, scale_m=model.range_scale_m,
            return_threshold_m=loss.return_threshold_m)
    return sums


def combine(sums: Mapping[str, Any], weights: Mapping[str, float]) -> dict[str, types.Array]:
    """Finishes the sums of a whole batch: {term: value} for every term whose weight is not 0, and the weighted "total".

    The terms themselves are not multiplied by their weights.

    Raises:
      ValueError: where a term was computed that has no weight, or a weighted term was not computed.
    """
    terms: dict[str, types.Array] = {}
    for name, value in sums.items():
        if isinstance(value, scal.OccupancySums):
            scale = name.rsplit("_", 1)[1]
            terms |= {f"{term}_{scale}": finish(value) for term, finish in _OCCUPANCY_FINISH.items()}
        else:
            terms[name] = value.value()
    used = {name: weight for name, weight in weights.items() if weight}
    missing, unknown = sorted(set(used) - set(terms)), sorted(set(terms) - set(weights))
    if missing or unknown:
        raise ValueError(f"losses: weighted but not computed {missing}, computed but without a weight {unknown}; "
                         f"weights are known for {sorted(weights)}.")
    weighted = [weight * terms[name] for name, weight in used.items()]
    return {name: terms[name] for name in used} | {"total": sum(weighted, jnp.float32(0.0))}


def losses(predictions: types.Predictions, batch: types.Batch, observed: types.Observed, *,
           model: config_lib.ModelConfig, loss: config_lib.LossConfig, keys: types.Array,
           axis_name: str | None = None) -> dict[str, types.Array]:
    """Every weighted term (unweighted float32 scalars) and the weighted "total" of a batch.

    Arguments as `loss_sums`; with `axis_name` the batch is spread over that axis and the result is that of all of it.
    """
    sums = loss_sums(predictions, batch, observed, model=model, loss=loss, keys=keys)
    if axis_name is not None:
        sums = jax.lax.psum(sums, axis_name)
    return combine(sums, term_weights(loss, model.heads))


def _checked_targets(predictions: types.Predictions, batch: types.Batch,
                     heads: tuple[str, ...]) -> dict[str, types.Array]:
    """{head: target [B, T, ...]}, after checking that each head was predicted at its scales and has a target."""
    targets = {}
    for head in heads:
        if head not in predictions:
            raise ValueError(f"losses: the model has the head {head!r}, the predictions have {sorted(predictions)}.")
        if getattr(batch, head, None) is None:
            raise ValueError(f"losses: the model has the head {head!r}, but the batch has no {head}. "
                             f"Remove it from model.heads or train on a recording that has it.")
        scales = labels.SCALES if head in _SCALED_TERMS else (1,)
        if set(predictions[head]) != set(scales):
            raise ValueError(f"losses: head {head!r} predicts scales {sorted(predictions[head])}, expected {scales}.")
        targets[head] = jnp.asarray(getattr(batch, head))
    return targets
