"""What a model decodes: its heads by name, the recorded truth that each is compared with, the weights of the terms.

A new head is one row in each of four places, all by the same name, and nothing else:

1. TARGETS below: the Batch fields that its loss reads, each with its shape for one frame. A field that no recording had
   so far also needs a line in types.Batch, types.BATCH_FIELDS, data/schema.RawFrame and the table data/fields.py, which
   tells the plain format's reader and writer how it is stored.
2. model/heads.TABLE: its decoder (`_vector` for a number or a few of them).
3. objectives/terms.TABLE: its loss terms, each with the field of LossConfig that weighs it.
4. LossConfig below: these weights.

Then --with-heads=NAME trains it, a recording without its fields is refused by name, and `decode` returns it. A term
that may be off and reads fields of its own has a row in TERM_TARGETS too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple

from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, above, at_least, check

HEADS = ("image", "range_view", "occupancy", "action")  # of the paper; the others are optional
BIRDS_EYE_CLASSES = 8
EGO_MOTION_UNITS = (1.0, 0.1, 0.05, 5.0)  # m forward, m left, rad, m/s: about what a step of 0.2 s brings
Shapes = Mapping[str, tuple[int, ...]]

# Head -> what a ModelConfig makes of it: Batch field -> its shape for one frame.
TARGETS: dict[str, Callable[[Any], Shapes]] = {
    "image": lambda model: {"image": (*model.image_size, 3)},
    "range_view": lambda model: {"range_view": (model.range_view.rows, model.range_view.columns, 4)},
    "occupancy": lambda model: {"occupancy": model.voxels.shape},
    "action": lambda model: {"action": (2,)},
    "depth": lambda model: {"depth_m": model.image_size},
    "semantic_image": lambda model: {"image_classes": model.image_size},
    "semantic_range_view": lambda model: {
        "range_view_classes": (model.range_view.rows, model.range_view.columns)},
    "birds_eye": lambda model: {"birds_eye_classes": model.voxels.shape[:2],
                                "birds_eye_instances": model.voxels.shape[:2]},
    "reward": lambda model: {"reward": ()},
    "continue": lambda model: {"is_terminal": ()},
    "ego_motion": lambda model: {"ego_motion": (4,)},
}
ALL_HEADS = tuple(TARGETS)


class TermTarget(NamedTuple):
    """A Batch field that one term reads beside those of its head, where the field `weight` of LossConfig is not 0."""

    head: str
    weight: str
    shape: Callable[[Any], tuple[int, ...]]


TERM_TARGETS = {"image_instance_mask": TermTarget("image", "image_instance", lambda model: model.image_size)}


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (paper Eq. 1) at scale 1; scale f counts 1/f.

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
    `reward` is an L2, `continue_` a cross-entropy, `ego_motion` an L1 in EGO_MOTION_UNITS.
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


def head_targets(head: str, model: Any, loss: LossConfig) -> dict[str, tuple[int, ...]]:
    """Batch field -> its shape for one frame, of everything that the terms of a head read."""
    more = {field: target.shape(model) for field, target in TERM_TARGETS.items()
            if target.head == head and getattr(loss, target.weight)}
    return {**TARGETS[head](model), **more}
