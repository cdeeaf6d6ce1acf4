"""Golden files p4: whole models of the reference, from a raw batch to embedding, latents, predictions and dreams."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import checkpoints, reference_preprocess
from muvo_jax.interop.parity import cases, drawing, golden, raw_batch, rounding
from muvo_jax.model import rollout, world_model
from muvo_jax.nn import mobilevit
from muvo_jax.types import Batch, LatentState, Observed, Predictions, StepNoise

Checks = Iterator[cases.Check]
TOLERANCE, BEV_TOLERANCE, STYLED_TOLERANCE = 1e-4, 1e-3, 1e-3
_FEW = 64  # entries of so many numbers may be near zero as a whole
_ENTRIES = {"image": "rgb", "range_view": "lidar_reconstruction", "occupancy": "voxel"}
_BACKBONES = {"encoder": "camera", "range_view_encoder": "lidar"}


def config_of(name: str) -> config_lib.ModelConfig:
    """The configuration of a file's model, such as "2d_RV_BEV_TR", from the names and shapes of its weights."""
    unfilled = {key: np.broadcast_to(np.float32(0), shape) for key, shape in golden.manifest(name).items()}
    return checkpoints.recognise(checkpoints.Stored(pathlib.Path(name), unfilled, {}, {}))


def tolerance_of(config: config_lib.ModelConfig, entry: str) -> float:
    """As the page of the golden files says: lifting and adaptive norms, of the 1D voxel head, amplify float32 noise."""
    if isinstance(config.camera, config_lib.BirdsEyeCamera):
        return BEV_TOLERANCE
    return STYLED_TOLERANCE if "/voxel_" in entry and isinstance(config.latent, config_lib.VectorLatent) else TOLERANCE


def checks(context: cases.Context) -> Checks:
    config = config_of(context.file.path.stem)
    try:
        drawn = drawing.draw_variables(world_model.WorldModel(config).variable_shapes())
        yield from model_checks(context, config, drawn)
    finally:
        jax.clear_caches()  # one model at a time: the next one needs the memory


def model_checks(context: cases.Context, config: config_lib.ModelConfig, variables: Any) -> Checks:
    """The entries of a file by a model that is given, on the raw batch of the file.

    Args:
      context: of the file.
      config: of the model.
      variables: the file's weights in our layout.
    """
    raw = raw_batch.draw_raw(context, *_steps(context))
    frames = raw["image"].shape[1]
    for entry, value in reference_preprocess.network_inputs(raw).items():
        yield cases.Check(f"in/{entry}", value, tolerance_of(config, f"in/{entry}"))
    more = raw_batch.points(context, frames) if isinstance(config.lidar, config_lib.PillarLidar) else {}
    if config.navigation:
        more |= raw_batch.navigation(context, frames)
    batch, model = raw_batch.model_batch(raw, **more), world_model.WorldModel(config)
    variables = jax.tree.map(jnp.asarray, variables)
    encode = jax.jit(lambda variables, batch: model.encode(variables, batch)[0])
    embedding, check = _encoded(context, config, lambda variables: encode(variables, batch), variables)
    yield check
    compute = functools.partial(_entries, context, model, batch=batch, actions=jnp.asarray(raw["action"][:, frames:]))

    @functools.cache
    def moved_numbers() -> dict[str, list[np.ndarray]]:
        """Of every entry of few numbers, its values on weights that are moved back and forth."""
        found: dict[str, list[np.ndarray]] = {}
        for moved in rounding.in_pairs(variables):
            for entry, value in compute(moved, encode(moved, batch), heads=("action",)):
                if np.size(value) <= _FEW:
                    found.setdefault(entry, []).append(np.asarray(value))
        return found

    for entry, value in compute(variables, embedding):
        roundings = (lambda entry=entry: iter(moved_numbers()[entry])) if np.size(value) <= _FEW else None
        yield cases.Check(entry, value, tolerance_of(config, entry), roundings=roundings)


