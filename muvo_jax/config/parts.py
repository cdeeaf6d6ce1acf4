"""The parts that a model is made of, one class for each choice: a setting exists only where it acts.

A part is told by its class, `isinstance(config.latent, TokenLatent)`, and in JSON, on the command line and in messages
by its `kind`, "2d", which is no argument: the class says it. Defaults are the paper's sizes.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Annotated, Any, Literal, TypeVar

from muvo_jax.geometry import BirdsEyeGrid, PillarGrid
from muvo_jax.limits import COUNT, NOT_NEGATIVE, Limits, RangeError, check

DROPOUT = Limits(0, 1, open_high=True)
FLOW_LAGS = 3  # older observations that tell what moves by itself (LastSeen.follow_movers)
NO_SENSOR = "none"  # how a command says that a model does not see a sensor; in the configuration it is None
_Part = TypeVar("_Part")


@dataclasses.dataclass(frozen=True)
class VectorLatent:
    """The state is two vectors (paper section III-C, 1D), and an observation one vector that fusion pools.

    Attributes:
      embedding_channels: of an observation's vector. Too few, and the posterior knows less than the encoders saw.
      fused_channels: of each sensor's map once pooled, before they are joined (fusions tr and fc; avg pools to
        embedding_channels). Too few, and the join has nothing left to mix.
      keep_cells: fusion tr hands on every cell of the compressed maps instead of their mean. Without it a small map
        does not say what stands left and what right.
      deterministic_channels: of the recurrent state. Too few, and what is out of sight is forgotten.
      stochastic_channels: of the sampled state. Too few, and what cannot be foreseen has no room.
      action_channels: of an embedded action. Too few, and prior and posterior hardly hear two numbers among hundreds.
      occupancy_blocks: full-width stages of the voxel decoder, whose constant input has shape / 2**(blocks + 3)
        voxels. With too few of them that input is most of the grid, and parameters grow with it.
    """

    kind: Literal["1d"] = dataclasses.field(default="1d", init=False)
    embedding_channels: Annotated[int, COUNT] = 512
    fused_channels: Annotated[int, COUNT] = 512
    keep_cells: bool = False
    deterministic_channels: Annotated[int, COUNT] = 1024
    stochastic_channels: Annotated[int, COUNT] = 512
    action_channels: Annotated[int, COUNT] = 64
    occupancy_blocks: Annotated[int, NOT_NEGATIVE] = 3

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class TokenLatent:
    """The state is a row of tokens (the 2D latent), as many channels wide as the tokens of TransformerFusion.

    Attributes:
      transition_layers: of the transformers that are prior and posterior; heads, hidden channels and dropout are those
        of the fusion. Too few, and tokens cannot pass on what moves from one to another.
      aligned_tokens: each token starts from its own last value and what the observation has in its place
        (model/tokens.py); otherwise from a learned query alone, as in the paper. Without it attention must first find
        out which token is about what, which a short training does not.
      occupancy_token_stages: doublings at full width of the voxel decoder; the voxel tokens are a grid of
        shape / 2**(stages + 3). Too few, and there are so many of them that attention over them is slow.
    """

    kind: Literal["2d"] = dataclasses.field(default="2d", init=False)
    transition_layers: Annotated[int, COUNT] = 6
    aligned_tokens: bool = False
    occupancy_token_stages: Annotated[int, NOT_NEGATIVE] = 1

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class RangeViewLidar:
    """RV: points are read as the picture of ModelConfig.range_view."""

    kind: Literal["rv"] = dataclasses.field(default="rv", init=False)


@dataclasses.dataclass(frozen=True)
class PillarLidar:
    """PP: points are read one by one, as pillars on the ground (PointPillars).

    Attributes:
      grid: of the pillars. Points outside it are not seen, and those in one cell are hardly told apart.
    """

    kind: Literal["pp"] = dataclasses.field(default="pp", init=False)
    grid: PillarGrid = PillarGrid()

    def __post_init__(self):
        if self.grid.cells < 32 or self.grid.cells % 32:
            raise RangeError("PillarLidar", "grid", f"has {self.grid.cells} cells on a side (2 * half_side_m * "
                             f"cells_per_m); it must be a multiple of 32.")


@dataclasses.dataclass(frozen=True)
class PlaneCamera:
    """WOB, without bird's-eye view: images are read as they are."""

    kind: Literal["wob"] = dataclasses.field(default="wob", init=False)


@dataclasses.dataclass(frozen=True)
class BirdsEyeCamera:
    """BEV: what an image shows is lifted to the ground ahead.

    Attributes:
      grid: of the ground. What lies outside it is not seen.
    """

    kind: Literal["bev"] = dataclasses.field(default="bev", init=False)
    grid: BirdsEyeGrid = BirdsEyeGrid()

    def __post_init__(self):
        grid = self.grid
        if grid.cells < 4 or grid.cells % 4 or not 1 <= grid.lifted_bins <= grid.depth_bins:
            raise RangeError("BirdsEyeCamera", "grid", f": cells {grid.cells} must be a multiple of 4, and lifted_bins "
                             f"{grid.lifted_bins} lie between 1 and depth_bins {grid.depth_bins}.")


