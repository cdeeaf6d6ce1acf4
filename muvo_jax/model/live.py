"""Filtering a stream: one observation in, one small pytree on; what a vehicle runs at 10 Hz."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import numbers
from collections.abc import Mapping

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax.model import checks, rollout
from muvo_jax.model import memory as memory_lib
from muvo_jax.model.world_model import WorldModel, inputs
from muvo_jax.types import (
    BATCH_FIELDS,
    UNTIMED_FIELDS,
    Array,
    ArrayLike,
    Batch,
    LatentState,
    Memory,
    Motion,
    Vantage,
    Variables,
)


@flax.struct.dataclass
class LiveState:
    """All that a stream remembers.

    Attributes:
      latent: LatentState [B, ...], after the last observation; zeros before the first one.
      keys: typed keys [B]; observation t of a sample uses fold_in(key, t), as `observe` does.
      frame: int32 [B], observations since the start of the stream.
      memory: Memory [B, ...] of the last observations, for a model with first_guess="last_seen"; `decode` takes it.
    """

    latent: LatentState
    keys: Array
    frame: Array
    memory: Memory | None = None


def start_live(model: WorldModel, key: Array, batch_size: int = 1) -> LiveState:
    """The state before the first observation.

    Args:
      model: the model.
      key: typed key, or one per sample [B].
      batch_size: B, streams that are filtered side by side.

    Raises:
      ValueError: for a key that does not fit, or a batch_size that is no whole number of 1 or more.
    """
    if isinstance(batch_size, bool) or not isinstance(batch_size, numbers.Integral) or batch_size < 1:
        raise ValueError(f"start_live: batch_size is {batch_size!r}; expected a whole number of 1 or more.")
    keys = rollout.sample_keys(key, batch_size)
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)  # the keys of the latents' noise in `observe`
    return LiveState(model.initial_state(batch_size), keys, jnp.zeros((batch_size,), jnp.int32),
                     memory_lib.empty(model.config, batch_size))


def observe_step(model: WorldModel, variables: Variables, live: LiveState, observation: Mapping[str, ArrayLike],
                 previous_action: ArrayLike, *, sampled: bool = True) -> LiveState:
    """Takes in one raw observation. T calls give what `observe` gives for the window of T frames. Compiled once.

    Args:
      model, variables: the model.
      live: from start_live or the call before.
      observation: field of Batch -> array [B, ...] without time axis, in the units of Batch: "image", "range_view",
        "route_map", "speed_mps", whatever the model reads. A model that moves its memory without the bicycle takes
        "ego_motion" too where it is measured (odometry).
      previous_action: float32 [B, 2], applied between the last observation and this one, unused at the first; values
        that lie on a device are clipped to [-1, 1], not looked at.
      sampled: sample the latents; otherwise take their means.

    Returns:
      LiveState; imagine from its `latent`.

    Raises:
      ValueError: if shapes or dtypes do not fit the model, a field is unknown, an action is out of range, or an input
        on the host not finite.
      TypeError: for forward-mode derivatives through convolutions that have none (ModelConfig.convolution).
    """
    batch_size = live.frame.shape[0]
    action = checks.one_action(previous_action, (batch_size,), "observe_step", "previous_action", recorded=True)
    checks.state(model, live.latent)
    _check_fields(observation)
    fields = {name: jnp.asarray(value) if name in UNTIMED_FIELDS else jnp.expand_dims(jnp.asarray(value), 1)
              for name, value in observation.items()}
    batch = Batch(action=jnp.expand_dims(action, 1), is_first=jnp.expand_dims(live.frame == 0, 1), **fields)
    batch.validate()
    checks.finite_on_host("observe_step", state=live.latent, **{
        name: value for name, value in observation.items() if name in {*inputs(model.config), "range_view"}})
    if not isinstance(given := observation.get("ego_motion"), jax.Array):
        checks.arrivals("observe_step", model, given, live.frame == 0)
    for name in ("command", "next_command"):
        if not isinstance(given := observation.get(name), jax.Array):
            checks.known_commands("observe_step", name, given)
    checks.forward_mode("observe_step", model, variables, live.latent, batch)
    return _observe_step(model, variables, live, batch, sampled)


def _check_fields(observation: Mapping[str, ArrayLike]) -> None:
    """Raises ValueError for a field that Batch lacks, or that the stream itself fills in."""
    known = BATCH_FIELDS.keys() - {"action", "is_first"}
    for name in observation:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1)
            raise ValueError(f"observe_step: the observation has a field {name!r}; expected fields of "
                             f"muvo_jax.types.Batch without action and is_first"
                             + (f". Did you mean {near[0]!r}?" if near else "."))


@functools.partial(jax.jit, static_argnames=("model", "sampled"))
def _observe_step(model, variables, live, batch, sampled):
    embedding, _ = model.encode(variables, batch)
    shape = live.latent.stochastic.shape[1:]
    keys = jax.vmap(jax.random.fold_in)(live.keys, live.frame)
    noise = jax.vmap(lambda key: rollout.frame_noise(key, shape))(keys)
    if not sampled:
        noise = rollout.mean_mode(noise)
    latent, _ = model.observe_step(variables, noise, live.latent, batch.action[:, 0], embedding[:, 0],
                                   batch.is_first[:, 0])
    if not model.config.tracks_motion:
        return LiveState(latent, live.keys, live.frame + 1)
    before = live.latent.vantage
    step, speed_mps = _measured(model, variables, batch, before, latent)
    still, places = Motion(jnp.zeros_like(before.motion.pose), speed_mps), memory_lib.stream_places(model.config)
    # Counted from the frame's number, so that a stream may start from zeros (muvo_jax.export).
    first = jnp.maximum(jnp.where(batch.is_first[:, 0], places, before.first) - 1, 0)
    vantage = Vantage(still, first, jnp.full_like(first, places - 1), jnp.zeros_like(first))
    remembered = None if live.memory is None else memory_lib.remember(live.memory, batch, step)
    return LiveState(dataclasses.replace(latent, vantage=vantage), live.keys, live.frame + 1, remembered)


def _measured(model, variables, batch, before, latent):
    """The car's step since the observation before [B, 3], and its speed [B]."""
    if model.config.kinematics is not None:
        return memory_lib.intended(model.config, before, batch.action[:, 0]).pose, batch.speed_mps[:, 0]
    ego_motion = model.ego_motion(variables, latent) if batch.ego_motion is None else batch.ego_motion[:, 0]
    return ego_motion[:, :3], ego_motion[:, 3]
