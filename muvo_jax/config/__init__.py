"""The frozen description of a run: every number that is not learned. Hashable, JSON in and out, checked on creation.

    whole.py      Config: the model, the loss, the data, training, evaluation and what actions mean
    model.py      ModelConfig, made of the parts of parts.py: a setting exists only where it acts
    parts.py      VectorLatent or TokenLatent, RangeViewLidar or PillarLidar, and so on
    sizes.py      what a part is like in each preset, for a model that changes one
    settings.py   one setting by its dotted name, as --set gives it
    migration.py  config.json of earlier versions
    parsing.py    frozen dataclasses from JSON

heads.py, contract.py, training.py and augmentation.py have the other sections.
"""

from muvo_jax.config.augmentation import AugmentationConfig
from muvo_jax.config.contract import RATE_HZ, ActionContract, Kinematics
from muvo_jax.config.heads import BIRDS_EYE_CLASSES, HEADS, KNOWN_HEADS, LossConfig
from muvo_jax.config.model import BACKBONES, ModelConfig
from muvo_jax.config.parsing import check_choice, parse
from muvo_jax.config.parts import (
    CAMERAS,
    FLOW_LAGS,
    FUSIONS,
    LATENTS,
    LIDARS,
    NO_SENSOR,
    AverageFusion,
    BirdsEyeCamera,
    ConcatenationFusion,
    LastSeen,
    Latent,
    PillarLidar,
    PlaneCamera,
    RangeViewLidar,
    TokenLatent,
    TrainingMean,
    TransformerFusion,
    VectorLatent,
    ZeroGuess,
    as_kind,
)
from muvo_jax.config.settings import override, override_all
from muvo_jax.config.training import DataConfig, EvaluationConfig, OptimizerConfig, TrainConfig
from muvo_jax.config.whole import Config
from muvo_jax.geometry import BirdsEyeGrid, PillarGrid, RangeViewGeometry, RouteMap, VoxelGrid

__all__ = ["BACKBONES", "BIRDS_EYE_CLASSES", "CAMERAS", "FLOW_LAGS", "FUSIONS", "HEADS", "KNOWN_HEADS", "LATENTS",
           "LIDARS", "NO_SENSOR", "RATE_HZ", "ActionContract", "AugmentationConfig", "AverageFusion",
           "BirdsEyeCamera", "BirdsEyeGrid", "ConcatenationFusion", "Config", "DataConfig", "EvaluationConfig",
           "Kinematics", "LastSeen", "Latent", "LossConfig", "ModelConfig", "OptimizerConfig", "PillarGrid",
           "PillarLidar", "PlaneCamera", "RangeViewGeometry", "RangeViewLidar", "RouteMap", "TokenLatent",
           "TrainConfig", "TrainingMean", "TransformerFusion", "VectorLatent", "VoxelGrid", "ZeroGuess", "as_kind",
           "check_choice", "override", "override_all", "parse"]
