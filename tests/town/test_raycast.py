"""Rays among boxes: by hand, and against one ray and one box at a time."""

import math

import numpy as np
import pytest

from muvo_jax.town import boxes as box_lib
from muvo_jax.town import raycast

ORIGIN_M = np.array([0.0, 0.0, 2.0])


def fan(azimuths_rad, slopes, range_m=60.0):
    slopes = np.broadcast_to(np.asarray(slopes, np.float32), (len(azimuths_rad), np.shape(slopes)[-1]))
    return raycast.Fan(np.asarray(azimuths_rad, np.float64), slopes, np.full(slopes.shape, range_m, np.float32))


def block(x_m, y_m, z_m, side_m=2.0, yaw_rad=0.0):
    return box_lib.make((x_m, y_m), yaw_rad, side_m, side_m, z_m, (0.5, 0.5, 0.5), box_lib.WALL)


def test_walls_roofs_road_and_sky_by_hand():
    boxes = box_lib.join([block(10.0, 0.0, (0.0, 1.0)), block(20.0, 0.0, (0.0, 4.0))])
    # From 2 m up: over everything, into the far wall (front at 19 m), onto the near roof (1 m below, 9 to 11 m away),
    # into the near front (9 m away, 0.9 m up), onto the road before it.
    seen = raycast.cast(fan([0.0], [0.2, 0.0, -0.1, -1.1 / 9, -0.5]), ORIGIN_M, 0.0, boxes)
    np.testing.assert_allclose(seen.distance_m[0], [math.inf, 19.0, 10.0, 9.0, 4.0], rtol=1e-5)
    assert seen.box[0].tolist() == [raycast.NOTHING, 1, 0, 0, raycast.GROUND]


@pytest.mark.parametrize(("yaw_rad", "azimuth_rad"), [(0.0, math.pi / 2), (math.pi / 2, 0.0), (math.pi, -math.pi / 2)])
def test_left_is_positive_and_the_heading_turns_the_fan(yaw_rad, azimuth_rad):
    seen = raycast.cast(fan([azimuth_rad], [0.0]), ORIGIN_M, yaw_rad, block(0.0, 10.0, (0.0, 3.0)))
    np.testing.assert_allclose(seen.distance_m, [[9.0]], rtol=1e-5)


def test_what_is_too_far_is_not_there():
    seen = raycast.cast(fan([0.0], [0.0, -0.1], range_m=8.9), ORIGIN_M, 0.0, block(10.0, 0.0, (0.0, 3.0)))
    assert np.isinf(seen.distance_m).all() and (seen.box == raycast.NOTHING).all()


def one_by_one(rays, origin_m, yaw_rad, boxes):
    """Distances [C, R] by the slabs of each box in turn."""
    angle = rays.azimuths_rad[:, None] + yaw_rad
    direction = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle), rays.slopes), axis=-1)
    with np.errstate(divide="ignore"):
        best_m = np.where(rays.slopes < 0, -origin_m[2] / np.float64(rays.slopes), np.inf)
    for index in range(len(boxes)):
        cosine, sine = np.float64(boxes.heading[index])
        turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        middle = np.array([*boxes.centre_m[index], boxes.z_m[index].mean()], np.float64)
        half = np.array([*boxes.half_m[index], np.ptp(boxes.z_m[index]) / 2], np.float64)
        start, along = turn @ (origin_m - middle), direction @ turn.T
        with np.errstate(divide="ignore"):
            sides = np.stack([(-half - start) / along, (half - start) / along])
        enter_m, leave_m = np.maximum(sides.min(0).max(-1), 0), sides.max(0).min(-1)
        best_m = np.where((enter_m < leave_m) & (enter_m < best_m), enter_m, best_m)
    return np.where(best_m <= rays.range_m, best_m, np.inf)


@pytest.mark.parametrize("seed", range(4))
def test_a_fan_meets_what_each_ray_meets_alone(seed):
    random = np.random.default_rng(seed)
    bottom_m = np.where(random.random(40) < 0.6, 0.0, random.uniform(0.5, 4.0, 40))  # houses, and crowns of trees
    distance_m, bearing_rad = random.uniform(6.0, 50.0, 40), random.uniform(-np.pi, np.pi, 40)
    boxes = box_lib.make(distance_m[:, None] * np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], 1),
                         random.uniform(-np.pi, np.pi, 40), random.uniform(0.3, 6.0, 40), random.uniform(0.3, 6.0, 40),
                         np.stack([bottom_m, bottom_m + random.uniform(0.3, 6.0, 40)], 1), (0.5, 0.5, 0.5),
                         box_lib.WALL)
    rays = fan(np.linspace(np.pi, -np.pi, 97)[1:] + 1e-3, np.linspace(0.35, -0.45, 24))
    yaw_rad = random.uniform(-np.pi, np.pi)
    got, want = raycast.cast(rays, ORIGIN_M, yaw_rad, boxes), one_by_one(rays, ORIGIN_M, yaw_rad, boxes)
    grazed = ~np.isclose(got.distance_m, want, rtol=1e-4)  # an edge that float32 hits or misses by a hair
    assert grazed.mean() < 2e-3
    hit = (got.box >= 0) & ~grazed
    assert hit.mean() > 0.1
    met_m = ORIGIN_M[2] + got.distance_m[hit] * rays.slopes[hit]
    assert ((met_m > boxes.z_m[got.box[hit], 0] - 1e-2) & (met_m < boxes.z_m[got.box[hit], 1] + 1e-2)).all()
