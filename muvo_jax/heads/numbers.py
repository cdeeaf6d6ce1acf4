"""Optional heads that say a few numbers of each frame: reward, whether the drive goes on, the car's own motion."""

from __future__ import annotations

import jax.numpy as jnp

from muvo_jax import head, types
from muvo_jax.config import ModelConfig
from muvo_jax.model import decoders
from muvo_jax.nn import layers
from muvo_jax.objectives import regression

_EGO_MOTION_UNITS = (1.0, 0.1, 0.05, 5.0)  # m forward, m left, rad, m/s: about what a step of 0.2 s brings


def _reward_losses(learned: head.Learned) -> dict[str, head.Sums]:
    return {"reward": regression.l2_sums(learned.predictions[1], learned.truth("reward")[..., None])}


def _continue_losses(learned: head.Learned) -> dict[str, head.Sums]:
    going_on = ~learned.truth("is_terminal")
    return {"continue": regression.binary_cross_entropy_sums(learned.predictions[1][..., 0], going_on)}


def _ego_motion_losses(learned: head.Learned) -> dict[str, head.Sums]:
    """The speed of every frame, the motion of those that have a frame before them in the window."""
    unit = jnp.asarray(_EGO_MOTION_UNITS, jnp.float32).reshape(1, 1, -1)
    prediction, target = learned.predictions[1] / unit, learned.truth("ego_motion") / unit
    moved = ~jnp.asarray(learned.batch.is_first)
    return {"ego_motion": regression.l1_sums(prediction[..., :3], target[..., :3], moved),
            "ego_speed": regression.l1_sums(prediction[..., 3:], target[..., 3:])}


def _ego_motion_finish(value: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """As types.Batch.ego_motion."""
    del scale, config
    return value * layers.per_channel(jnp.asarray(_EGO_MOTION_UNITS, jnp.float32), value.ndim)


REWARD = head.Head(  # as recorded with the frame
    targets=lambda model: {"reward": ()}, build=lambda model: decoders.of_numbers(model, 1),
    losses=_reward_losses, weights=lambda loss: {"reward": loss.reward})
CONTINUE = head.Head(  # logit of the drive not being over
    targets=lambda model: {"is_terminal": ()}, build=lambda model: decoders.of_numbers(model, 1),
    losses=_continue_losses, weights=lambda loss: {"continue": loss.continue_})
EGO_MOTION = head.Head(
    targets=lambda model: {"ego_motion": (4,)}, build=lambda model: decoders.of_numbers(model, 4),
    finish=_ego_motion_finish, losses=_ego_motion_losses,
    weights=lambda loss: {"ego_motion": loss.ego_motion, "ego_speed": loss.ego_motion})
