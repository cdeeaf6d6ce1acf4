"""Cars and pedestrians that move by themselves: pure functions of their state, the ego vehicle and the clock.

Cars wander through the town for ever: which turn a car takes is a hash of the drive's seed, the car and the number of
turns it took, so that the state stays small and copies of it have the same future. At a junction one vehicle at a time
passes: whoever is inside, else whoever is nearest.
"""

from __future__ import annotations

import dataclasses

import flax.struct
import numpy as np

from muvo_jax.town import driver, settings
from muvo_jax.town import map as map_lib

CAR_RADIUS_M = 1.9
PERSON_RADIUS_M = 1.6
CROSSING_RADIUS_M = 3.6  # drivers stop before somebody who is about to walk into their way
CLEAR_M = 20.0  # nobody starts to cross with a vehicle nearer than this
CAR_FRONT_M = 2.3
CLAIM_M = 16.0
WALK_OFFSET_M = 6.8
WAIT_S = (2.0, 9.0)
MOVING_MPS = 0.2  # a car that is slower stands still to the eye


@flax.struct.dataclass
class Traffic:
    """All moving things but the ego vehicle, NumPy arrays over cars [M] and pedestrians [P].

    Attributes:
      segment, along_m, speed_mps, turns: where each car is, how fast, and how many segments it has left.
      cruise_mps, length_m, look: what kind of car and driver it is (`look` picks a colour).
      walk_from_m, walk_to_m: [P, 2], the ends of the line on which a pedestrian walks to and fro.
      walked_m, walk_direction, wait_s: place on that line, +1 or -1, and how long it still waits.
      walk_mps, crosses, clothes: pace, whether the line crosses a street, and a colour.
    """

    segment: np.ndarray
    along_m: np.ndarray
    speed_mps: np.ndarray
    turns: np.ndarray
    cruise_mps: np.ndarray
    length_m: np.ndarray
    look: np.ndarray
    walk_from_m: np.ndarray
    walk_to_m: np.ndarray
    walked_m: np.ndarray
    walk_direction: np.ndarray
    wait_s: np.ndarray
    walk_mps: np.ndarray
    crosses: np.ndarray
    clothes: np.ndarray


def spawn(streets: map_lib.Streets, config: settings.TownConfig, ego_m: np.ndarray,
          rng: np.random.Generator) -> Traffic:
    """Places cars on lanes (none near the ego vehicle or each other) and pedestrians on pavements and crossings."""
    taken_m = [np.asarray(ego_m)]
    segments: list[int] = []
    alongs: list[float] = []
    for _ in range(20 * config.moving_cars):
        if len(segments) == config.moving_cars:
            break
        segment = int(rng.choice(streets.lanes))
        along_m = rng.uniform(0, streets.lengths_m[segment])
        place_m, _ = map_lib.locate(streets, np.array(segment), np.array(along_m))
        if min(np.linalg.norm(place_m - other) for other in taken_m) > 14:
            taken_m.append(place_m)
            segments.append(segment)
            alongs.append(along_m)
    count = len(segments)
    cruise_mps = rng.uniform(*config.cruise_mps, count)
    start_m, end_m, crosses = _walks(streets, config.pedestrians, rng)
    length_m = np.linalg.norm(end_m - start_m, axis=1)
    return Traffic(
        segment=np.array(segments, np.int64), along_m=np.array(alongs), speed_mps=0.8 * cruise_mps,
        turns=np.zeros(count, np.int64), cruise_mps=cruise_mps, length_m=rng.uniform(4.0, 4.8, count),
        look=rng.integers(0, 1000, count), walk_from_m=start_m, walk_to_m=end_m,
        walked_m=np.where(crosses, 0, rng.random(len(crosses)) * length_m),
        walk_direction=np.where(rng.random(len(crosses)) < 0.5, 1.0, -1.0),
        wait_s=np.where(crosses, rng.uniform(0, WAIT_S[1], len(crosses)), 0.0),
        walk_mps=rng.uniform(1.0, 1.7, len(crosses)), crosses=crosses, clothes=rng.integers(0, 1000, len(crosses)))


def car_poses(streets: map_lib.Streets, traffic: Traffic) -> tuple[np.ndarray, np.ndarray]:
    """Middle [M, 2] and yaw [M] of the cars."""
    return map_lib.locate(streets, traffic.segment, traffic.along_m)


def person_poses(traffic: Traffic) -> tuple[np.ndarray, np.ndarray]:
    """Place [P, 2] and yaw [P] of the pedestrians."""
    line = traffic.walk_to_m - traffic.walk_from_m
    length_m = np.linalg.norm(line, axis=1)
    facing = line * traffic.walk_direction[:, None]
    return (traffic.walk_from_m + line * (traffic.walked_m / length_m)[:, None],
            np.arctan2(facing[:, 1], facing[:, 0]))