def _steps(context: cases.Context) -> tuple[int, int]:
    """How many frames a file observes, and how many steps it imagines."""
    embedding, dreamt = context.shape("embedding"), context.shape("imagine/action", "imagine_policy/action")
    sequence = context.size("p4", "sequence")
    usual = sequence.get(context.file.path.stem, sequence["default"]) if embedding is None else embedding[1]
    return usual, context.size("p4", "imagine") if dreamt is None else dreamt[1]


def _encoded(context: cases.Context, config: config_lib.ModelConfig, encode: Callable[[Any], jax.Array],
             variables: Any) -> tuple[jax.Array, cases.Check]:
    """The embedding from which all else follows, and its check.

    A camera "bev" chooses the most probable bins of depth: a jump where two of them tie. Where ours misses, the choices
    of weights that differ by rounding are tried, and the first that agrees with the file is kept.
    """
    tolerance, note = tolerance_of(config, "embedding"), ""
    embedding = encode(variables)
    if isinstance(config.camera, config_lib.BirdsEyeCamera) and "embedding" in context.file:
        error = lambda value: context.file.error("embedding", latent_layout(value))
        first = error(embedding)
        others = rounding.anew(variables, size=rounding.NETWORK_NOISE) if first > tolerance else ()
        for tries, moved in enumerate(others, start=1):
            other = encode(moved)
            if error(other) <= tolerance:
                embedding, note = other, f"{first:.1e} as first rounded, this in try {tries}"
                break
    return embedding, cases.Check("embedding", latent_layout(embedding), tolerance, note=note)


def _observed(model: world_model.WorldModel, variables: Any, embedding: jax.Array, batch: Batch) -> Observed:
    zeros = jnp.zeros((*embedding.shape[:2], *model.initial_state(1).stochastic.shape[1:]))
    means = StepNoise(zeros, zeros, jnp.zeros(embedding.shape[:2], bool))
    return _filter(model, variables, embedding, jnp.asarray(batch.action), jnp.asarray(batch.is_first), means)


_filter = jax.jit(rollout.filter_embeddings, static_argnums=0)
_observe = jax.jit(world_model.WorldModel.observe_step, static_argnums=0)
_imagine = jax.jit(world_model.WorldModel.imagine_step, static_argnums=0)


def _entries(context: cases.Context, model: world_model.WorldModel, variables: Any, embedding: jax.Array, *,
             batch: Batch, actions: jax.Array, heads: tuple[str, ...] | None = None) -> Iterator[tuple[str, Any]]:
    """What follows from the embedded window: latents, predictions of `heads` (None for all), dreams, deployment."""
    observed = _observed(model, variables, embedding, batch)
    for kind, gaussian in (("prior", observed.prior), ("posterior", observed.posterior)):
        for entry, value in (("hidden_state", observed.states.deterministic), ("mu", gaussian.mean),
                             ("sigma", gaussian.std), ("sample", gaussian.mean)):
            yield f"out/{kind}/{entry}", latent_layout(value)
    yield from prediction_entries("out", rollout.decode(model, variables, observed.states, heads), model.config)
    dream = functools.partial(_dream, model, variables, observed.last, horizon=actions.shape[1], heads=heads)
    if "imagine/state" in context.file:
        yield from dream(actions, "imagine")
    if "imagine_policy/state" in context.file:
        yield from dream(rollout.learned_policy(model, variables), "imagine_policy")
    if "deployment/steering" in context.file:
        yield from _deployed(model, variables, embedding, batch, observed.last)


def _dream(model: world_model.WorldModel, variables: Any, state: LatentState, driver: Any, prefix: str, *, horizon: int,
           heads: tuple[str, ...] | None) -> Iterator[tuple[str, Any]]:
    dream = rollout.imagine(model, variables, jax.random.key(0), state, driver, horizon=horizon, sampled=False)
    hidden, sample = (latent_layout(value) for value in (dream.states.deterministic, dream.states.stochastic))
    yield f"{prefix}/hidden", hidden
    yield f"{prefix}/sample", sample
    tokens = isinstance(model.config.latent, config_lib.TokenLatent)
    yield f"{prefix}/state", sample if tokens else np.concatenate([hidden, sample], axis=-1)
    yield f"{prefix}/action", dream.actions[..., None] if tokens else dream.actions
    yield from prediction_entries(prefix, rollout.decode(model, variables, dream.states, heads), model.config)


