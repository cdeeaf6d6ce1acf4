"""Config: all of a run."""

from __future__ import annotations

import dataclasses
from typing import Any

from muvo_jax.config import migration
from muvo_jax.config.augmentation import AugmentationConfig
from muvo_jax.config.contract import ActionContract, Kinematics
from muvo_jax.config.heads import LossConfig
from muvo_jax.config.model import ModelConfig
from muvo_jax.config.parsing import parse
from muvo_jax.config.parts import LastSeen
from muvo_jax.config.training import DataConfig, EvaluationConfig, OptimizerConfig, TrainConfig


@dataclasses.dataclass(frozen=True)
class Config:
    """All of a run. `to_dict` and `from_dict` are exact inverses."""

    preset: str = "paper-occupancy"
    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    data: DataConfig = DataConfig()
    augmentation: AugmentationConfig = AugmentationConfig()
    train: TrainConfig = TrainConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    contract: ActionContract = ActionContract()

    def __post_init__(self):
        needed = isinstance(self.model.first_guess, LastSeen) or self.model.action_path == "recurrence"
        known = needed and self.contract.kinematics == "bicycle"
        wanted = Kinematics(self.contract, self.data.stride) if known else None
        if self.model.kinematics != wanted:  # one truth: contract and stride
            object.__setattr__(self, "model", dataclasses.replace(self.model, kinematics=wanted))
        self.model.check_motion()

    @property
    def imagined_steps(self) -> int:
        """Steps that training imagines from the last observed frame; where it imagines none, as many as evaluation."""
        length, observed = self.data.frames, self.train.observe_frames
        return length - observed if 0 < observed < length else self.data.horizon

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, and the version of their names."""
        return {migration.VERSION_FIELD: migration.VERSION, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Config:
        """Rebuilds a config from `to_dict` or parsed JSON, also from what earlier versions wrote.

        Raises:
          ValueError: for an unknown field (naming the nearest known one), a value of the wrong type or a version from
            the future.
        """
        return parse(cls, migration.to_current(values), "config")
