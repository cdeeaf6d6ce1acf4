"""Solid things as upright boxes turned about the vertical axis: the only geometry in the town beside the ground."""

from __future__ import annotations

import dataclasses

import numpy as np

from muvo_jax.data.fields import TOWN_CLASSES

# What a surface is made of decides its texture; its class follows.
MATERIALS = ("wall", "roof", "trunk", "leaves", "pole", "lamp", "car_body", "car_cabin", "shadow", "person", "head",
             "hedge")
WALL, ROOF, TRUNK, LEAVES, POLE, LAMP, CAR_BODY, CAR_CABIN, SHADOW, PERSON, HEAD, HEDGE = range(len(MATERIALS))
CLASSES = TOWN_CLASSES
SKY, ROAD, MARKING, PAVEMENT, GRASS, BUILDING, VEGETATION, POLE_CLASS, VEHICLE, PEDESTRIAN = range(len(CLASSES))
CLASS_OF_MATERIAL = np.array([BUILDING, BUILDING, VEGETATION, VEGETATION, POLE_CLASS, POLE_CLASS, VEHICLE, VEHICLE,
                              ROAD, PEDESTRIAN, PEDESTRIAN, VEGETATION], np.uint8)


@dataclasses.dataclass(frozen=True)
class Boxes:
    """M boxes in the frame of the map.

    Attributes:
      centre_m: float32 [M, 2].
      heading: float32 [M, 2], cosine and sine of the yaw.
      half_m: float32 [M, 2], half the length (along the heading) and half the width.
      z_m: float32 [M, 2], bottom and top.
      colour: float32 [M, 3], RGB in [0, 1].
      material: int8 [M], index into MATERIALS.
    """

    centre_m: np.ndarray
    heading: np.ndarray
    half_m: np.ndarray
    z_m: np.ndarray
    colour: np.ndarray
    material: np.ndarray

    def __len__(self) -> int:
        return len(self.material)

    def take(self, index) -> Boxes:
        """The boxes of an index array, a mask or a slice."""
        return Boxes(*(getattr(self, field.name)[index] for field in dataclasses.fields(self)))


def make(centre_m, yaw_rad, length_m, width_m, z_m, colour, material: int) -> Boxes:
    """Broadcasts scalars and arrays of length M (colours [M, 3], z [M, 2]) into boxes of one material."""
    centre_m = np.atleast_2d(np.asarray(centre_m, np.float32))
    count = len(centre_m)
    yaw_rad = np.broadcast_to(np.asarray(yaw_rad, np.float64), count)
    half_m = [0.5 * np.broadcast_to(np.asarray(side, np.float64), count) for side in (length_m, width_m)]
    return Boxes(centre_m, np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], 1).astype(np.float32),
                 np.stack(half_m, 1).astype(np.float32),
                 np.array(np.broadcast_to(np.asarray(z_m, np.float32), (count, 2))),
                 np.array(np.broadcast_to(np.asarray(colour, np.float32), (count, 3))),
                 np.full(count, material, np.int8))


def join(parts: list[Boxes]) -> Boxes:
    """All boxes of the parts, in order."""
    return Boxes(*(np.concatenate([getattr(part, field.name) for part in parts])
                   for field in dataclasses.fields(Boxes)))


def cars(centre_m: np.ndarray, yaw_rad: np.ndarray, length_m: np.ndarray, colour: np.ndarray,
         is_van: np.ndarray) -> Boxes:
    """Body, cabin and the shadow below of each car; `centre_m` [M, 2] is the middle of the car."""
    forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], 1)
    cabin_length_m = np.where(is_van, 0.74, 0.55) * length_m
    cabin_centre_m = centre_m - forward * np.where(is_van, 0.10, 0.06)[:, None] * length_m[:, None]
    body_top_m = np.where(is_van, 1.0, 0.85)
    cabin_z_m = np.stack([body_top_m, np.where(is_van, 2.1, 1.5)], 1)
    body_z_m = np.stack([np.full_like(body_top_m, 0.22), body_top_m], 1)
    return join([make(centre_m, yaw_rad, length_m, 1.85, body_z_m, colour, CAR_BODY),
                 make(cabin_centre_m, yaw_rad, cabin_length_m, 1.65, cabin_z_m, colour, CAR_CABIN),
                 make(centre_m, yaw_rad, length_m + 0.3, 2.2, (-1.0, 0.02), (0.05, 0.05, 0.06), SHADOW)])


def people(centre_m: np.ndarray, yaw_rad: np.ndarray, colour: np.ndarray) -> Boxes:
    """Body and head of each pedestrian."""
    return join([make(centre_m, yaw_rad, 0.42, 0.56, (0.0, 1.48), colour, PERSON),
                 make(centre_m, yaw_rad, 0.26, 0.26, (1.48, 1.78), (0.80, 0.62, 0.50), HEAD)])


CAR_COLOURS = np.array([[.82, .83, .85], [.10, .10, .12], [.45, .47, .50], [.68, .10, .10], [.12, .22, .52],
                        [.86, .74, .18], [.16, .40, .26], [.62, .40, .18]], np.float32)
CLOTHES = np.array([[.80, .20, .20], [.20, .30, .70], [.90, .80, .30], [.25, .55, .35], [.85, .85, .85],
                    [.50, .25, .55], [.90, .50, .20]], np.float32)


def touches_discs(boxes: Boxes, discs_m: np.ndarray, radius_m: float) -> np.ndarray:
    """Whether any of the discs [D, 2] reaches into the footprint of each box, bool [M]."""
    offset = discs_m[None].astype(np.float32) - boxes.centre_m[:, None]
    cosine, sine = boxes.heading[:, None, 0], boxes.heading[:, None, 1]
    along = np.abs(offset[..., 0] * cosine + offset[..., 1] * sine) - boxes.half_m[:, None, 0]
    across = np.abs(offset[..., 1] * cosine - offset[..., 0] * sine) - boxes.half_m[:, None, 1]
    outside_m = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
    return (outside_m < radius_m).any(axis=1)
