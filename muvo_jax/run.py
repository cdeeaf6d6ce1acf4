"""A trained run in the hand: what `muvo_jax.load` returns and commands and agents start from."""

from __future__ import annotations

import dataclasses
import pathlib
import warnings as python_warnings
from collections.abc import Iterator, Mapping
from typing import Any

from muvo_jax import config as config_lib
from muvo_jax.model import world_model
from muvo_jax.types import Variables


@dataclasses.dataclass(frozen=True)
class Run:
    """A world model, its weights, and where they came from.

    One made by hand, of fresh weights, needs the first three alone.

    Attributes:
      model: the world model.
      variables: {"params", "batch_stats"}, on the first device.
      config: the whole configuration of the run.
      step: updates done.
      folder: the run's folder, where commands write; the current one where there is none.
      provenance: what the model was trained on.
      warnings: damaged checkpoints that were passed over.
    """

    model: world_model.WorldModel
    variables: Variables
    config: config_lib.Config
    step: int = 0
    folder: pathlib.Path = pathlib.Path()
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def contract(self) -> config_lib.ActionContract:
        """What an action of 1 means, and how many steps a second the recording has."""
        return self.config.contract

    def __iter__(self) -> Iterator[Any]:
        """(model, variables), as muvo_jax.load returned them at first; goes with the release after 0.1."""
        python_warnings.warn("model, variables = muvo_jax.load(...) goes with the release after 0.1; write run = "
                             "muvo_jax.load(...), then run.model and run.variables.", DeprecationWarning, stacklevel=2)
        return iter((self.model, self.variables))
