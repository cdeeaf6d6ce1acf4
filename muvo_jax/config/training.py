"""How a run is trained, on what, and how it is judged."""

from __future__ import annotations

import dataclasses
import operator
from typing import Annotated, Literal

from muvo_jax.geometry import RouteMap
from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, Limits, above, at_least, between, check

MOMENTUM = Limits(0, 1, open_high=True)
SIDE = between(-1000, 1000, "m")  # of a box around the lidar
SEED = between(0, 2**32 - 1)


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
      camera: which one, where a recording has several (KITTI: image_00 to image_03; nuScenes: CAM_FRONT, ...); "" is
        the reader's choice.
      key_frames: only these, where a recording has them (nuScenes: 2 a second instead of 10).
      frames, stride: a training window is `frames` frames, each `stride` recorded frames apart.
      context, horizon: evaluation observes `context` frames and imagines `horizon` more.
      town_seed, town_size: which town, and how much of it.
      cache_gib: decoded frames are kept in memory up to this size.
      workers: threads that read and decode batches ahead; 0 takes one for each processor but one, 2 to 16.
      skip_corrupt_shards: leave damaged shards of a packed recording out, counted, instead of stopping.
      route_map: scale of its route maps, and where the car stands in them; the recording says it.
    """

    path: str = "town"
    camera: str = ""
    key_frames: bool = False
    frames: Annotated[int, COUNT] = 12
    stride: Annotated[int, COUNT] = 2
    context: Annotated[int, COUNT] = 6
    horizon: Annotated[int, COUNT] = 6
    town_seed: Annotated[int, SEED] = 0
    town_size: Literal["default", "large", "tiny"] = "default"
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
      share_state: whether each device keeps only its share of parameters and of the optimiser's moments, gathered for a
        step: for models that do not fit otherwise. With shard_map alone.
      non_finite: what a batch does whose loss or gradient is not finite; none changes a parameter. "stop" ends the run
        with an error, "skip" goes on and counts it in metrics.jsonl (ten in a row are an error too).
      remat: what is computed again for the gradients instead of kept. "heads": what heads decode, one frame after the
        other, so that one frame of one head is in memory at a time. "frames": the steps of the filter too, whose
        attention over tokens fills the memory with the 2D latent of the paper's size. "none" takes least time.
      trainable: paths of the parameters that train, as patterns separated by commas: "decoders_*" trains the decoders
        alone, "!camera" all but the camera's encoder, "*" everything (see training/trainable.py).
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
    share_state: bool = False
    non_finite: Literal["stop", "skip"] = "stop"
    remat: Literal["none", "heads", "frames"] = "none"
    decode_frames: Annotated[int, NOT_NEGATIVE] = 0
    observe_frames: Annotated[int, NOT_NEGATIVE] = 0
    restart: bool = False
    trainable: str = "*"
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
      batch_norm: "running" statistics, or those of each "batch" of windows, which takes the RSSM dropout with it; only
        for comparison with the authors' figures, because a score then depends on what else is judged beside it.
      pixel_chamfer: also the distance of the authors, of so many random pixels, holes included; 0 leaves it out.
      scan_region_m: also scores along the rays of recorded scans (metrics/scans.py), inside this box, x, y, z of its
        lowest and then of its highest corner as the lidar of the last observed frame sees it; () leaves them out.
      scan_without_m: x, y of both corners of a box around the lidar whose returns are left out; () keeps all.
    """

    windows: Annotated[int, NOT_NEGATIVE] = 64
    batch: Annotated[int, COUNT] = 4
    chamfer_points: Annotated[int, NOT_NEGATIVE] = 2048
    return_threshold_m: Annotated[float, at_least(0, "m")] = 1.0
    sampled: bool = False
    seed: Annotated[int, SEED] = 0
    batch_norm: Literal["running", "batch"] = "running"
    pixel_chamfer: Annotated[int, NOT_NEGATIVE] = 0
    scan_region_m: Annotated[tuple[float, ...], SIDE] = ()
    scan_without_m: Annotated[tuple[float, ...], SIDE] = ()

    def __post_init__(self):
        check(self)
        for name, axes in (("scan_region_m", 3), ("scan_without_m", 2)):
            box = getattr(self, name)
            low, high = box[:axes], box[axes:]
            if box and (len(box) != 2 * axes or not all(map(operator.lt, low, high))):
                raise ValueError(f"evaluation.{name} is {list(box)}; expected {axes} numbers of a box's lowest corner, "
                                 f"then {axes} larger ones of its highest, or none.")