@dataclasses.dataclass(frozen=True)
class TransformerFusion:
    """TR: the cells of both sensors' maps are tokens of one transformer. The only fusion that the 2D latent has.

    Attributes:
      token_channels: of a token, here and in the 2D latent. Too few, and a token says little of its part of the world.
      layers, heads, hidden_channels: of the transformer. Too few, and a cell learns little from the other sensor's.
      dropout: of its training, and of the transformers of the 2D latent. Without it a long training on little data
        learns that data by heart; with it a short one learns less.
      many_tokens: the finest maps are seen, 16 times as many tokens (the reference's LARGE). Without it a token is
        32 pixels wide, and what is smaller shares it with others.
    """

    kind: Literal["tr"] = dataclasses.field(default="tr", init=False)
    token_channels: Annotated[int, COUNT] = 384
    layers: Annotated[int, COUNT] = 6
    heads: Annotated[int, COUNT] = 8
    hidden_channels: Annotated[int, COUNT] = 2048
    dropout: Annotated[float, DROPOUT] = 0.1
    many_tokens: bool = False

    def __post_init__(self):
        check(self)
        if self.token_channels % self.heads or self.token_channels % 4:
            raise RangeError("TransformerFusion", "token_channels", f"is {self.token_channels}; it must be a multiple "
                             f"of 4 and of heads, {self.heads}.")


@dataclasses.dataclass(frozen=True)
class ConcatenationFusion:
    """FC: each sensor's map becomes a vector, both are joined by a dense layer.

    Attributes:
      map_channels: of the maps that are pooled. Too few, and the pooled vectors are wider than what they are made of.
    """

    kind: Literal["fc"] = dataclasses.field(default="fc", init=False)
    map_channels: Annotated[int, COUNT] = 64

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class AverageFusion:
    """AVG: each sensor's map becomes a vector, their mean is what is seen.

    Attributes:
      map_channels: as those of ConcatenationFusion.
    """

    kind: Literal["avg"] = dataclasses.field(default="avg", init=False)
    map_channels: Annotated[int, COUNT] = 64

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class ZeroGuess:
    """Decoders draw everything, as in the paper. A short training ends before they have found the sky."""

    kind: Literal["zero"] = dataclasses.field(default="zero", init=False)


@dataclasses.dataclass(frozen=True)
class TrainingMean:
    """Decoders draw the difference from the average training frame; see model/decoders.py."""

    kind: Literal["training_mean"] = dataclasses.field(default="training_mean", init=False)


@dataclasses.dataclass(frozen=True)
class LastSeen:
    """Decoders start from what the sensors showed of late, moved by the motion of the car, and from the average
    training frame where that covers nothing; see model/memory.py.

    Attributes:
      memory_frames: so many observations are remembered. Too few, and what a passing car hides is empty.
      guided_channels: widths of the decoders of image, range view and occupancy that see the memory. Too few, and they
        copy it without mending its holes and its blur.
      follow_movers: what was seen to move by itself goes on moving in the memory of the voxels (ops/scene_flow.py).
        Without it, it stays where it was last seen, and training teaches the decoders to let it fade.
    """

    kind: Literal["last_seen"] = dataclasses.field(default="last_seen", init=False)
    memory_frames: Annotated[int, COUNT] = 6
    guided_channels: Annotated[tuple[int, int, int], COUNT] = (64, 64, 64)
    follow_movers: bool = False

    def __post_init__(self):
        check(self)
        if self.follow_movers and self.memory_frames <= FLOW_LAGS:
            raise ValueError(f"model.first_guess.follow_movers compares the newest observation with {FLOW_LAGS} before "
                             f"it, but model.first_guess.memory_frames is {self.memory_frames}; set it to "
                             f"{FLOW_LAGS + 1} or more.")

    @property
    def widths(self) -> dict[str, int]:
        """Head -> the width of its decoder that sees the memory."""
        return dict(zip(("image", "range_view", "occupancy"), self.guided_channels, strict=True))


Latent = VectorLatent | TokenLatent
Lidar = RangeViewLidar | PillarLidar
Camera = PlaneCamera | BirdsEyeCamera
Fusion = TransformerFusion | ConcatenationFusion | AverageFusion
FirstGuess = ZeroGuess | TrainingMean | LastSeen


def kinds(hint: Any) -> dict[str, Any]:
    """Kind -> class of the parts that a type names, `Latent` or `Lidar | None`; empty where it names none."""
    members = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    return {member.kind: member for member in members if dataclasses.is_dataclass(member) and hasattr(member, "kind")}


LATENTS, LIDARS, CAMERAS, FUSIONS = kinds(Latent), kinds(Lidar), kinds(Camera), kinds(Fusion)


def as_kind(part: Any, cls: type[_Part]) -> _Part:
    """The part, where only a model with a part of that class comes by; for the type checker, and for who is wrong."""
    assert isinstance(part, cls), part
    return part
