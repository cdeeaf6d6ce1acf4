"""What a head is: all that decoding one quantity takes, from its recorded truth to its picture, in one object.

A new head is one file that makes a `Head`, and its line in config.KNOWN_HEADS; docs/variants.md has one in full.
Model, losses, scores and pictures ask `get` for the Head of a name and know no head themselves. muvo_jax/heads has
those that there are. Nothing imports that folder: its files use every layer, and are found by the names in that table.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax import types
from muvo_jax.config import KNOWN_HEADS, Config, LossConfig, ModelConfig, VoxelGrid

SCALES = (1, 2, 4)  # of what is drawn: full size, half and quarter (paper section III-D)
Shapes = Mapping[str, tuple[int, ...]]
NamedSums = Mapping[str, np.ndarray]


class Sums(Protocol):
    """A pytree of numbers that add over samples and devices, such as regression.MeanSums."""

    def terms(self, name: str) -> dict[str, types.Array]:
        """{term: value} from the sums of a whole batch that stand under `name`."""
        ...


class FrozenNetwork(Protocol):
    """What the perceptual term asks of a frozen image network (objectives.perceptual.FrozenEncoder)."""

    def distance_sums(self, prediction: types.Array, target: types.Array) -> Sums:
        """How far the maps of two pictures are apart."""
        ...


@dataclasses.dataclass(frozen=True)
class Learned:
    """What the loss terms of a head are computed from.

    Attributes:
      predictions: scale -> [B, T, ...], at every scale of the head.
      batch: has the fields of the head's targets, and of those of its `term_targets` whose term is on.
      model, loss: units and settings.
      keys: typed keys [B, T], one per frame, for terms that draw.
      frozen: the network of the perceptual term, None where it is off.
    """

    predictions: Mapping[int, types.Array]
    batch: types.Batch
    model: ModelConfig
    loss: LossConfig
    keys: types.Array
    frozen: FrozenNetwork | None = None

    def truth(self, field: str) -> types.Array:
        """[B, T, ...], a field of the batch."""
        return jnp.asarray(getattr(self.batch, field))


@dataclasses.dataclass(frozen=True)
class TermTarget:
    """A Batch field that one term reads beside the head's targets, where the field `weight` of LossConfig is not 0."""

    weight: str
    shape: Callable[[ModelConfig], tuple[int, ...]]


@dataclasses.dataclass(frozen=True)
class Judged:
    """Predicted frames and what they are scored against.

    Attributes:
      frames: [B, T, ...], as the field of the batch holds them.
      truth: the same steps of the recording.
      config: of the run.
      seed: names these frames, for scores that draw a subset.
      threshold_m: a predicted return is a predicted range above this.
      movers: bool [B, T, X, Y, Z], the voxels that count as those of road users on the move; None where nobody knows.
      scans: of each frame the recorded scan, float32 [P, 3], ego frame, m; None where no score asks for them.
    """

    frames: np.ndarray
    truth: types.Batch
    config: Config
    seed: tuple[int, ...] = ()
    threshold_m: float = 0.0
    movers: np.ndarray | None = None
    scans: Sequence[Sequence[np.ndarray]] | None = None


@dataclasses.dataclass(frozen=True)
class Metric:
    """One score of a head's frames, and where it is shown.

    Attributes:
      sums: which of the head's `sums` it follows from.
      score: these sums, of any one shape -> scores of that shape, NaN where undefined.
      label, unit, decimals: as people read it; without a label it stands in evaluation.json alone.
      higher: whether higher is better.
      on_screen, by_step: whether evaluation shows it on the screen, and report.md every step of it.
      logged: its name in metrics.jsonl, where validation logs it of imagined frames; "" for not.
      error: from the score to the error that the run's skill is made of (metrics/skill.py); None leaves it out.
    """

    sums: str
    score: Callable[[NamedSums], np.ndarray]
    label: str = ""
    unit: str = ""
    decimals: int = 4
    higher: bool = True
    on_screen: bool = False
    by_step: bool = False
    logged: str = ""
    error: Callable[[float], float] | None = None


