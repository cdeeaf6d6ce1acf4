"""Named configurations. A flag of the command line beats a preset, a preset beats the defaults of config/.

What its parts are like, the ones that it does not have included, config/sizes.py says.
"""

from __future__ import annotations

import dataclasses
import difflib
import math

from muvo_jax import config as config_lib
from muvo_jax.config import sizes


def town() -> config_lib.Config:
    """The default: a world model small enough to learn the built-in town on two CPU cores in minutes.

    A few hundred updates are too few for the paper's recipe. Decoders start from what was last seen, moved by the
    actions, and from the average training frame where that covers nothing; each token of the 2D latent starts from what
    the observation has in its place, and fusion into a vector keeps the few cells of the small maps apart. A training
    window is as long as evaluation's: six frames are observed, cut in two at a frame drawn anew, so that a dream starts
    after one to six of them, and six are imagined; two of the twelve are decoded. Mirrored windows and windows in
    another light stand in for towns and weathers that are not there.
    Image, range, points and the cross-entropy of occupancy weigh more than in the paper, where action and KL
    divergence speak loudest, and the affinity losses less: alone they call a voxel occupied that is so in a third of
    the frames.
    """
    model = config_lib.ModelConfig(
        fusion=sizes.of("town", config_lib.TransformerFusion),
        latent=sizes.of("town", config_lib.TokenLatent),
        first_guess=config_lib.LastSeen(follow_movers=True),
        image_size=(64, 256),
        range_view=config_lib.RangeViewGeometry(rows=64, columns=128),
        voxels=config_lib.VoxelGrid(shape=(48, 48, 8), voxel_size_m=1.0, origin_m=(-24.0, -24.0, -1.5)),
        backbone_width=8,
        decoder_channels=64,
        occupancy_channels=32,
        occupied_above=0.3,
        action_path="recurrence",
        route_encoder="small",
        range_view_points="beams",
    )
    return config_lib.Config(
        preset="town",
        model=model,
        loss=config_lib.LossConfig(image=1.5, image_squared=8.0, range_xyz=10.0, range_depth=2.0, chamfer=4.0,
                                   occupancy_cross_entropy=3.0, occupancy_semantic_scal=0.05,
                                   occupancy_geometric_scal=0.05, occupancy_unknown_weight=0.15, action=0.2, kl=5e-4),
        augmentation=config_lib.AugmentationConfig(mirror=True, light=True),
        optimizer=config_lib.OptimizerConfig(learning_rate=3e-3, warmup_fraction=0.1, clip_norm=10.0),
        data=config_lib.DataConfig(frames=12),
        train=config_lib.TrainConfig(steps=200, batch=8, decode_frames=2, observe_frames=6, restart=True,
                                     validate_every=100, checkpoint_every=100, preview_every=200, validation_windows=8),
        evaluation=config_lib.EvaluationConfig(windows=32),
    )


def tiny() -> config_lib.Config:
    """For tests and for a first look at the code: everything runs, nothing is learned."""
    model = config_lib.ModelConfig(
        fusion=sizes.of("tiny", config_lib.TransformerFusion),
        latent=sizes.of("tiny", config_lib.VectorLatent),
        image_size=(32, 64),
        range_view=config_lib.RangeViewGeometry(rows=32, columns=64),
        voxels=config_lib.VoxelGrid(shape=(16, 16, 16), voxel_size_m=2.0, origin_m=(-16.0, -16.0, -3.0)),
        backbone_width=4,
        decoder_channels=8,
        occupancy_channels=8,
    )
    return config_lib.Config(
        preset="tiny",
        model=model,
        optimizer=config_lib.OptimizerConfig(learning_rate=1e-3),
        data=config_lib.DataConfig(frames=4, context=2, horizon=2, town_size="tiny", cache_gib=0.1),
        train=config_lib.TrainConfig(steps=4, batch=2, log_every=1, validate_every=2, checkpoint_every=2,
                                     preview_every=4, validation_windows=2),
        evaluation=config_lib.EvaluationConfig(windows=4, batch=2, chamfer_points=256),
    )


