"""DreamerV3's way to imagine: `imagine(start, policy, length)`, time on axis 1, the start in front."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from muvo_jax.model import rollout
from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import Array, ArrayLike, LatentState, Variables


@dataclasses.dataclass(frozen=True)
class Dreamer:
    """A world model behind DreamerV3's interface.

    Attributes:
      model, variables: of a run.
      sampled: sample the latents; otherwise their means.
    """

    model: WorldModel
    variables: Variables
    sampled: bool = True

    def imagine(self, key: Array, start: LatentState, policy: rollout.Policy | ArrayLike,
                length: int) -> tuple[LatentState, Array, Array]:
        """Imagines from states [B, ...].

        Args:
          key: typed key.
          start: LatentState [B, ...].
          policy: (key, features) -> action, or actions [B, length, 2].
          length: steps.

        Returns:
          the last state [B, ...], features [B, length, F] and actions [B, length, 2]; features[t] is what action[t]
          was chosen on, as in DreamerV3 (features[0] is the start).
        """
        dream = rollout.imagine(self.model, self.variables, key, start, policy, horizon=length, sampled=self.sampled)
        first: Any = jnp.expand_dims(start.features, 1)
        features = jnp.concatenate([first, dream.features[:, :-1]], axis=1)
        return jax.tree.map(lambda leaf: leaf[:, -1], dream.states), features, dream.actions
