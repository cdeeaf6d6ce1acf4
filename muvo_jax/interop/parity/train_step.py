"""Golden files p5: one training step of the whole model: loss terms, gradients, batch statistics, one AdamW update.

Batch statistics in BatchNorm, no dropout, drawn latents. The optimiser of the file has constant settings; the schedules
with which the reference really trains are entries of their own.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.interop import names
from muvo_jax.interop.parity import cases, drawing, full_models, golden, raw_batch, rounding
from muvo_jax.model import rollout, world_model
from muvo_jax.objectives import regression, total
from muvo_jax.training import optimizer as optimizer_lib

Checks = Iterator[cases.Check]
LOSS_TOLERANCE, STATISTICS_TOLERANCE, NORM_TOLERANCE, NEW_TOLERANCE = 1e-4, 1e-5, 5e-3, 1e-5
STYLED_TOLERANCE, SCHEDULE_TOLERANCE = 5e-4, 1e-6
_RATE, _EPSILON = 1e-4, 1e-8
_DECISIVE = 1e3  # gradients this many times epsilon move a parameter by the whole rate
_NOISY = ("encoder.", "range_view_encoder.", "feat_decoder.")
_TERMS = {"image": "rgb", "range_xyz": "lidar_re", "range_depth": "lidar_depth", "occupancy_cross_entropy": "voxel",
          "occupancy_semantic_scal": "sem_scal", "occupancy_geometric_scal": "geo_scal", "kl": "probabilistic"}


def gradient_tolerance(key: str) -> float:
    """Batch statistics over few samples and kinks of ReLU make the encoders' gradients the noisiest."""
    if "query_embed" in key:
        return 2e-2
    return 5e-2 if key.startswith(_NOISY) else 5e-3


def step(context: cases.Context) -> Checks:
    try:
        yield from _step(context)
    finally:
        jax.clear_caches()


def _step(context: cases.Context) -> Checks:
    latent = "2d" if context.file.path.stem.endswith("2d") else "1d"
    shape = context.shape("out/throttle_brake", "out/steering", "out/posterior/mu")
    frames = shape[1] if shape else context.size("p5", f"train_step_{latent}_sequence")
    config = config_lib.ModelConfig(latent=config_lib.LATENTS[latent](), numerics="reference", prior_dropout=0.0,
                                    fusion=config_lib.TransformerFusion(dropout=0.0))
    model = world_model.WorldModel(config)
    variables = jax.tree.map(jnp.asarray, drawing.draw_variables(model.variable_shapes()))
    batch = raw_batch.model_batch(raw_batch.draw_raw(context, frames, context.size("p4", "imagine")))
    noise = _noise(context, model, frames)
    loss = loss_config(latent)

    def observe(weights, batch, noise):
        embedding, updated = model.encode(weights, batch, train=True)
        return updated, rollout.filter_embeddings(model, weights, embedding, jnp.asarray(batch.action),
                                                  jnp.asarray(batch.is_first), noise)

    def forward(params, batch_stats, batch, noise):
        weights = {"params": params, "batch_stats": batch_stats}
        updated, observed = observe(weights, batch, noise)
        predictions = types.Predictions({})
        for head in config.heads:
            decode = jax.checkpoint(lambda weights, features, head=head: model.decode(weights, features, (head,)))
            predictions |= decode(weights, observed.states.features)
        terms = total.losses(predictions, batch, observed, model=config, loss=loss,
                             keys=jax.random.split(jax.random.key(0), 1))
        return terms["total"], (terms, updated, observed, predictions)

    differentiate = jax.jit(jax.value_and_grad(forward, has_aux=True))
    (_, (terms, updated, observed, predictions)), gradients = differentiate(
        variables["params"], variables["batch_stats"], batch, noise)
    yield from _terms(terms, config, loss)
    yield from _actions(predictions, batch, loss, functools.partial(_moved_predictions, model, observe, variables,
                                                                    batch, noise))
    yield from _outputs(observed, predictions, config)
    yield from _statistics(context, updated)
    yield from _gradients(context, gradients)
    yield from _update(context, variables["params"], gradients)
    yield from _groups(latent)


def loss_config(latent: str) -> config_lib.LossConfig:
    """The terms that the reference trains: its 2D code leaves out two of the occupancy terms."""
    loss = config_lib.LossConfig(occupancy_unknown="empty")
    return loss if latent == "1d" else dataclasses.replace(loss, occupancy_cross_entropy=0.0,
                                                           occupancy_semantic_scal=0.0)


