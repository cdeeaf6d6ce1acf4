"""The rules of the road: who may pass, who stops behind whom, when people cross."""

import dataclasses

import numpy as np
import pytest

from muvo_jax.town import TownConfig, traffic
from muvo_jax.town import map as map_lib

CONFIG = TownConfig()
FAR_M, STANDING_MPS, STEP_S = np.array([1e4, 1e4]), np.zeros(2), 0.1


@pytest.fixture(scope="module")
def streets():
    return map_lib.make_streets(CONFIG)


def cars(segments, along_m, speed_mps=0.0):
    """Cars alone, each with a wish for 8 m/s."""
    count, nobody = len(segments), np.zeros(0)
    return traffic.Traffic(
        segment=np.array(segments, int), along_m=np.array(along_m, float), speed_mps=np.full(count, float(speed_mps)),
        turns=np.zeros(count, int), cruise_mps=np.full(count, 8.0), length_m=np.full(count, 4.4),
        look=np.zeros(count, int), walk_from_m=np.zeros((0, 2)), walk_to_m=np.zeros((0, 2)), walked_m=nobody,
        walk_direction=nobody, wait_s=nobody, walk_mps=nobody, crosses=nobody.astype(bool), clothes=nobody.astype(int))


def on(streets, state, seconds, ego_m=FAR_M):
    """What the traffic does while the ego vehicle stands."""
    for _ in range(round(seconds / STEP_S)):
        state = traffic.step(streets, state, 0, ego_m, STANDING_MPS, -1, 1e3, STEP_S)
    return state


def junction(streets):
    """A junction of three streets or more: its number, the lanes that lead there, a way through it."""
    node = int(np.flatnonzero(streets.degree > 2)[0])
    lanes = streets.lanes[streets.end_node[streets.lanes] == node]
    return node, lanes, int(np.flatnonzero(streets.junction == node)[0])


def test_one_vehicle_passes_a_junction_at_a_time(streets):
    node, lanes, through = junction(streets)
    before = lambda lane, distance_m: streets.lengths_m[lane] - distance_m
    waiting = cars([*lanes[:2], lanes[2]], [before(lanes[0], 8.0), before(lanes[1], 3.0), before(lanes[2], 30.0)])
    allowed = lambda state, ego_node=-1, ego_m=1e3: traffic.may_enter(streets, state, ego_node, ego_m).tolist()
    assert allowed(waiting) == [False, True, True, True]  # the nearest; who is far away need not ask, nor the ego
    assert allowed(waiting, node, 1.0) == [False, False, True, True]  # the ego vehicle is nearer
    inside = cars([*lanes[:2], through], [before(lanes[0], 8.0), before(lanes[1], 3.0), 1.0])
    assert allowed(inside, node, 1.0) == [False, False, True, False]


def test_a_car_stops_behind_what_stands_in_its_lane_and_drives_on_when_that_is_gone(streets):
    lane = int(streets.lanes[np.argmax(streets.lengths_m[streets.lanes])])
    ego_m, _ = map_lib.locate(streets, np.array(lane), np.array(30.0))
    stopped = on(streets, cars([lane], [2.0], speed_mps=8.0), 12.0, ego_m)
    between_m = 30.0 - stopped.along_m[0]
    assert stopped.speed_mps[0] < traffic.MOVING_MPS and 2 * traffic.CAR_FRONT_M < between_m < 12.0
    assert not traffic.moving(stopped)[0].any()
    assert on(streets, stopped, 4.0).speed_mps[0] > 4.0


def test_cars_wander_for_a_minute_without_driving_through_each_other(streets):
    state = traffic.spawn(streets, dataclasses.replace(CONFIG, moving_cars=12, pedestrians=0), FAR_M,
                          np.random.default_rng(0))
    assert len(state.segment) == 12
    least_m, driven = np.inf, np.zeros(12)
    for _ in range(120):
        state = on(streets, state, 0.5)
        places_m, yaw_rad = traffic.car_poses(streets, state)
        offset = places_m[:, None] - places_m[None]
        # Half the width of a car beside its middle line, half its length before and behind.
        along = np.abs(offset[..., 0] * np.cos(yaw_rad) + offset[..., 1] * np.sin(yaw_rad)) / 2.0
        across = np.abs(offset[..., 1] * np.cos(yaw_rad) - offset[..., 0] * np.sin(yaw_rad)) / 0.9
        least_m = min(least_m, np.maximum(along, across)[~np.eye(12, dtype=bool)].min())
        driven += state.speed_mps > traffic.MOVING_MPS
    assert least_m > 1.0
    assert (driven > 20).all()  # nobody waits for ever


def crossing(walked_m=0.0, wait_s=0.0):
    person = {"walk_from_m": [[0.0, 0.0]], "walk_to_m": [[12.0, 0.0]], "walked_m": [walked_m], "walk_direction": [1.0],
              "wait_s": [wait_s], "walk_mps": [1.5], "crosses": [True], "clothes": [0]}
    return dataclasses.replace(cars([], []), **{name: np.array(value) for name, value in person.items()})


def test_people_cross_when_no_vehicle_is_near_and_wait_on_the_other_side(streets):
    near_m = np.array([6.0, traffic.CLEAR_M - 1.0])
    assert on(streets, crossing(), 5.0, near_m).walked_m[0] == 0.0
    assert on(streets, crossing(wait_s=3.0), 2.9).walked_m[0] == 0.0
    midway = on(streets, crossing(), 4.0)
    np.testing.assert_allclose(midway.walked_m, [6.0], atol=1.5 * STEP_S + 1e-6)
    assert traffic.moving(midway)[1].all()
    assert on(streets, midway, 1.0, near_m).walked_m[0] > midway.walked_m[0]  # who is on the road goes on
    arrived = on(streets, midway, 4.5)
    assert arrived.walked_m[0] == 12.0 and arrived.wait_s[0] > 0 and not traffic.moving(arrived)[1].any()
    back = on(streets, arrived, traffic.WAIT_S[1] + 2.0)
    assert back.walked_m[0] < 12.0