def _deployed(model: world_model.WorldModel, variables: Any, embedding: jax.Array, batch: Batch,
              last: LatentState) -> Iterator[tuple[str, Any]]:
    """The action at the end of the window, and three calls of the agent in CARLA at 10 Hz.

    The agent's model moves at every second call, the third time unseeing.
    """
    action = jnp.asarray(batch.action[:, -2])
    state = model.initial_state(1)
    zeros = jnp.zeros_like(state.stochastic)
    noise = StepNoise(zeros, zeros, jnp.zeros((1,), bool))
    seen, _ = _observe(model, variables, noise, state, action, embedding[:, -1], jnp.zeros((1,), bool))
    dreamt, _ = _imagine(model, variables, zeros, seen, action)
    for place, state in (("deployment", last), ("deployment_forward/0", seen), ("deployment_forward/1", seen),
                         ("deployment_forward/2", dreamt)):
        driven = rollout.decode(model, variables, state, ("action",)).action[:, None]
        yield f"{place}/throttle_brake", driven[..., :1]
        yield f"{place}/steering", driven[..., 1:]
        yield f"{place}/hidden_state", state.deterministic
        yield f"{place}/sample", state.stochastic


def prediction_entries(prefix: str, predictions: Predictions,
                       config: config_lib.ModelConfig) -> Iterator[tuple[str, Any]]:
    """The heads' outputs [1, T, ...] by the reference's names, in its units and layout."""
    for head, scales in predictions.arrays.items():
        if head == "action":
            yield f"{prefix}/throttle_brake", scales[1][..., :1]
            yield f"{prefix}/steering", scales[1][..., 1:]
            continue
        if head == "birds_eye":
            yield from drawing.birds_eye_entries(prefix, scales, 2)
            continue
        unit = config.range_scale_m if head == "range_view" else 1.0
        for scale, value in scales.items():
            yield f"{prefix}/{_ENTRIES.get(head, head)}_{scale}", drawing.channels_first(value, 2) / np.float32(unit)


def latent_layout(value: Any) -> np.ndarray:
    """Latents [B, T, S] as they are, tokens [B, T, N, C] with channels before tokens."""
    return np.swapaxes(value, 2, 3) if value.ndim == 4 else np.asarray(value)


def mobilevit_backbones(context: cases.Context) -> Checks:
    """The pyramids of the MobileViT-V2 model, on their own."""
    for name, drawn, channels, size, levels in (
            ("encoder", "mv_img", 3, context.size("p4", "mobilevit_backbone_image_hw"), (2, 3, 4)),
            ("range_view_encoder", "mv_rv", 4, _backbone_range_size(context), (1, 2, 3))):
        image = drawing.channels_last(context.draw(drawn, (1, channels, *size), "smooth_pm1"))
        maps = drawing.run(mobilevit.MobileVit(64, levels, keep_grown=True), image,
                           where=f"{_BACKBONES[name]}/backbone/", static=(drawing.EVAL,))
        for index, value in enumerate(maps):
            yield cases.Check(f"{name}/feat{index}", drawing.channels_first(value), TOLERANCE)


def _backbone_range_size(context: cases.Context) -> tuple[int, ...]:
    """Of the range view, from the map of level 1, a quarter of its size."""
    quarter = context.shape("range_view_encoder/feat0")
    return tuple(4 * side for side in quarter[2:]) if quarter else raw_batch.range_size(context)


GROUPS: tuple[cases.Group, ...] = (checks,)
BACKBONE_GROUPS: tuple[cases.Group, ...] = (mobilevit_backbones,)