def _noise(context: cases.Context, model: world_model.WorldModel, frames: int) -> types.StepNoise:
    """Draw 2 t is the prior's of step t, draw 2 t + 1 the posterior's; tokens come before the batch."""
    shape = model.initial_state(1).stochastic.shape
    drawn = []
    for index in range(2 * frames):
        if len(shape) == 2:
            drawn.append(context.draw(f"train_noise_{index}", shape, "normal"))
        else:
            tokens_first = context.draw(f"train_noise_{index}", (shape[1], 1, shape[2]), "normal")
            drawn.append(np.swapaxes(tokens_first, 0, 1))
    stack = lambda values: jnp.asarray(np.stack(values, 1))
    return types.StepNoise(stack(drawn[0::2]), stack(drawn[1::2]), jnp.zeros((1, frames), bool))


def _moved_predictions(model: world_model.WorldModel, observe: Callable[..., Any], variables: Any, batch: types.Batch,
                       noise: types.StepNoise) -> Iterator[types.Predictions]:
    """The actions on weights that are moved back and forth."""
    def act(weights, batch, noise):
        return model.decode(weights, observe(weights, batch, noise)[1].states.features, ("action",))

    compiled = jax.jit(act)
    for params in rounding.in_pairs(variables["params"]):
        yield compiled({**variables, "params": params}, batch, noise)


def _actions(predictions: types.Predictions, batch: types.Batch, loss: config_lib.LossConfig,
             moved: Callable[[], Iterator[types.Predictions]]) -> Checks:
    """The predicted actions and their loss terms, numbers that may be near zero; `moved` gives their roundings."""
    for column, entry in enumerate(("throttle_brake", "steering")):
        pick = lambda action, column=column: jnp.asarray(action)[..., column:column + 1]
        predicted = lambda predictions, pick=pick: pick(predictions.action)
        term = lambda predictions, pick=pick: loss.action * regression.l1_sums(pick(predictions.action),
                                                                               pick(batch.action)).value()
        for kind, value in (("out", predicted), ("loss", term)):
            roundings = lambda value=value: (value(predictions) for predictions in moved())
            yield cases.Check(f"{kind}/{entry}", value(predictions), LOSS_TOLERANCE, roundings=roundings)


def _terms(terms: dict[str, jax.Array], config: config_lib.ModelConfig, loss: config_lib.LossConfig) -> Checks:
    yield cases.Check("loss/total", terms["total"], LOSS_TOLERANCE)
    weights = total.term_weights(loss, config.heads)
    for name, value in terms.items():
        term, _, scale = name.rpartition("_")
        entry = _TERMS.get(name) or f"{_TERMS.get(term, term)}_{scale}"
        if name not in ("total", "action"):
            yield cases.Check(f"loss/{entry}", weights[name] * value, LOSS_TOLERANCE)


def _outputs(observed: types.Observed, predictions: types.Predictions, config: config_lib.ModelConfig) -> Checks:
    for kind, gaussian in (("prior", observed.prior), ("posterior", observed.posterior)):
        for entry, value in (("mu", gaussian.mean), ("sigma", gaussian.std)):
            yield cases.Check(f"out/{kind}/{entry}", full_models.latent_layout(value), LOSS_TOLERANCE)
    maps = types.Predictions({head: scales for head, scales in predictions.arrays.items() if head != "action"})
    for entry, value in full_models.prediction_entries("out", maps, config):
        yield cases.Check(entry, value, STYLED_TOLERANCE if "voxel" in entry else LOSS_TOLERANCE)


def _statistics(context: cases.Context, batch_stats: Any) -> Checks:
    for key, value in _by_reference_key({"batch_stats": batch_stats}):
        module, _, moment = key.rpartition(".")
        yield cases.Check(f"bn/{module}/{moment}", value, STATISTICS_TOLERANCE)


def _gradients(context: cases.Context, gradients: Any) -> Checks:
    squares: dict[str, float] = {}
    for key, gradient in _by_reference_key({"params": gradients}):
        module = key.split(".")[0]
        squares[module] = squares.get(module, 0.0) + float(np.square(gradient, dtype=np.float64).sum())
        if f"grad/{key}" in context.file:
            shaped = gradient.reshape(context.file.shape(f"grad/{key}"))
            yield cases.Check(f"grad/{key}", shaped, gradient_tolerance(key))
    yield cases.Check("gradnorm/ALL", np.sqrt(sum(squares.values())), NORM_TOLERANCE)
    for module, square in squares.items():
        yield cases.Check(f"gradnorm/{module}", np.sqrt(square), NORM_TOLERANCE)