def moving(traffic: Traffic) -> tuple[np.ndarray, np.ndarray]:
    """Which cars [M] and which pedestrians [P] are on the move, bool: not those that stand in a queue or wait."""
    return traffic.speed_mps > MOVING_MPS, ~(traffic.crosses & _at_end(traffic))


def obstacles(streets: map_lib.Streets, traffic: Traffic, ego_middle_m: np.ndarray,
              ego_velocity_mps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [O, 2], velocities [O, 2] and radii [O] of all cars, the ego vehicle (index M) and all pedestrians."""
    cars_m, yaw_rad = car_poses(streets, traffic)
    people_m, _ = person_poses(traffic)
    velocity = traffic.speed_mps[:, None] * np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], 1)
    return (np.concatenate([cars_m, ego_middle_m[None], people_m]),
            np.concatenate([velocity, ego_velocity_mps[None], np.zeros_like(people_m)]),
            np.concatenate([np.full(len(cars_m) + 1, CAR_RADIUS_M),
                            np.where(traffic.crosses & ~_at_end(traffic), CROSSING_RADIUS_M, PERSON_RADIUS_M)]))


def may_enter(streets: map_lib.Streets, traffic: Traffic, ego_node: int, ego_distance_m: float) -> np.ndarray:
    """Who may pass the junction in front of it: bool [M + 1], the ego vehicle last.

    Args:
      ego_node: the junction that the ego vehicle approaches, -1 for none.
      ego_distance_m: how far it is, 0 or less inside.
    """
    inside = np.append(streets.junction[traffic.segment] >= 0, ego_distance_m <= 0)
    distance_m = np.append(streets.lengths_m[traffic.segment] - traffic.along_m, ego_distance_m)
    distance_m = np.where(inside, 0, distance_m)
    node = np.append(streets.end_node[traffic.segment], ego_node)
    claims = (node >= 0) & (distance_m < CLAIM_M) & (streets.degree[np.maximum(node, 0)] > 2)
    order = np.lexsort((np.arange(len(node)), distance_m, ~inside, node))
    order = order[claims[order]]
    first = np.ones(len(order), bool)
    first[1:] = node[order][1:] != node[order][:-1]
    allowed = ~claims | inside
    allowed[order[first]] = True
    return allowed


def step(streets: map_lib.Streets, traffic: Traffic, seed: int, ego_middle_m: np.ndarray,
         ego_velocity_mps: np.ndarray, ego_node: int, ego_distance_m: float, seconds: float) -> Traffic:
    """Moves everything by one time step."""
    count = len(traffic.segment)
    places_m, velocity_mps, radius_m = obstacles(streets, traffic, ego_middle_m, ego_velocity_mps)
    path_m, path_yaw_rad, following = _path_ahead(streets, traffic, seed)
    distance_m, leader_mps = driver.find_leader(path_m, path_yaw_rad, places_m, velocity_mps, radius_m,
                                                np.arange(count))
    gap_m = distance_m - CAR_FRONT_M - np.where(leader_mps > 0, CAR_FRONT_M, 1.0)
    to_end_m = streets.lengths_m[traffic.segment] - traffic.along_m
    waits = ~may_enter(streets, traffic, ego_node, ego_distance_m)[:count] & (to_end_m - CAR_FRONT_M < gap_m)
    gap_m, leader_mps = np.where(waits, to_end_m - CAR_FRONT_M + 1.0, gap_m), np.where(waits, 0, leader_mps)

    next_limit = np.sqrt(streets.limits_mps[following] ** 2 + 2 * 1.8 * to_end_m)
    desired_mps = np.minimum(np.minimum(traffic.cruise_mps, streets.limits_mps[traffic.segment]), next_limit)
    acceleration = np.clip(driver.follow(traffic.speed_mps, desired_mps, gap_m, leader_mps), -8.0, 2.0)
    speed_mps = np.maximum(0, traffic.speed_mps + acceleration * seconds)
    segment, along_m, turns = _onward(streets, traffic.segment, traffic.along_m + speed_mps * seconds, traffic.turns,
                                      np.arange(count), seed)
    return dataclasses.replace(_walk(traffic, places_m[:count + 1], seed, seconds), segment=segment, along_m=along_m,
                               turns=turns, speed_mps=speed_mps)


def _onward(streets: map_lib.Streets, segment, along_m, turns, car, seed: int):
    """Carries positions beyond the end of a segment over to the segment that follows (repeatedly)."""
    for _ in range(3):
        beyond = along_m > streets.lengths_m[segment]
        following = streets.successors[segment, _hash(seed, car, turns) % streets.successor_count[segment]]
        along_m = np.where(beyond, along_m - streets.lengths_m[segment], along_m)
        segment, turns = np.where(beyond, following, segment), turns + beyond
    return segment, along_m, turns


def _path_ahead(streets: map_lib.Streets, traffic: Traffic, seed: int):
    """Places and yaws [M, D] at driver.LOOK_AHEAD_M in front of each car, and the segment after its own."""
    ahead_m = traffic.along_m[:, None] + driver.LOOK_AHEAD_M[None]
    shape = ahead_m.shape
    car = np.arange(shape[0])
    segment, along_m, _ = _onward(streets, np.broadcast_to(traffic.segment[:, None], shape), ahead_m,
                                  np.broadcast_to(traffic.turns[:, None], shape),
                                  np.broadcast_to(car[:, None], shape), seed)
    places_m, yaw_rad = map_lib.locate(streets, segment, along_m)
    choice = _hash(seed, car, traffic.turns) % streets.successor_count[traffic.segment]
    return places_m, yaw_rad, streets.successors[traffic.segment, choice]


def _walk(traffic: Traffic, vehicles_m: np.ndarray, seed: int, seconds: float) -> Traffic:
    """Pedestrians turn at the ends of their lines; those who cross wait there, and until no vehicle is near."""
    length_m = np.linalg.norm(traffic.walk_to_m - traffic.walk_from_m, axis=1)
    middle_m = 0.5 * (traffic.walk_from_m + traffic.walk_to_m)
    near = (np.linalg.norm(middle_m[:, None] - vehicles_m[None], axis=-1) < CLEAR_M).any(1)
    at_end = _at_end(traffic)
    held = traffic.crosses & at_end & ((traffic.wait_s > 0) | near)
    direction = np.where(traffic.walked_m <= 0, 1.0, np.where(traffic.walked_m >= length_m, -1.0,
                                                              traffic.walk_direction))
    walked_m = np.where(held, traffic.walked_m,
                        np.clip(traffic.walked_m + direction * traffic.walk_mps * seconds, 0, length_m))
    arrives = ~at_end & ((walked_m <= 0) | (walked_m >= length_m))
    pause_s = WAIT_S[0] + (WAIT_S[1] - WAIT_S[0]) * (_hash(seed, np.arange(len(at_end)),
                                                           np.floor(traffic.walk_mps * 1e4).astype(np.int64)) % 97) / 97
    wait_s = np.where(arrives & traffic.crosses, pause_s, np.maximum(traffic.wait_s - seconds, 0))
    return dataclasses.replace(traffic, walked_m=walked_m, walk_direction=direction, wait_s=wait_s)


def _at_end(traffic: Traffic) -> np.ndarray:
    length_m = np.linalg.norm(traffic.walk_to_m - traffic.walk_from_m, axis=1)
    return (traffic.walked_m <= 0) | (traffic.walked_m >= length_m)


def _walks(streets: map_lib.Streets, count: int, rng: np.random.Generator):
    """Lines for pedestrians: three quarters along pavements, the others over zebra crossings."""
    starts, ends, crosses = [], [], []
    for index in range(count):
        first, second = streets.edges[rng.integers(len(streets.edges))][:: 1 if rng.random() < 0.5 else -1]
        start, end = streets.nodes_m[first], streets.nodes_m[second]
        length = np.linalg.norm(end - start)
        forward = (end - start) / length
        right = np.array([forward[1], -forward[0]])
        crossing = index % 4 == 0 and streets.degree[first] > 2
        if crossing:
            middle = start + forward * 8.6 + forward * rng.uniform(-0.8, 0.8)
            starts.append(middle + right * WALK_OFFSET_M)
            ends.append(middle - right * WALK_OFFSET_M)
        else:
            offset = right * (WALK_OFFSET_M + rng.uniform(-0.5, 0.8))
            starts.append(start + forward * 9.0 + offset)
            ends.append(end - forward * 9.0 + offset)
        crosses.append(crossing)
    return np.reshape(starts, (-1, 2)), np.reshape(ends, (-1, 2)), np.array(crosses, bool)


def _hash(seed: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """A well mixed non-negative integer of three integers."""
    value = (np.uint64(seed * 0x9E3779B1 & 0xFFFFFFFF) ^ (np.asarray(first).astype(np.uint64) * np.uint64(0x85EBCA77))
             ^ (np.asarray(second).astype(np.uint64) * np.uint64(0xC2B2AE3D)))
    value = (value ^ (value >> np.uint64(15))) * np.uint64(0x2C1B3C6D)
    value = (value ^ (value >> np.uint64(12))) * np.uint64(0x297A2D39)
    return ((value ^ (value >> np.uint64(15))) & np.uint64(0x7FFFFFFF)).astype(np.int64)
