"""The frozen description of a run: every number that is not learned. Hashable, JSON in and out, checked on creation."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, Literal

from muvo_jax.config_augmentation import AugmentationConfig
from muvo_jax.config_heads import (
    ALL_HEADS,
    BIRDS_EYE_CLASSES,
    EGO_MOTION_UNITS,
    HEADS,
    TARGETS,
    TERM_TARGETS,
    LossConfig,
    head_targets,
)
from muvo_jax.config_json import check_choice, override, override_all, parse
from muvo_jax.geometry import BirdsEyeGrid, PillarGrid, RangeViewGeometry, RouteMap, VoxelGrid
from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, Limits, above, at_least, between, check

__all__ = ["ALL_HEADS", "BIRDS_EYE_CLASSES", "EGO_MOTION_UNITS", "HEADS", "TARGETS", "TERM_TARGETS", "ActionContract",
           "AugmentationConfig", "BirdsEyeGrid", "Config", "DataConfig", "EvaluationConfig", "LossConfig",
           "ModelConfig", "OptimizerConfig", "PillarGrid", "RangeViewGeometry", "RouteMap", "TrainConfig", "VoxelGrid",
           "head_targets", "override", "override_all", "parse"]

FUSIONS = ("tr", "fc", "avg")
LIDAR_ENCODERS = ("rv", "pp")
CAMERA_ENCODERS = ("wob", "bev")
NO_SENSOR = "none"  # in place of an encoder
LATENTS = ("1d", "2d")
FLOW_LAGS = 3  # older observations that tell what moves by itself
BACKBONES = ("resnet18", "mobilevitv2_100")
RATE_HZ = above(0, 10_000, "Hz")
STEERING_RAD = Limits(0, 0.5 * math.pi, open_low=True, open_high=True, unit="rad")
DROPOUT = MOMENTUM = Limits(0, 1, open_high=True)
SEED = between(0, 2**32 - 1)


@dataclasses.dataclass(frozen=True)
class ActionContract:
    """What the two numbers of an action mean, stored with every dataset and checkpoint.

    action = (acceleration, steering), each in [-1, 1]: acceleration > 0 is `accel_full_mps2` of throttle at 1, < 0 is
    `brake_full_mps2` of braking at -1; steering 1 turns the front wheels `steer_full_rad` to the right.

    Attributes:
      kinematics: "bicycle" where acceleration, steering and wheelbase describe the motion, else "none".
      source: "recorded" where the vehicle logged its actions, "derived" where they were computed from its motion.
      step_action: what stands for the recorded actions of a step of data.stride frames: their "mean", or the "first",
        as the reference takes it. A setting of the run; recordings say nothing of it.
    """

    accel_full_mps2: Annotated[float, above(0, 100, "m/s2")] = 3.0
    brake_full_mps2: Annotated[float, above(0, 100, "m/s2")] = 6.0
    steer_full_rad: Annotated[float, STEERING_RAD] = 0.6
    wheelbase_m: Annotated[float, above(0, 30, "m")] = 2.9
    rate_hz: Annotated[float, RATE_HZ] = 10.0
    kinematics: Literal["bicycle", "none"] = "bicycle"
    source: Literal["recorded", "derived"] = "recorded"
    step_action: Literal["mean", "first"] = "mean"

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """How one step of a model moves the car: the contract's bicycle for `periods` recorded periods."""

    contract: ActionContract = ActionContract()
    periods: Annotated[int, COUNT] = 1

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. Defaults are the paper's size and the released 1D model (RV-WOB-TR with occupancy).

    Attributes:
      fusion, lidar, camera, latent: the variant, see `variant`. Either lidar or camera may be "none": then the model
        does not see that sensor (its heads are another matter).
      numerics: "standard" follows the mathematics, "reference" the authors' code (DEVIATIONS.md lists the difference).
      heads: what is decoded, of config_heads.TARGETS; a modality that the data lacks has no head.
      semantic_classes: of the heads semantic_image and semantic_range_view, as the recording counts them.
      route, speed: whether the planned route and the speed are inputs.
      route_encoder: a ResNet-18 as in the paper, which is larger than a small preset's whole transition, or "small".
      navigation: whether the route's command, the next one and the GPS targets are inputs.
      backbone: of image and range view; pillars, route and the maps of fc and avg keep a ResNet-18.
      many_tokens: fusion "tr" sees the finest maps, 16 times as many tokens (the reference's LARGE).
      image_size: rows, columns in pixels, each a multiple of 32.
      pillars: the grid of lidar "pp".
      birds_eye: the grid of camera "bev".
      backbone_width: channels of the first ResNet-18 level (the others are 2, 4 and 8 times as wide); the levels of
        mobilevitv2_100 are 2, 4, 6 and 8 times as wide.
      map_channels: of the maps that fusions "fc" and "avg" pool.
      token_channels, transformer_*: the fusion transformer.
      fused_channels: channels of each sensor's pooled vector after fusion.
      keep_cells: fusion hands on every cell of the compressed maps instead of their mean.
      embedding_channels: size of the observation embedding.
      deterministic_channels, stochastic_channels, action_channels: the recurrent state-space model of the 1D latent.
      transition_layers: of the transformers that are prior and posterior of the 2D latent, whose tokens have
        token_channels; heads, hidden channels and dropout are those of transformer_*.
      aligned_tokens: each token of the 2D latent starts from its own last value and what the observation has in its
        place (model/tokens.py); otherwise from a learned query alone, as in the paper.
      prior_dropout: probability that a training step goes on from the prior sample.
      decoder_channels: width of the image and range-view decoders (512: 512, 512, 512, 512, 256, 128, 64).
      occupancy_channels, occupancy_blocks: width of the voxel decoder and number of its full-width stages; its
        constant input has shape / 2**(blocks + 3) voxels.
      occupancy_token_stages: doublings at full width of the 2D latent's voxel decoder; the voxel tokens are a grid of
        shape / 2**(stages + 3).
      first_guess: "training_mean": decoders draw the difference from the average training frame; see model/outputs.py.
        "last_seen": from what the sensors showed of late, moved by the motion of the car, and from the average where
        that covers nothing; see model/memory.py.
      memory_frames: so many observations are remembered for that.
      follow_movers: what was seen to move by itself goes on moving in the memory of the voxels (ops/scene_flow.py);
        otherwise it stays where it was last seen.
      guided_channels: widths of the decoders of image, range view and occupancy that see the memory.
      action_path: "prior": actions reach the prior and the posterior only, as in the paper. "recurrence": they and the
        step that they cause enter the recurrence too, and the start of every token.
      kinematics: what actions do, where they describe the motion; Config fills it in from contract and stride.
      range_view_points: "beams": x, y, z are drawn as the difference from the point along the pixel's beam.
      occupied_above: a voxel is called occupied where its probability is above this. Most voxels are empty, and the
        decision that overlaps best is below one half: at the intersection over union J that it reaches, J / (1 + J).
      compute_dtype: of the matrix work; parameters, norms, softmax and losses stay float32.
      convolution: "auto" takes the forms of ops/conv.py that are fast on this backend, "xla" the plain ones (needed for
        forward-mode differentiation), "gemm" the CPU forms.
      range_scale_m, speed_scale_mps: the model's units.
    """

    fusion: str = "tr"
    lidar: str = "rv"
    camera: str = "wob"
    latent: str = "1d"
    numerics: Literal["standard", "reference"] = "standard"
    heads: tuple[str, ...] = HEADS
    semantic_classes: Annotated[int, COUNT] = 10
    route: bool = True
    speed: bool = True
    route_encoder: Literal["resnet18", "small"] = "resnet18"
    navigation: bool = False
    backbone: str = "resnet18"
    many_tokens: bool = False
    image_size: Annotated[tuple[int, int], COUNT] = (320, 832)
    range_view: RangeViewGeometry = RangeViewGeometry()
    voxels: VoxelGrid = VoxelGrid()
    pillars: PillarGrid = PillarGrid()
    birds_eye: BirdsEyeGrid = BirdsEyeGrid()
    backbone_width: Annotated[int, COUNT] = 64
    map_channels: Annotated[int, COUNT] = 64
    token_channels: Annotated[int, COUNT] = 384
    transformer_layers: Annotated[int, COUNT] = 6
    transformer_heads: Annotated[int, COUNT] = 8
    transformer_hidden_channels: Annotated[int, COUNT] = 2048
    dropout: Annotated[float, DROPOUT] = 0.1
    fused_channels: Annotated[int, COUNT] = 512
    keep_cells: bool = False
    measurement_channels: Annotated[int, COUNT] = 16
    embedding_channels: Annotated[int, COUNT] = 512
    deterministic_channels: Annotated[int, COUNT] = 1024
    stochastic_channels: Annotated[int, COUNT] = 512
    action_channels: Annotated[int, COUNT] = 64
    transition_layers: Annotated[int, COUNT] = 6
    aligned_tokens: bool = False
    prior_dropout: Annotated[float, SHARE] = 0.15
    decoder_channels: Annotated[int, COUNT] = 512
    occupancy_channels: Annotated[int, COUNT] = 64
    occupancy_blocks: Annotated[int, NOT_NEGATIVE] = 3
    occupancy_token_stages: Annotated[int, NOT_NEGATIVE] = 1
    first_guess: Literal["zero", "training_mean", "last_seen"] = "zero"
    memory_frames: Annotated[int, COUNT] = 6
    follow_movers: bool = False
    guided_channels: Annotated[tuple[int, int, int], COUNT] = (64, 64, 64)
    action_path: Literal["prior", "recurrence"] = "prior"
    kinematics: Kinematics | None = None
    range_view_points: Literal["free", "beams"] = "free"
    occupied_above: Annotated[float, Limits(0, 1, open_low=True, open_high=True)] = 0.5
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    convolution: Literal["auto", "xla", "gemm"] = "auto"
    range_scale_m: Annotated[float, above(0, unit="m")] = 50.0
    speed_scale_mps: Annotated[float, above(0, unit="m/s")] = 5.0

    @property
    def tracks_motion(self) -> bool:
        """Whether states know where the car is and how fast (LatentState.vantage)."""
        remembers = self.first_guess == "last_seen" and self.lidar != NO_SENSOR  # nothing moves without ranges
        return remembers or (self.action_path == "recurrence" and self.kinematics is not None)

    @property
    def variant(self) -> str:
        """The paper's name of the combination, such as RV-WOB-TR."""
        return f"{self.lidar}-{self.camera}-{self.fusion}".upper()

    def __post_init__(self):
        check(self)
        for name, known in (("fusion", FUSIONS), ("lidar", (*LIDAR_ENCODERS, NO_SENSOR)), ("latent", LATENTS),
                            ("camera", (*CAMERA_ENCODERS, NO_SENSOR)), ("backbone", BACKBONES)):
            check_choice(f"model.{name}", getattr(self, name), known)
        for head in self.heads:
            check_choice("model.heads", head, ALL_HEADS)
        if any(side % 32 for side in self.image_size):
            raise ValueError(f"model.image_size {self.image_size}: rows and columns must be multiples of 32.")
        if self.range_view.rows % 32 or self.range_view.columns % 32:
            raise ValueError(f"model.range_view is {self.range_view.rows}x{self.range_view.columns}: rows and columns "
                             f"must be multiples of 32.")
        if self.token_channels % self.transformer_heads or self.token_channels % 4:
            raise ValueError(f"model.token_channels {self.token_channels} must be a multiple of 4 and of "
                             f"model.transformer_heads {self.transformer_heads}.")
        tokens = self.latent == "2d"
        if tokens and self.token_channels % 12:
            raise ValueError(f"model.token_channels {self.token_channels} must be a multiple of 12 with "
                             f"model.latent=2d (sine and cosine of three axes).")
        field = "occupancy_token_stages" if tokens else "occupancy_blocks"
        shrink = 2 ** (getattr(self, field) + 3)
        gridded = tokens or not {"occupancy", "birds_eye"}.isdisjoint(self.heads)
        if gridded and any(side % shrink for side in self.voxels.shape):
            raise ValueError(f"model.voxels.shape {self.voxels.shape}: each side must be a multiple of {shrink} "
                             f"(2**({field} + 3)).")
        if self.follow_movers and self.memory_frames <= FLOW_LAGS:
            raise ValueError(f"model.follow_movers compares the newest observation with {FLOW_LAGS} before it, but "
                             f"model.memory_frames is {self.memory_frames}; set it to {FLOW_LAGS + 1} or more.")
        self._check_variant()

    def _check_variant(self):
        """Refuses combinations that make no sense."""
        if self.lidar == self.camera == NO_SENSOR:
            raise ValueError("model.lidar and model.camera are both none: a model needs one of them.")
        if self.fusion != "tr":
            for setting, chosen, why in (
                    ("latent=2d", self.latent == "2d", "the 2D latent is made of tokens, and only tr keeps tokens"),
                    ("many_tokens=true", self.many_tokens, "only tr has tokens")):
                if chosen:
                    raise ValueError(f"model.{setting} with model.fusion={self.fusion}: {why}. Choose model.fusion=tr.")
        if self.lidar == "pp" and (self.pillars.cells < 32 or self.pillars.cells % 32):
            raise ValueError(f"model.pillars has {self.pillars.cells} cells on a side (2 * half_side_m * cells_per_m); "
                             f"it must be a multiple of 32.")
        if self.camera == "bev":
            grid = self.birds_eye
            if grid.cells < 4 or grid.cells % 4 or not 1 <= grid.lifted_bins <= grid.depth_bins:
                raise ValueError(f"model.birds_eye: cells {grid.cells} must be a multiple of 4, and lifted_bins "
                                 f"{grid.lifted_bins} lie between 1 and depth_bins {grid.depth_bins}.")


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """AdamW under torch's OneCycle schedule, as the reference trains.

    Attributes:
      weight_decay: applied to parameters with more than one axis.
      warmup_fraction: share of the steps until the peak.
      start_divisor, end_divisor: from peak / start_divisor up, and down to peak / start_divisor / end_divisor.
      clip_norm: global gradient norm, 0 for no clipping (the reference clips nothing).
      accumulate: micro-batches per update.
    """

    learning_rate: Annotated[float, above(0)] = 1e-4
    weight_decay: Annotated[float, NOT_NEGATIVE] = 0.01
    beta1_low: Annotated[float, MOMENTUM] = 0.85
    beta1_high: Annotated[float, MOMENTUM] = 0.95
    beta2: Annotated[float, MOMENTUM] = 0.999
    epsilon: Annotated[float, above(0)] = 1e-8
    warmup_fraction: Annotated[float, SHARE] = 0.2
    start_divisor: Annotated[float, above(0)] = 25.0
    end_divisor: Annotated[float, above(0)] = 1e4
    clip_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    accumulate: Annotated[int, COUNT] = 1

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Where the windows come from.

    Attributes:
      path: "town" (the built-in world) or a folder of recordings.
      camera: which one, where a recording has several (KITTI: image_00 to image_03); "" is the reader's choice.
      frames, stride: a training window is `frames` frames, each `stride` recorded frames apart.
      context, horizon: evaluation observes `context` frames and imagines `horizon` more.
      town_seed, town_size: which town, and how much of it ("default", "tiny").
      cache_gib: decoded frames are kept in memory up to this size.
      workers: threads that read and decode batches ahead; 0 takes one for each processor but one, 2 to 16.
      skip_corrupt_shards: leave damaged shards of a packed recording out, counted, instead of stopping.
      route_map: scale of its route maps, and where the car stands in them; the recording says it.
    """

    path: str = "town"
    camera: str = ""
    frames: Annotated[int, COUNT] = 12
    stride: Annotated[int, COUNT] = 2
    context: Annotated[int, COUNT] = 6
    horizon: Annotated[int, COUNT] = 6
    town_seed: Annotated[int, SEED] = 0
    town_size: str = "default"
    cache_gib: Annotated[float, NOT_NEGATIVE] = 1.5
    workers: Annotated[int, NOT_NEGATIVE] = 0
    skip_corrupt_shards: bool = False
    route_map: RouteMap = RouteMap()

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How long, how wide and how often.

    Attributes:
      batch: windows per micro-batch over all devices; an update uses batch * optimizer.accumulate windows.
      validate_every, checkpoint_every, preview_every: in steps; 0 means at the end only.
      validation_windows: windows of each split looked at during training (evaluate uses all of them).
      keep_last, keep_best: how many checkpoints stay.
      decode_frames: how many frames of a window are decoded in a training step, drawn anew each time; 0 means all.
      observe_frames: so many frames of a training window are observed, the rest imagined from the last of them; 0
        observes all.
      restart: the observed frames of a training window are cut in two at a frame drawn anew in each step, so that the
        filter is trained on 1 to observe_frames of them.
      parallel: "auto" uses shard_map over all devices where there is more than one.
      backbone_weights: file of an image network that fresh encoders start from; "" for none.
      perceptual_from: such a file, or a run whose image encoder is taken, for the perceptual term; "" for none.
    """

    steps: Annotated[int, COUNT] = 50_000
    batch: Annotated[int, COUNT] = 1
    seed: Annotated[int, SEED] = 0
    log_every: Annotated[int, COUNT] = 10
    validate_every: Annotated[int, NOT_NEGATIVE] = 1000
    checkpoint_every: Annotated[int, NOT_NEGATIVE] = 1000
    preview_every: Annotated[int, NOT_NEGATIVE] = 1000
    validation_windows: Annotated[int, COUNT] = 16
    keep_last: Annotated[int, NOT_NEGATIVE] = 2
    keep_best: Annotated[int, NOT_NEGATIVE] = 1
    parallel: Literal["auto", "pmap", "shard_map"] = "auto"
    remat: bool = False
    decode_frames: Annotated[int, NOT_NEGATIVE] = 0
    observe_frames: Annotated[int, NOT_NEGATIVE] = 0
    restart: bool = False
    backbone_weights: str = ""
    perceptual_from: str = ""

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """The protocol of docs/design.md: metrics of observed and imagined frames beside baselines.

    Attributes:
      windows: at most this many windows of a split, evenly spread; 0 means all.
      chamfer_points: size of the keyed subset of returns per frame; 0 means all.
      return_threshold_m: a predicted return is a predicted range above this.
      sampled: imagine with sampled latents; otherwise with their means.
    """

    windows: Annotated[int, NOT_NEGATIVE] = 64
    batch: Annotated[int, COUNT] = 4
    chamfer_points: Annotated[int, NOT_NEGATIVE] = 2048
    return_threshold_m: Annotated[float, at_least(0, "m")] = 1.0
    sampled: bool = False
    seed: Annotated[int, SEED] = 0

    def __post_init__(self):
        check(self)


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
        needed = self.model.first_guess == "last_seen" or self.model.action_path == "recurrence"
        known = needed and self.contract.kinematics == "bicycle"
        wanted = Kinematics(self.contract, self.data.stride) if known else None
        if self.model.first_guess == "last_seen" and wanted is None and "ego_motion" not in self.model.heads:
            raise ValueError(f"model.first_guess=last_seen moves what was seen as the car moves, but "
                             f"contract.kinematics is {self.contract.kinematics!r} and the model has the heads "
                             f"{', '.join(self.model.heads)}. Add the head ego_motion (--with-heads=ego_motion) or "
                             f"choose model.first_guess=training_mean.")
        if self.model.kinematics != wanted:  # one truth: contract and stride
            object.__setattr__(self, "model", dataclasses.replace(self.model, kinematics=wanted))

    @property
    def targets(self) -> dict[str, tuple[int, ...]]:
        """What the loss terms of the heads compare with: Batch field -> its shape for one frame."""
        return {field: shape for head in self.model.heads
                for field, shape in head_targets(head, self.model, self.loss).items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Config:
        """Rebuilds a config from `to_dict` or parsed JSON.

        A contract that says nothing of step_action is of a run from before there was a choice: it took the first.

        Raises:
          ValueError: for an unknown field (naming the nearest known one) or a value of the wrong type.
        """
        if isinstance(values, dict) and isinstance(values.get("contract"), dict):
            values = values | {"contract": {"step_action": "first"} | values["contract"]}
        return parse(cls, values, "config")
