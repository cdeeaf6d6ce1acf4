"""ModelConfig: the network, made of the parts of parts.py and of what all of its variants share."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from muvo_jax.config.contract import Kinematics
from muvo_jax.config.heads import HEADS, KNOWN_HEADS
from muvo_jax.config.parsing import check_choice
from muvo_jax.config.parts import (
    NO_SENSOR,
    Camera,
    FirstGuess,
    Fusion,
    LastSeen,
    Latent,
    Lidar,
    PlaneCamera,
    RangeViewLidar,
    TokenLatent,
    TransformerFusion,
    VectorLatent,
    ZeroGuess,
)
from muvo_jax.geometry import RangeViewGeometry, VoxelGrid
from muvo_jax.limits import COUNT, SHARE, Limits, RangeError, above, check

BACKBONES = ("resnet18", "mobilevitv2_100")
_DRAWN = ("image", "range_view", "depth", "semantic_image", "semantic_range_view", "birds_eye")  # decoder_channels wide


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. Defaults are the paper's size and the released 1D model (RV-WOB-TR with occupancy).

    Attributes:
      fusion, lidar, camera, latent: the variant, see `variant`; each is a part with settings of its own. Either lidar
        or camera may be None: then the model does not see that sensor (its heads are another matter).
      numerics: "standard" follows the mathematics, "reference" the authors' code (DEVIATIONS.md lists the difference).
        Without "reference" the authors' weights give other numbers than theirs.
      heads: what is decoded, of KNOWN_HEADS; a modality that the data lacks has no head.
      semantic_classes: of the heads semantic_image and semantic_range_view, as the recording counts them. Too few, and
        the labels of the others are read as none.
      route, speed: whether the planned route and the speed are inputs. Without them the model cannot know what a driver
        intends, and the head `action` guesses.
      route_encoder: a ResNet-18 as in the paper, which is larger than a small preset's whole transition, or "small".
      navigation: whether the route's command, the next one and the GPS targets are inputs.
      backbone: of image and range view; pillars, route and the maps of fc and avg keep a ResNet-18.
      image_size: rows, columns in pixels, each a multiple of 32. Smaller images hide what is far.
      range_view: the picture of a lidar scan: read with lidar "rv", predicted by its head, remembered by LastSeen.
      voxels: the grid of the heads occupancy and birds_eye.
      backbone_width: channels of the first ResNet-18 level (the others are 2, 4 and 8 times as wide); the levels of
        mobilevitv2_100 are 2, 4, 6 and 8 times as wide. Loaded image networks need 64.
      measurement_channels: of an encoded route, speed or command. Too few, and they drown among the sensors' channels.
      prior_dropout: probability that a training step goes on from the prior sample. Without it the filter has only ever
        gone on from what it saw, and imagination meets states that training never did.
      decoder_channels: width of the image and range-view decoders (512: 512, 512, 512, 512, 256, 128, 64).
      occupancy_channels: width of the voxel decoder.
      first_guess: what decoders start from. Without one a short training ends before they have found the sky.
      action_path: "prior": actions reach the prior and the posterior only, as in the paper. "recurrence": they and the
        step that they cause enter the recurrence too, and the start of every token. Without it a prior that reads one
        action among many tokens learns to ignore it.
      kinematics: what actions do, where they describe the motion; Config fills it in from contract and stride.
      range_view_points: "beams": x, y, z are drawn and learned as the difference from the point along the pixel's beam.
        With "free" a decoder must learn the geometry of the sensor first.
      occupied_above: a voxel is called occupied where its probability is above this. Most voxels are empty, and the
        decision that overlaps best is below one half: at the intersection over union J that it reaches, J / (1 + J).
      compute_dtype: of the matrix work; parameters, norms, softmax and losses stay float32.
      convolution: "auto" takes the forms of ops/conv.py that are fast on this backend, "xla" the plain ones (needed for
        forward-mode differentiation), "gemm" the CPU forms.
      range_scale_m, speed_scale_mps: the model's units. Far from what is usual, inputs and losses are tiny or huge.
    """

    fusion: Fusion = TransformerFusion()
    lidar: Lidar | None = RangeViewLidar()
    camera: Camera | None = PlaneCamera()
    latent: Latent = VectorLatent()
    numerics: Literal["standard", "reference"] = "standard"
    heads: tuple[str, ...] = HEADS
    semantic_classes: Annotated[int, COUNT] = 10
    route: bool = True
    speed: bool = True
    route_encoder: Literal["resnet18", "small"] = "resnet18"
    navigation: bool = False
    backbone: str = "resnet18"
    image_size: Annotated[tuple[int, int], COUNT] = (320, 832)
    range_view: RangeViewGeometry = RangeViewGeometry()
    voxels: VoxelGrid = VoxelGrid()
    backbone_width: Annotated[int, COUNT] = 64
    measurement_channels: Annotated[int, COUNT] = 16
    prior_dropout: Annotated[float, SHARE] = 0.15
    decoder_channels: Annotated[int, COUNT] = 512
    occupancy_channels: Annotated[int, COUNT] = 64
    first_guess: FirstGuess = ZeroGuess()
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
        remembers = isinstance(self.first_guess, LastSeen) and self.lidar is not None  # nothing moves without ranges
        return remembers or (self.action_path == "recurrence" and self.kinematics is not None)

    @property
    def variant(self) -> str:
        """The paper's name of the combination, such as RV-WOB-TR."""
        lidar, camera = (part.kind if part is not None else NO_SENSOR for part in (self.lidar, self.camera))
        return f"{lidar}-{camera}-{self.fusion.kind}".upper()

    def check_motion(self) -> None:
        """Refuses a model whose memory moves as the car moves where nothing says how that is.

        Whoever builds a network asks; a ModelConfig alone does not yet know its kinematics, see Config.

        Raises:
          ValueError: saying what to add.
        """
        if self.tracks_motion and self.kinematics is None and "ego_motion" not in self.heads:
            raise ValueError(f"model.first_guess=last_seen moves what was seen as the car moves, but neither actions "
                             f"say how (contract.kinematics is not 'bicycle', or the model does not come from a "
                             f"Config) nor one of the heads {', '.join(self.heads)}. Add the head ego_motion "
                             f"(--with-heads=ego_motion), choose model.first_guess=training_mean, or take the model of "
                             f"a Config whose contract.kinematics is 'bicycle'.")

    def __post_init__(self):
        check(self)
        check_choice("model.backbone", self.backbone, BACKBONES)
        for head in self.heads:
            check_choice("model.heads", head, tuple(KNOWN_HEADS))
        if not self.heads or len(set(self.heads)) < len(self.heads):
            raise ValueError(f"model.heads is {self.heads}; expected one or more heads, each once, of "
                             f"{', '.join(KNOWN_HEADS)}.")
        if self.lidar is None and self.camera is None:
            raise ValueError("model.lidar and model.camera are both none: a model needs one of them.")
        if any(side % 32 for side in self.image_size):
            raise ValueError(f"model.image_size {self.image_size}: rows and columns must be multiples of 32.")
        if self.range_view.rows % 32 or self.range_view.columns % 32:
            raise ValueError(f"model.range_view is {self.range_view.rows}x{self.range_view.columns}: rows and columns "
                             f"must be multiples of 32.")
        self._check_widths()
        if isinstance(self.latent, TokenLatent):
            self._check_tokens(self.latent)
        elif not {"occupancy", "birds_eye"}.isdisjoint(self.heads):
            self._check_voxels("occupancy_blocks", self.latent.occupancy_blocks)

    def _check_widths(self) -> None:
        """Some layers have a half or an eighth of a width; that must leave a channel."""
        guess, heads = self.first_guess, self.heads
        guided = guess.widths if isinstance(guess, LastSeen) and self.lidar is not None else {}
        if self.camera is None:
            guided.pop("image", None)
        drawn = [head for head in heads if head in _DRAWN and head not in guided]
        for field, least, needed, reason in (
                ("decoder_channels", 8, drawn, f"the heads {', '.join(drawn)}"),
                ("occupancy_channels", 8, "occupancy" in heads and "occupancy" not in guided, "the head occupancy"),
                ("measurement_channels", 2, self.navigation, "navigation"),
                ("backbone_width", 2, self.backbone == "mobilevitv2_100", f"backbone {self.backbone}")):
            if needed and getattr(self, field) < least:
                raise RangeError("ModelConfig", field, f"is {getattr(self, field)}; it must be at least {least} with "
                                 f"{reason}.")
        narrow = [head for head in heads if guided.get(head, 2) < 2]
        if isinstance(guess, LastSeen) and narrow:
            raise RangeError("ModelConfig", "first_guess.guided_channels", f"is {guess.guided_channels}; it must be at "
                             f"least 2 for each of the heads {', '.join(narrow)}.")

    def _check_tokens(self, latent: TokenLatent) -> None:
        if not isinstance(self.fusion, TransformerFusion):
            raise ValueError(f"model.latent=2d with model.fusion={self.fusion.kind}: the 2D latent is made of tokens, "
                             f"and only tr keeps tokens. Choose model.fusion=tr.")
        if self.fusion.token_channels % 12:
            raise ValueError(f"model.fusion.token_channels {self.fusion.token_channels} must be a multiple of 12 with "
                             f"model.latent=2d (sine and cosine of three axes).")
        self._check_voxels("occupancy_token_stages", latent.occupancy_token_stages)

    def _check_voxels(self, field: str, halvings: int) -> None:
        shrink = 2 ** (halvings + 3)
        if any(side % shrink for side in self.voxels.shape):
            raise ValueError(f"model.voxels.shape {self.voxels.shape}: each side must be a multiple of {shrink} "
                             f"(2**(model.latent.{field} + 3)).")
