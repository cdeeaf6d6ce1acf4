"""Filtering a stream: one observation in, one small pytree on; what a vehicle runs at 10 Hz."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import flax.struct
import jax
import jax.numpy as jnp

from muvo_jax.model import checks, rollout
from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import UNTIMED_FIELDS, Array, ArrayLike, Batch, LatentState, Variables


@flax.struct.dataclass
class LiveState:
    """All that a stream remembers.

    Attributes:
      latent: LatentState [B, ...], after the last observation; zeros before the first one.
      keys: typed keys [B]; observation t of a sample uses fold_in(key, t), as `observe` does.
      frame: int32 [B], observations since the start of the stream.
    """

    latent: LatentState
    keys: Array
    frame: Array


def start_live(model: WorldModel, key: Array, batch_size: int = 1) -> LiveState:
    """The state before the first observation.

    Args:
      model: the model.
      key: typed key, or one per sample [B].
      batch_size: B, streams that are filtered side by side.
    """
    keys = rollout.sample_keys(key, batch_size)
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)  # the keys of the latents' noise in `observe`
    return LiveState(model.initial_state(batch_size), keys, jnp.zeros((batch_size,), jnp.int32))


def observe_step(model: WorldModel, variables: Variables, live: LiveState, observation: Mapping[str, ArrayLike],
                 previous_action: ArrayLike, *, sampled: bool = True) -> LiveState:
    """Takes in one raw observation. T calls give what `observe` gives for the window of T frames. Compiled once.

    Args:
      model, variables: the model.
      live: from start_live or the call before.
      observation: field of Batch -> array [B, ...] without time axis, in the units of Batch: "image", "range_view",
        "route_map", "speed_mps", whatever the model reads.
      previous_action: float32 [B, 2], applied between the last observation and this one; unused at the first.
      sampled: sample the latents; otherwise take their means.

    Returns:
      LiveState; imagine from its `latent`.

    Raises:
      ValueError: if shapes or dtypes do not fit the model, an action is out of range, or a concrete input not finite.
      TypeError: for forward-mode derivatives through convolutions that have none (ModelConfig.convolution).
    """
    batch_size = live.frame.shape[0]
    action = jnp.asarray(previous_action, jnp.float32)
    if action.shape != (batch_size, checks.ACTION_CHANNELS):
        raise ValueError(f"observe_step: got previous_action {list(action.shape)}, expected [{batch_size}, 2].")
    checks.action_values(previous_action, "observe_step")
    checks.state(model, live.latent)
    fields = {name: jnp.asarray(value) if name in UNTIMED_FIELDS else jnp.expand_dims(jnp.asarray(value), 1)
              for name, value in observation.items()}
    batch = Batch(action=jnp.expand_dims(action, 1), is_first=jnp.expand_dims(live.frame == 0, 1), **fields)
    checks.observation("observe_step", model, batch.validate())
    checks.finite("observe_step", state=live.latent)
    checks.forward_mode("observe_step", model, variables, live.latent, batch)
    return _observe_step(model, variables, live, batch, sampled)


@functools.partial(jax.jit, static_argnames=("model", "sampled"))
def _observe_step(model, variables, live, batch, sampled):
    embedding, _ = model.encode(variables, batch)
    shape = live.latent.stochastic.shape[1:]
    keys = jax.vmap(jax.random.fold_in)(live.keys, live.frame)
    noise = jax.vmap(lambda key: rollout.frame_noise(key, shape))(keys)
    if not sampled:
        noise = rollout.mean_mode(noise)
    latent, _ = model.observe_step(variables, noise, batch.action[:, 0], live.latent, embedding[:, 0],
                                   batch.is_first[:, 0])
    return LiveState(latent, live.keys, live.frame + 1)
