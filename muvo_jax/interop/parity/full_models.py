"""Packs p4: whole models of the reference, from a raw batch to embedding, latents, predictions and dreams."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import reference_preprocess
from muvo_jax.interop.parity import cases, drawing, raw_batch
from muvo_jax.model import rollout, world_model
from muvo_jax.types import Predictions, StepNoise

Checks = Iterator[cases.Check]
TOLERANCE, BEV_TOLERANCE, STYLED_TOLERANCE = 1e-4, 1e-3, 1e-3
_ENTRIES = {"image": "rgb", "range_view": "lidar_reconstruction", "occupancy": "voxel"}
_LIDAR_ONLY = ("range_view", "action")


def config_of(name: str) -> config_lib.ModelConfig:
    """The configuration of a pack by its name, such as "2d_RV_BEV_TR"."""
    fields: dict[str, Any] = {"numerics": "reference", "heads": _LIDAR_ONLY}
    parts = name.split("_")
    if parts[0] == "2d":
        fields["latent"] = "2d"
    for field, choices in (("lidar", ("RV", "PP")), ("camera", ("WOB", "BEV")), ("fusion", ("TR", "FC"))):
        fields[field] = next((choice.lower() for choice in choices if choice in parts), choices[0].lower())
    if "voxel" in parts or "mobilevit" in parts:
        fields["heads"] = config_lib.ModelConfig().heads
    elif "novoxel" in parts:
        fields["heads"] = ("image", "range_view", "action")
    return config_lib.ModelConfig(**fields)


def tolerance_of(name: str, entry: str) -> float:
    """As the page of the packs says: lifting and adaptive norms amplify float32 noise."""
    if "BEV" in name:
        return BEV_TOLERANCE
    return STYLED_TOLERANCE if "voxel_" in entry and not name.startswith("2d") else TOLERANCE


def checks(context: cases.Context) -> Checks:
    name = context.pack.path.stem
    try:
        for entry, value in _entries(context, config_of(name)):
            yield cases.Check(entry, value, tolerance_of(name, entry))
    finally:
        jax.clear_caches()  # one model at a time: the next one needs the memory


def _entries(context: cases.Context, config: config_lib.ModelConfig) -> Iterator[tuple[str, Any]]:
    frames, later = context.pack.shape("embedding")[1], context.settings.size("p4", "imagine")
    raw = raw_batch.draw_raw(context, frames, later)
    yield from ((f"in/{name}", value) for name, value in reference_preprocess.network_inputs(raw).items())
    batch = raw_batch.model_batch(raw)
    model = world_model.WorldModel(config)
    variables = jax.tree.map(jnp.asarray, drawing.draw_variables(model.variable_shapes()))
    embedding, _ = jax.jit(model.encode)(variables, batch)
    yield "embedding", latent_layout(embedding)
    key = jax.random.key(0)
    observed = rollout.observe(model, variables, key, batch, sampled=False)
    for kind, gaussian in (("prior", observed.prior), ("posterior", observed.posterior)):
        for entry, value in (("hidden_state", observed.states.deterministic), ("mu", gaussian.mean),
                             ("sigma", gaussian.std), ("sample", gaussian.mean)):
            yield f"out/{kind}/{entry}", latent_layout(value)
    predictions = rollout.decode(model, variables, observed.states)
    yield from prediction_entries("out", predictions, config)
    for entry, column in (("throttle_brake", slice(0, 1)), ("steering", slice(1, 2))):
        yield f"deployment/{entry}", predictions["action"][1][:, -1:, column]
    yield from _deployment(model, variables, embedding, batch)
    if "imagine/state" in context.pack:
        yield from _dream(model, variables, observed.last, jnp.asarray(raw["action"][:, frames:]), "imagine", later)
    if "imagine_policy/state" in context.pack:
        policy = rollout.learned_policy(model, variables)
        yield from _dream(model, variables, observed.last, policy, "imagine_policy", later)


def _dream(model: world_model.WorldModel, variables, state, driver, prefix: str,
           horizon: int) -> Iterator[tuple[str, Any]]:
    dream = rollout.imagine(model, variables, jax.random.key(0), state, driver, horizon=horizon, sampled=False)
    hidden, sample = (latent_layout(value) for value in (dream.states.deterministic, dream.states.stochastic))
    yield f"{prefix}/hidden", hidden
    yield f"{prefix}/sample", sample
    tokens = model.config.latent == "2d"
    yield f"{prefix}/state", sample if tokens else np.concatenate([hidden, sample], axis=-1)
    yield f"{prefix}/action", dream.actions[..., None] if tokens else dream.actions
    yield from prediction_entries(prefix, rollout.decode(model, variables, dream.states), model.config)


def _deployment(model: world_model.WorldModel, variables, embedding: jax.Array,
                batch) -> Iterator[tuple[str, Any]]:
    """Three calls of the agent in CARLA at 10 Hz: the model moves at every second one, the third time unseeing."""
    if model.config.latent == "2d":
        return  # the reference's 2D model has no working deployment
    action = jnp.asarray(batch.action[:, -2])
    state = model.initial_state(1)
    zeros = jnp.zeros_like(state.stochastic)
    noise = StepNoise(zeros, zeros, jnp.zeros((1,), bool))
    seen, _ = jax.jit(model.observe_step)(variables, noise, action, state, embedding[:, -1], jnp.zeros((1,), bool))
    dreamt, _ = jax.jit(model.imagine_step)(variables, zeros, action, seen)
    for call, state in enumerate((seen, seen, dreamt)):
        driven = rollout.decode(model, variables, state, ("action",))["action"][1]
        yield f"deployment_forward/{call}/hidden_state", state.deterministic
        yield f"deployment_forward/{call}/sample", state.stochastic
        yield f"deployment_forward/{call}/throttle_brake", driven[:, None, :1]
        yield f"deployment_forward/{call}/steering", driven[:, None, 1:]


def prediction_entries(prefix: str, predictions: Predictions,
                       config: config_lib.ModelConfig) -> Iterator[tuple[str, Any]]:
    """The heads' outputs [1, T, ...] by the reference's names, in its units and layout."""
    for head, scales in predictions.items():
        if head == "action":
            yield f"{prefix}/throttle_brake", scales[1][..., :1]
            yield f"{prefix}/steering", scales[1][..., 1:]
            continue
        unit = config.range_scale_m if head == "range_view" else 1.0
        for scale, value in scales.items():
            yield f"{prefix}/{_ENTRIES.get(head, head)}_{scale}", drawing.channels_first(value, 2) / np.float32(unit)


def latent_layout(value: Any) -> np.ndarray:
    """Latents [B, T, S] as they are, tokens [B, T, N, C] with channels before tokens."""
    return np.swapaxes(value, 2, 3) if value.ndim == 4 else np.asarray(value)


GROUPS: tuple[cases.Group, ...] = (checks,)