# The authors train with changed images and routes, and keep one of the actions of a step.
_AUGMENTED = config_lib.AugmentationConfig(image=True, route=True)
_CONTRACT = config_lib.ActionContract(step_action="first")


def paper() -> config_lib.Config:
    """The paper's camera and lidar model (section IV): 12 frames, 6 of them observed, batch 16 by accumulation."""
    return config_lib.Config(
        preset="paper",
        model=config_lib.ModelConfig(heads=("image", "range_view", "action")),
        optimizer=config_lib.OptimizerConfig(accumulate=16),
        augmentation=_AUGMENTED,
        contract=_CONTRACT,
    )


def paper_occupancy() -> config_lib.Config:
    """The paper's model with occupancy: 6 frames, 4 observed and 2 imagined.

    The built-in town is recorded in its smallest size only: at these sensor sizes a frame takes about a second. Heads
    decode frame by frame in training: the voxels of all six at once are most of a step's memory (docs/performance.md).
    """
    return config_lib.Config(
        preset="paper-occupancy",
        optimizer=config_lib.OptimizerConfig(accumulate=16),
        augmentation=_AUGMENTED,
        contract=_CONTRACT,
        data=config_lib.DataConfig(frames=6, context=4, horizon=2, town_size="tiny"),
        train=config_lib.TrainConfig(remat="heads"),
    )


def _reference(preset: str, loss: config_lib.LossConfig, **model) -> config_lib.Config:
    """What the authors' released models share: their numerics, lengths and schedule, over 6 observed frames.

    Heads decode frame by frame, as in `paper_occupancy`.
    """
    return config_lib.Config(
        preset=preset,
        model=config_lib.ModelConfig(numerics="reference", **model),
        loss=dataclasses.replace(loss, occupancy_unknown="empty"),
        optimizer=config_lib.OptimizerConfig(accumulate=16),
        augmentation=_AUGMENTED,
        contract=_CONTRACT,
        data=config_lib.DataConfig(frames=6, context=6, horizon=10, town_size="tiny"),
        train=config_lib.TrainConfig(steps=100_000, remat="heads"),
    )


def reference_1d() -> config_lib.Config:
    """The released 1D model with occupancy, RV-WOB-TR (176 million parameters, the unused ones included)."""
    return _reference("reference-1d", config_lib.LossConfig(), latent=config_lib.VectorLatent())


# The authors' 2D code trains occupancy by geometric affinity alone.
_REFERENCE_2D_LOSS = config_lib.LossConfig(occupancy_cross_entropy=0.0, occupancy_semantic_scal=0.0)


def reference_2d() -> config_lib.Config:
    """The released 2D model, RV-WOB-TR (119 million parameters)."""
    return _reference("reference-2d", _REFERENCE_2D_LOSS, latent=config_lib.TokenLatent())


def reference_mobilevit() -> config_lib.Config:
    """The released 2D model whose backbones are MobileViT-V2 (114 million parameters)."""
    return _reference("reference-mobilevit", _REFERENCE_2D_LOSS, latent=config_lib.TokenLatent(),
                      backbone="mobilevitv2_100")


PRESETS = {"town": town, "tiny": tiny, "paper": paper, "paper-occupancy": paper_occupancy,
           "reference-1d": reference_1d, "reference-2d": reference_2d, "reference-mobilevit": reference_mobilevit}


def get(name: str) -> config_lib.Config:
    """Returns the preset of that name.

    Raises:
      ValueError: naming the known presets and the nearest one.
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1, cutoff=math.sqrt(0.1))
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ValueError(f"preset {name!r} is unknown; known are {', '.join(PRESETS)}.{hint}")
    return PRESETS[name]()
