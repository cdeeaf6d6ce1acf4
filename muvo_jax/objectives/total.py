"""The training loss (paper Eq. 1): every term named, weighted and checked as a set.

All terms are first reduced to sums that add over samples; `axis_name` sums these over devices, and only then are
ratios, logarithms and means taken. So the loss of a batch does not depend on how many devices share it.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.objectives import kl, perceptual

_KEY_SITE = 0xC4A3  # separates the draws of loss terms from all others made with the same sample key


def term_weights(loss: config_lib.LossConfig, heads: tuple[str, ...]) -> dict[str, float]:
    """{term: weight} of every term these heads have; a weight of 0 leaves the term out."""
    weights = {term: weight for head in heads for term, weight in head_lib.get(head).weights(loss).items()}
    return weights | {"kl": loss.kl}


def loss_sums(predictions: types.Predictions, batch: types.Batch, observed: types.Observed, *,
              model: config_lib.ModelConfig, loss: config_lib.LossConfig, keys: types.Array,
              frozen: perceptual.FrozenEncoder | None = None) -> dict[str, head_lib.Sums]:
    """Reduces predictions and targets to sums that add over samples and devices.

    Args:
      predictions: what `decode` returns for the states of every frame, [B, T, ...] each.
      batch: the targets.
      observed: posterior and prior of every frame.
      model, loss: weights and units.
      keys: typed keys [B], one per sample (for terms that draw, such as the optional Chamfer term).
      frozen: the network of the optional perceptual term.

    Raises:
      ValueError: where a head has no target or lacks a scale.
    """
    sums = kl_sums(observed, model=model, loss=loss)
    for head in model.heads:
        sums |= head_sums(head, predictions, batch, model=model, loss=loss, keys=frame_keys(keys, batch.frames),
                          frozen=frozen)
    return sums


def kl_sums(observed: types.Observed, *, model: config_lib.ModelConfig,
            loss: config_lib.LossConfig) -> dict[str, head_lib.Sums]:
    """The one term that no head has: {"kl": sums}."""
    return {"kl": kl.balanced_kl_sums(observed.posterior, observed.prior, balance=loss.kl_balance,
                                      numerics=model.numerics)}


def head_sums(head: str, predictions: types.Predictions, batch: types.Batch, *, model: config_lib.ModelConfig,
              loss: config_lib.LossConfig, keys: types.Array,
              frozen: perceptual.FrozenEncoder | None = None) -> dict[str, head_lib.Sums]:
    """The sums of one head. They add over frames too, so that frames may be decoded and scored one after the other.

    Arguments as `loss_sums`, but for `keys`: [B, T], of `frame_keys`.
    """
    check_head(head, predictions, batch, model, loss)
    return dict(head_lib.get(head).losses(head_lib.Learned(predictions.scales(head), batch, model, loss, keys, frozen)))


def frame_keys(keys: types.Array, frames: int) -> types.Array:
    """Typed keys [B, frames] for terms that draw, of those of the samples [B]."""
    return jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, _KEY_SITE), frames))(keys)


def combine(sums: Mapping[str, head_lib.Sums], weights: Mapping[str, float]) -> dict[str, types.Array]:
    """Finishes the sums of a whole batch: {term: value} for every term whose weight is not 0, and the weighted "total".

    The terms themselves are not multiplied by their weights.

    Raises:
      ValueError: where a term was computed that has no weight, or a weighted term was not computed.
    """
    values: dict[str, types.Array] = {}
    for name, value in sums.items():
        values |= value.terms(name)
    used = {name: weight for name, weight in weights.items() if weight}
    missing, unknown = sorted(set(used) - set(values)), sorted(set(values) - set(weights))
    if missing or unknown:
        raise ValueError(f"losses: weighted but not computed {missing}, computed but without a weight {unknown}; "
                         f"weights are known for {sorted(weights)}.")
    weighted = [weight * values[name] for name, weight in used.items()]
    return {name: values[name] for name in used} | {"total": sum(weighted, jnp.float32(0.0))}


def losses(predictions: types.Predictions, batch: types.Batch, observed: types.Observed, *,
           model: config_lib.ModelConfig, loss: config_lib.LossConfig, keys: types.Array,
           axis_name: str | None = None, frozen: perceptual.FrozenEncoder | None = None) -> dict[str, types.Array]:
    """Every weighted term (unweighted float32 scalars) and the weighted "total" of a batch.

    Arguments as `loss_sums`; with `axis_name` the batch is spread over that axis and the result is that of all of it.
    """
    sums = loss_sums(predictions, batch, observed, model=model, loss=loss, keys=keys, frozen=frozen)
    if axis_name is not None:
        sums = jax.lax.psum(sums, axis_name)
    return combine(sums, term_weights(loss, model.heads))


def check_head(head: str, predictions: types.Predictions, batch: types.Batch, model: config_lib.ModelConfig,
               loss: config_lib.LossConfig) -> None:
    """Raises ValueError unless the head was predicted at its scales and the batch has its targets."""
    if head not in predictions:
        raise ValueError(f"losses: the model has the head {head!r}, the predictions have {sorted(predictions)}.")
    described = head_lib.get(head)
    for field in described.learns_from(model, loss):
        if getattr(batch, field, None) is None:
            term = described.term_targets.get(field)
            what, remedy = ((f"loss.{term.weight} is on", "Set it to 0") if term else
                            (f"the model has the head {head!r}", "Remove the head (--heads, model.heads)"))
            raise ValueError(f"losses: {what}, but the batch has no {field}. {remedy} or train on a recording that has "
                             f"it.")
    predicted = sorted(predictions.scales(head))
    if predicted != sorted(described.scales):
        raise ValueError(f"losses: head {head!r} predicts scales {predicted}, expected {described.scales}.")