@dataclasses.dataclass(frozen=True)
class Picture:
    """One panel of the sheets and animations of viz/sheets.py.

    Attributes:
      name: in the margin, for people.
      draw: (one frame, the page's sheets.Scene, width in pixels) -> uint8 [rows, columns, 3].
      view: "sensor", as a sensor sees it; "above", a square seen from above; "ahead", in perspective.
      legend: which explanations it needs, of sheets.LEGEND.
    """

    name: str
    draw: Callable[[np.ndarray, Any, int], np.ndarray]
    view: str = "sensor"
    legend: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frames:
    """How the full-size predictions of a head are judged and drawn.

    Attributes:
      field: of types.Batch, what was recorded.
      of: (predictions [..., *size, channels], config) -> frames as that field has them; runs under jit.
      sums: from judged frames to sums that add over windows: name -> {part: float64 [B, T]}.
      metrics: name -> Metric; without its sums, which a setting may ask for, there is no score.
      error: (frames, truth, grid) -> the error of each frame, float64 [B, T], by which the answer to actions is
        measured (metrics/answers.py); None leaves the head out.
      error_name: what that error is of, for people.
      pictures: its panels, in the order in which they are shown.
    """

    field: str
    of: Callable[[types.Array, ModelConfig], types.Array]
    sums: Callable[[Judged], Mapping[str, NamedSums]]
    metrics: Mapping[str, Metric]
    error: Callable[[np.ndarray, types.Batch, VoxelGrid], np.ndarray] | None = None
    error_name: str = ""
    pictures: tuple[Picture, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guide:
    """How a head's decoder sees the memory (model/guided.py, docs/memory.md).

    Attributes:
      view: whose memory it looks at, "image", "range_view" or "occupancy"; its Glimpse of model/glimpse.py.
      plane: config -> full size; the ground plan of voxels, whose heights are channels.
      width: config -> channels of the decoder.
      channels: (config, scale) -> channels that it draws at a scale.
      shrink: sides of the deepest map are those of the plane over this, where a vector is unfolded to it.
      see: (glimpse, config) -> what the memory shows, as input channels [N, *plane, C].
      compose: (drawn, glimpse, average, config) -> {scale: output}: what is drawn, put upon what the memory shows and
        upon the average frame, which `average` adds to outputs {scale: [N, *plane / scale, channels]}.
      blurs: whether what is seen reaches what is drawn by a linear path too. What is uncertain of an image is best
        blurred, a linear function, and learned soonest as one. (Ranges are not: such a path moved every return a
        little.)
    """

    view: str
    plane: Callable[[ModelConfig], tuple[int, int]]
    width: Callable[[ModelConfig], int]
    channels: Callable[[ModelConfig, int], int]
    shrink: int
    see: Callable[[Any, ModelConfig], types.Array]
    compose: Callable[[dict[int, types.Array], Any, Any, ModelConfig], dict[int, types.Array]]
    blurs: bool = False


def as_drawn(value: types.Array, scale: int, config: ModelConfig) -> types.Array:
    """`Head.finish` of a network whose outputs are predictions as they are."""
    del scale, config
    return value


@dataclasses.dataclass(frozen=True, kw_only=True)
class Head:
    """One decoded quantity.

    Attributes:
      targets: the Batch fields that its loss reads -> their shapes for one frame.
      build: makes its decoder: features [N, ...] -> {scale: float32 [N, *size / scale, channels]}.
      losses: its loss terms, {name: Sums}; their `terms` are keys of `weights`.
      weights: every term that there may be -> its weight; where that is 0 the term need not be computed.
      scales: what the decoder returns; 1 is full size.
      tokens: which group of the 2D latent the decoder reads (muvo_jax.model.tokens), None for one vector of all groups;
        with the 1D latent it reads all features. It says whose grid the head draws on, too.
      finish: (output, scale, config) -> prediction in the batch's units (the range view in metres).
      initial_bias: bias of the last layers "head_SCALE" of a fresh model, the network's first guess.
      average: (metrics.baselines.TrainingMean, config) -> {scale: the average training frame in units of the outputs},
        which decoders start from (ModelConfig.first_guess); None where they start from zero.
      guide: how its decoder sees the memory (first_guess="last_seen"); None for one that does not. It needs an average.
      term_targets: Batch field -> the term that reads it beside the targets.
      frames: how it is judged and drawn; None for what is neither.
    """

    targets: Callable[[ModelConfig], Shapes]
    build: Callable[[ModelConfig], linen.Module]
    losses: Callable[[Learned], Mapping[str, Sums]]
    weights: Callable[[LossConfig], Mapping[str, float]]
    scales: tuple[int, ...] = (1,)
    tokens: str | None = None
    finish: Callable[[types.Array, int, ModelConfig], types.Array] = as_drawn
    initial_bias: float | None = None
    average: Callable[[Any, ModelConfig], Mapping[int, types.ArrayLike]] | None = None
    guide: Guide | None = None
    term_targets: Mapping[str, TermTarget] = dataclasses.field(default_factory=dict)
    frames: Frames | None = None

    def learns_from(self, model: ModelConfig, loss: LossConfig) -> dict[str, tuple[int, ...]]:
        """Batch field -> its shape for one frame, of everything that its terms read."""
        more = {field: target.shape(model) for field, target in self.term_targets.items()
                if getattr(loss, target.weight)}
        return {**self.targets(model), **more}


def get(name: str) -> Head:
    """The Head of that name in config.KNOWN_HEADS."""
    module, attribute = KNOWN_HEADS[name].split(":")
    return getattr(importlib.import_module(module), attribute)


def shown(names: tuple[str, ...] | None = None) -> dict[str, Frames]:
    """Of these heads (None: of all that there are) those that are judged and drawn, in the order of KNOWN_HEADS."""
    found = {name: get(name).frames for name in KNOWN_HEADS if names is None or name in names}
    return {name: frames for name, frames in found.items() if frames is not None}


def metrics() -> dict[str, Metric]:
    """Name -> metric, of all heads that there are."""
    return {name: metric for frames in shown().values() for name, metric in frames.metrics.items()}


def targets(config: Config) -> dict[str, tuple[int, ...]]:
    """What the loss terms of a model's heads compare with: Batch field -> its shape for one frame."""
    return {field: shape for name in config.model.heads
            for field, shape in get(name).learns_from(config.model, config.loss).items()}


def scaled(loss: LossConfig, *fields: str) -> dict[str, float]:
    """The weights of terms at every scale f, named FIELD_f, at 1/f of what these fields of LossConfig say."""
    return {f"{field}_{scale}": getattr(loss, field) / scale for field in fields for scale in SCALES}
