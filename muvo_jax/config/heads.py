"""Which heads there are, and the weights of their loss terms."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, above, at_least, check

# Head -> "module:name" of the muvo_jax.head.Head that is all of it. A new head is a line here and the file it names.
KNOWN_HEADS = {
    "image": "muvo_jax.heads.image:HEAD",
    "range_view": "muvo_jax.heads.range_view:HEAD",
    "occupancy": "muvo_jax.heads.occupancy:HEAD",
    "action": "muvo_jax.heads.action:HEAD",
    "depth": "muvo_jax.heads.maps:DEPTH",
    "semantic_image": "muvo_jax.heads.maps:SEMANTIC_IMAGE",
    "semantic_range_view": "muvo_jax.heads.maps:SEMANTIC_RANGE_VIEW",
    "birds_eye": "muvo_jax.heads.birds_eye:HEAD",
    "reward": "muvo_jax.heads.numbers:REWARD",
    "continue": "muvo_jax.heads.numbers:CONTINUE",
    "ego_motion": "muvo_jax.heads.numbers:EGO_MOTION",
}
HEADS = ("image", "range_view", "occupancy", "action")  # of the paper; the others are optional
BIRDS_EYE_CLASSES = 8


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (paper Eq. 1) at scale 1; scale f counts 1/f. A head may bring weights of its own.

    `image` (L1), `image_squared` (L2, an addition to the paper), `range_xyz`, `range_depth` and `occupancy_*` apply per
    scale; 0 switches a term off. The Chamfer term looks at `chamfer_points` returns of each side; a predicted return is
    a predicted range above `return_threshold_m`. Where unknown voxels are ignored, each still counts
    `occupancy_unknown_weight` as an empty one in the cross-entropy: without it a model fills what no ray has reached.
    Off by default are `image_similarity` (1 - structural similarity; the reference's weight is 0.06 with the 1D latent,
    0.03 with the 2D one), `image_perceptual` (0.1 there), `image_instance` (the L1 again, averaged over the pixels of
    vehicles and pedestrians; 0.05 there, RGB_INSTANCE) and `occupancy_dice`.

    Of the optional heads: `depth` (L1), cross-entropies `semantic_image`, `semantic_range_view` and `birds_eye`, L2 of
    the `birds_eye_centre` map and, at the same weight at every scale, L1 of the `birds_eye_offset` in cells. The
    `*_weights` are of each class (empty: 1); of each frame only the `*_share` of the pixels predicted worst count.
    `reward` is an L2, `continue_` a cross-entropy, `ego_motion` an L1 in units of about what a step brings.
    """

    image: Annotated[float, NOT_NEGATIVE] = 0.1
    image_squared: Annotated[float, NOT_NEGATIVE] = 0.0
    range_xyz: Annotated[float, NOT_NEGATIVE] = 0.1
    range_depth: Annotated[float, NOT_NEGATIVE] = 0.1
    occupancy_cross_entropy: Annotated[float, NOT_NEGATIVE] = 0.1
    occupancy_semantic_scal: Annotated[float, NOT_NEGATIVE] = 0.1
    occupancy_geometric_scal: Annotated[float, NOT_NEGATIVE] = 0.1
    chamfer: Annotated[float, NOT_NEGATIVE] = 0.0
    action: Annotated[float, NOT_NEGATIVE] = 1.0
    image_similarity: Annotated[float, NOT_NEGATIVE] = 0.0
    image_perceptual: Annotated[float, NOT_NEGATIVE] = 0.0
    image_instance: Annotated[float, NOT_NEGATIVE] = 0.0
    occupancy_dice: Annotated[float, NOT_NEGATIVE] = 0.0
    depth: Annotated[float, NOT_NEGATIVE] = 0.1
    semantic_image: Annotated[float, NOT_NEGATIVE] = 0.1
    semantic_range_view: Annotated[float, NOT_NEGATIVE] = 0.1
    birds_eye: Annotated[float, NOT_NEGATIVE] = 0.1
    birds_eye_centre: Annotated[float, NOT_NEGATIVE] = 20.0
    birds_eye_offset: Annotated[float, NOT_NEGATIVE] = 0.01
    reward: Annotated[float, NOT_NEGATIVE] = 1.0
    continue_: Annotated[float, NOT_NEGATIVE] = 1.0
    ego_motion: Annotated[float, NOT_NEGATIVE] = 0.1
    kl: Annotated[float, NOT_NEGATIVE] = 1e-3
    kl_balance: Annotated[float, SHARE] = 0.75
    chamfer_points: Annotated[int, COUNT] = 1024
    return_threshold_m: Annotated[float, at_least(0, "m")] = 1.0
    occupancy_unknown: Literal["ignore", "empty"] = "ignore"
    occupancy_unknown_weight: Annotated[float, NOT_NEGATIVE] = 0.0
    semantic_weights: Annotated[tuple[float, ...], NOT_NEGATIVE] = ()
    semantic_image_share: Annotated[float, above(0, 1)] = 1.0
    semantic_range_view_share: Annotated[float, above(0, 1)] = 0.5
    birds_eye_weights: Annotated[tuple[float, ...], NOT_NEGATIVE] = (1.0, 1.0, 1.0, 2.0, 3.0, 1.0, 1.0, 1.0)
    birds_eye_share: Annotated[float, above(0, 1)] = 0.25

    def __post_init__(self):
        check(self)
