"""Everything that a run must carry to go on exactly where it stopped."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from muvo_jax import types
from muvo_jax.training import trainable as trainable_lib


@flax.struct.dataclass
class TrainState:
    """The carry of the training loop, the same tree on one device and on many.

    Attributes:
      step: int32 scalar, optimiser steps done.
      params, batch_stats: the two parts of the model's variables.
      opt_state: of the optimiser, for the parameters that train.
      key: typed key of the run; the randomness of step n is fold_in(key, n), so a resumed run replays it.
    """

    step: types.Array
    params: Any
    batch_stats: Any
    opt_state: Any
    key: types.Array

    @property
    def variables(self) -> types.Variables:
        """What the model's functions take."""
        return {"params": self.params, "batch_stats": self.batch_stats}


def create(variables: types.Variables, optimizer: optax.GradientTransformation, key: types.Array,
           trainable: str = trainable_lib.EVERYTHING) -> TrainState:
    """A state at step 0.

    The training step donates its state, so every leaf is copied: the caller's `variables` and `key` stay usable.

    Args:
      variables: from `WorldModel.init` or a checkpoint.
      optimizer: from `optimizer.make_optimizer`.
      key: typed key of the run.
      trainable: config.train.trainable of the step that will be taken.

    Raises:
      ValueError: where a pattern of `trainable` fits no parameter, or none is left to train.
    """
    variables = jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), dict(variables))
    params = variables["params"]
    trained, _ = trainable_lib.split(params, trainable_lib.chosen(params, trainable))
    return TrainState(step=jnp.int32(0), params=params, batch_stats=variables.get("batch_stats", {}),
                      opt_state=optimizer.init(trained), key=jax.random.clone(key))
