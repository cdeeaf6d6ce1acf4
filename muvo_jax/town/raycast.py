"""Ray casting for level sensors among upright boxes, on the CPU, fast enough for recordings made while one waits.

Neither sensor rolls or pitches, so all pixels of a column lie in one vertical half-plane. There a box is an interval of
horizontal distance and an interval of height: the expensive part, cutting footprints, is done per (column, box) pair,
and a pixel needs only a handful of comparisons per box that its column really crosses.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from muvo_jax.town import boxes as box_lib

NOTHING, GROUND = -2, -1


@dataclasses.dataclass(frozen=True)
class Fan:
    """The rays of a sensor.

    Attributes:
      azimuths_rad: float64 [C], strictly decreasing (from left to right), left positive, relative to the heading.
      slopes: float32 [C, R], height gained per metre of horizontal distance, from the top row to the bottom row.
      range_m: float32 [C, R], how far each ray reaches, in horizontal distance.
    """

    azimuths_rad: np.ndarray
    slopes: np.ndarray
    range_m: np.ndarray


@dataclasses.dataclass(frozen=True)
class Hits:
    """What each ray met first.

    Attributes:
      distance_m: float32 [C, R], horizontal, infinite where nothing was met.
      box: int32 [C, R], index of the box, GROUND or NOTHING.
    """

    distance_m: np.ndarray
    box: np.ndarray


def cast(fan: Fan, origin_m: np.ndarray, yaw_rad: float, boxes: box_lib.Boxes) -> Hits:
    """Casts all rays of a fan from `origin_m` [3] (frame of the map) with the heading `yaw_rad`."""
    column, box, enter_m, leave_m = _crossings(fan, origin_m, yaw_rad, boxes)
    low_m, high_m = (boxes.z_m[:, side] - np.float32(origin_m[2]) for side in range(2))
    column, box, enter_m, leave_m = _drop_hidden(fan, column, box, enter_m, leave_m, low_m, high_m, origin_m[2])

    inverse = 1 / np.where(np.abs(fan.slopes) < 1e-6, np.float32(1e-6), fan.slopes)
    ground_m = np.where(fan.slopes < -1e-6, -np.float32(origin_m[2]) * inverse, np.inf)
    best_m = np.where(ground_m <= fan.range_m, ground_m, np.inf).astype(np.float32)
    found = np.where(np.isfinite(best_m), GROUND, NOTHING).astype(np.int32)
    best_m = np.where(np.isfinite(best_m), best_m, fan.range_m)

    # Columns with the most crossings first: then the k-th crossing concerns a leading slice of all columns.
    count = np.bincount(column, minlength=len(fan.azimuths_rad))
    order = np.argsort(-count, kind="stable")
    first = np.cumsum(count) - count
    inverse, best_m, found = inverse[order], best_m[order], found[order]
    for rank in range(count.max(initial=0)):
        active = int((count > rank).sum())
        pair = first[order[:active]] + rank
        here = box[pair]
        at_low, at_high = low_m[here, None] * inverse[:active], high_m[here, None] * inverse[:active]
        near_m = np.maximum(np.minimum(at_low, at_high), enter_m[pair, None])
        far_m = np.minimum(np.maximum(at_low, at_high), leave_m[pair, None])
        closer = (near_m < far_m) & (near_m < best_m[:active])
        np.copyto(best_m[:active], near_m, where=closer)
        np.copyto(found[:active], here[:, None], where=closer)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    best_m, found = best_m[back], found[back]
    return Hits(np.where(found == NOTHING, np.float32(np.inf), best_m), found)


def _crossings(fan: Fan, origin_m: np.ndarray, yaw_rad: float, boxes: box_lib.Boxes):
    """All pairs of a column and a box footprint that it crosses, sorted by column and entry distance."""
    cosine, sine = boxes.heading[:, 0], boxes.heading[:, 1]
    offset = np.asarray(origin_m[:2], np.float32) - boxes.centre_m
    local = np.stack([offset[:, 0] * cosine + offset[:, 1] * sine, offset[:, 1] * cosine - offset[:, 0] * sine], 1)

    column, box = _candidates(fan, local, np.arctan2(sine, cosine) - yaw_rad, boxes.half_m)
    relative = (fan.azimuths_rad[column] + yaw_rad).astype(np.float32)
    ray_cosine, ray_sine = np.cos(relative), np.sin(relative)
    along = ray_cosine * cosine[box] + ray_sine * sine[box]
    across = ray_sine * cosine[box] - ray_cosine * sine[box]
    enter_m, leave_m = np.zeros(len(box), np.float32), np.full(len(box), np.inf, np.float32)
    for axis, direction in enumerate((along, across)):
        inverse = 1 / np.where(np.abs(direction) < 1e-7, np.float32(1e-7), direction)
        low = (-boxes.half_m[box, axis] - local[box, axis]) * inverse
        high = (boxes.half_m[box, axis] - local[box, axis]) * inverse
        enter_m = np.maximum(enter_m, np.minimum(low, high))
        leave_m = np.minimum(leave_m, np.maximum(low, high))
    crossed = np.flatnonzero((enter_m < leave_m) & (enter_m < fan.range_m.max()))
    crossed = crossed[np.lexsort((enter_m[crossed], column[crossed]))]
    return column[crossed], box[crossed], enter_m[crossed], leave_m[crossed]


def _candidates(fan: Fan, local: np.ndarray, turn_rad: np.ndarray, half_m: np.ndarray):
    """Pairs (column, box) where the column lies between the outermost corners of the box."""
    corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], np.float32)[None] * half_m[:, None] - local[:, None]
    middle = np.arctan2(-local[:, 1], -local[:, 0])
    spread = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    spread = (spread + np.pi) % (2 * np.pi) - np.pi
    around = (np.abs(local) <= half_m).all(axis=1)
    low = np.where(around, -np.pi, spread.min(1))
    high = np.where(around, np.pi, spread.max(1))
    middle = (middle + turn_rad + np.pi) % (2 * np.pi) - np.pi
    ascending = -fan.azimuths_rad
    columns, boxes = [], []
    for turn in (-2 * np.pi, 0.0, 2 * np.pi):
        begin = np.searchsorted(ascending, -(middle + high) - turn, side="left")
        count = np.maximum(np.searchsorted(ascending, -(middle + low) - turn, side="right") - begin, 0)
        columns.append(np.repeat(begin - (np.cumsum(count) - count), count) + np.arange(count.sum()))
        boxes.append(np.repeat(np.arange(len(count)), count))
    return np.concatenate(columns), np.concatenate(boxes)


def _drop_hidden(fan: Fan, column: np.ndarray, box: np.ndarray, enter_m: np.ndarray, leave_m: np.ndarray,
                 low_m: np.ndarray, high_m: np.ndarray, height_m: float):
    """Leaves out what stands behind a box that fills its column from the ground to the highest ray."""
    fills = (high_m[box] >= fan.slopes.max(1)[column] * enter_m) & (low_m[box] <= -height_m + 0.01)
    limit_m = np.full(len(fan.azimuths_rad), np.inf, np.float32)
    np.minimum.at(limit_m, column[fills], enter_m[fills])
    seen = enter_m <= limit_m[column]
    return column[seen], box[seen], enter_m[seen], leave_m[seen]