def _update(context: cases.Context, params: Any, gradients: Any) -> Checks:
    """One AdamW step with the reference's two groups; weight decay spares parameters with one axis."""
    adamw = optimizer_lib.packed(optax.adamw(_RATE, b1=0.9, b2=0.999, eps=_EPSILON, weight_decay=0.01,
                                             mask=optimizer_lib.decays))

    @jax.jit
    def update(params, gradients):
        updates, _ = adamw.update(gradients, adamw.init(params), params)
        return updates

    signed = jax.tree_util.tree_map_with_path(functools.partial(_signed, context.file), gradients)
    moved = dict(_by_reference_key({"params": update(params, signed)}))
    for key, before in _by_reference_key({"params": params}):
        if f"new/{key}" in context.file:
            delta = moved[key].reshape(context.file.shape(f"delta/{key}"))
            yield cases.Check(f"new/{key}", before.reshape(delta.shape) + delta, NEW_TOLERANCE)
            yield cases.Check(f"delta/{key}", delta, gradient_tolerance(key))


def _signed(file: golden.File, path: tuple[Any, ...], gradient: jax.Array) -> np.ndarray:
    """A gradient of ours with the file's in the places where ours does not decide the step.

    Adam's first step is gradient / (|gradient| + epsilon), as long as the learning rate whatever the gradient's size.
    Its direction is unknown where a gradient is smaller than its own tolerance, its length where one is near epsilon.
    There the step of the file's gradient is compared; the gradients themselves are entries of their own.
    """
    ours = "/".join(part.key for part in path)
    key, entry = names.reference_key(ours), f"grad/{names.reference_key(ours)}"
    values = np.array(gradient).reshape(-1)
    if entry in file:
        order = names.to_reference_layout(ours, np.arange(values.size).reshape(gradient.shape)).reshape(-1)
        places, theirs = order[::file.stride(entry)], file.values(entry).reshape(-1)
        decides = np.abs(theirs) > max(gradient_tolerance(key) * np.abs(theirs).max(), _DECISIVE * _EPSILON)
        values[places] = np.where(decides, values[places], theirs)
    return values.reshape(gradient.shape)


def _groups(latent: str) -> Checks:
    """How many of the reference's parameters each of AdamW's groups holds, by our rule for what is decayed."""
    manifest = golden.manifest("2d_RV_WOB_TR_voxel" if latent == "2d" else "1d_RV_WOB_TR_voxel")
    buffers = ("running_mean", "running_var", "num_batches_tracked")
    shapes = [shape for key, shape in manifest.items() if not key.endswith(buffers)]
    groups = [optimizer_lib.group_of(len(shape)) for shape in shapes]
    yield cases.Check("groups/n_decay", groups.count("decayed"), 0.0)
    yield cases.Check("groups/n_no_decay", groups.count("undecayed"), 0.0)


def schedules(context: cases.Context) -> Checks:
    """Learning rate and first momentum before each of some optimiser steps, relative to each value."""
    for steps in (50_000, 100_000):
        if f"onecycle_{steps}/step" not in context.file:
            continue
        taken = context.file[f"onecycle_{steps}/step"]
        config = config_lib.OptimizerConfig()
        yield cases.Check(f"onecycle_{steps}/step", taken, 0.0)
        for entry, schedule in (("lr", optimizer_lib.learning_rate), ("beta1", optimizer_lib.beta1)):
            values = np.asarray(jax.vmap(schedule(config, steps))(jnp.asarray(taken, jnp.int32)))
            yield cases.Check(f"onecycle_{steps}/{entry}", values, SCHEDULE_TOLERANCE, _relative_error)


def _relative_error(file: golden.File, entry: str, got: np.ndarray) -> float:
    return float(np.max(np.abs(got - file[entry]) / np.abs(file[entry])))


def _by_reference_key(tree: dict[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """The reference's key and layout of every leaf of {"params": ...} or {"batch_stats": ...}."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        ours = "/".join(part.key for part in path[1:])
        yield names.reference_key(ours), names.to_reference_layout(ours, np.asarray(leaf))


GROUPS: tuple[cases.Group, ...] = (step, schedules)
