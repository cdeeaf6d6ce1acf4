"""The town as a simulator: reset, step, an expert driver, reward, and what the sensors see.

Everything about a moment is in `TownState`, a pytree of NumPy arrays that no function changes in place: keeping a state
is copying it, and stepping it twice gives two futures. The static map belongs to `Town`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import flax.struct
import numpy as np

from muvo_jax.town import boxes as box_lib
from muvo_jax.town import driver, ground, renderer, scenery, settings
from muvo_jax.town import map as map_lib
from muvo_jax.town import traffic as traffic_lib

# The ego origin is the ground under the middle of the rear axle.
EGO_MIDDLE_M = 1.3
EGO_FRONT_M = 3.6
EGO_DISCS_M = np.array([-0.1, 1.3, 2.7])
EGO_RADIUS_M = 1.0
LOST_M = 4.0
WEATHER_NAMES = tuple(settings.WEATHERS)
ROUTE_STEP_M = 1.0
ROUTE_END_POINTS = 40  # of the route are left when a drive is over: sensors still see it go on


@flax.struct.dataclass
class TownState:
    """A moment in the town; NumPy leaves, metres and radians in the frame of the map.

    Attributes:
      frame: int, steps since reset.
      seed: int, of this drive.
      weather: int, index into settings.WEATHERS.
      pose: float64 [3], x, y, yaw of the ego origin.
      speed_mps: float64.
      route_m: float64 [R, 2], the planned route, a point per metre.
      route_limit_mps, route_node: float64 and int [R], the speed limit and the junction being crossed (-1 outside).
      progress: int, the nearest point of the route.
      cruise_mps: float64, what the expert likes to drive.
      collided: bool, whether the ego vehicle touches something.
      traffic: everything else that moves.
    """

    frame: np.ndarray
    seed: np.ndarray
    weather: np.ndarray
    pose: np.ndarray
    speed_mps: np.ndarray
    route_m: np.ndarray
    route_limit_mps: np.ndarray
    route_node: np.ndarray
    progress: np.ndarray
    cruise_mps: np.ndarray
    collided: np.ndarray
    traffic: traffic_lib.Traffic


class Town:
    """A town that was built from its config: streets, ground and scenery, which never change.

    All methods are pure: they return new states and touch nothing.
    """

    def __init__(self, config: settings.TownConfig | None = None):
        self.config = config or settings.TownConfig()
        self.streets = map_lib.make_streets(self.config)
        self.scenery = scenery.make_scenery(self.streets, self.config)
        self._solid = self.scenery.take((self.scenery.z_m[:, 0] < 1.0) & (self.scenery.z_m[:, 1] > 0.1))
        self.renderer = renderer.Renderer(self.config, ground.make_ground(self.streets, self.config.seed), self.scenery)

    def reset(self, seed: int, weather: str | None = None) -> TownState:
        """Starts a drive: its route and traffic follow from `seed`, and so does the weather unless one is named.

        Raises:
          ValueError: for a weather that does not exist.
        """
        if weather is not None and weather not in settings.WEATHERS:
            raise ValueError(f"weather {weather!r} is unknown; known are {', '.join(WEATHER_NAMES)}.")
        rng = np.random.default_rng([seed, 5])
        if weather is None:
            weather = settings.TRAINING_WEATHERS[rng.integers(len(settings.TRAINING_WEATHERS))]
        route_m, limit_mps, node = self._plan(rng)
        heading = route_m[1] - route_m[0]
        cruise_mps = rng.uniform(*self.config.cruise_mps)
        yaw_rad = np.arctan2(heading[1], heading[0])
        traffic = traffic_lib.spawn(self.streets, self.config, route_m[0], rng)
        return TownState(
            frame=np.array(0), seed=np.array(seed), weather=np.array(WEATHER_NAMES.index(weather)),
            pose=np.array([*route_m[0], yaw_rad]), speed_mps=np.array(min(cruise_mps, limit_mps[0]) * 0.8),
            route_m=route_m, route_limit_mps=limit_mps, route_node=node, progress=np.array(0),
            cruise_mps=np.array(cruise_mps), collided=np.array(False), traffic=traffic)

    def step(self, state: TownState, action: np.ndarray) -> TownState:
        """Applies an action for one period (0.1 s at 10 Hz).

        The ego vehicle follows the kinematic bicycle about its rear axle: it drives at the mean of old and new speed,
        turns by distance * tan(angle) / wheelbase, and moves along the mean of old and new heading.

        Args:
          action: [2], (acceleration, steering), clipped to [-1, 1]; steering > 0 is right. See config.ActionContract.
        """
        seconds = 1.0 / self.config.contract.rate_hz
        middle_m, velocity_mps = self._ego_motion(state)
        node, to_junction_m = self._next_junction(state)
        traffic = traffic_lib.step(self.streets, state.traffic, int(state.seed), middle_m, velocity_mps, node,
                                   to_junction_m, seconds)
        pose, speed_mps = bicycle(state.pose, float(state.speed_mps), action, self.config.contract)
        window = np.arange(max(int(state.progress) - 3, 0), min(int(state.progress) + 12, len(state.route_m)))
        progress = window[np.argmin(np.linalg.norm(state.route_m[window] - pose[:2], axis=1))]
        moved = dataclasses.replace(state, frame=state.frame + 1, pose=pose, speed_mps=np.array(speed_mps),
                                    traffic=traffic, progress=np.array(progress))
        return dataclasses.replace(moved, collided=np.array(self._collides(moved)))

    def expert(self, state: TownState) -> np.ndarray:
        """The action of a careful driver, float32 [2], who sways and hesitates a little (smoothly, by the seed)."""
        config, contract = self.config, self.config.contract
        acceleration = driver.follow(float(state.speed_mps), self._limit_mps(state), *self._gap(state))
        phase = np.random.default_rng([int(state.seed), 7]).uniform(0, 2 * np.pi, (3, 3))
        wave = np.sin(2 * np.pi * np.array([0.11, 0.27, 0.61])[None] * float(state.frame) / contract.rate_hz + phase)
        wave = wave.mean(1) * np.sqrt(6)
        ahead = min(int(state.progress) + int(3 + 0.5 * float(state.speed_mps)), len(state.route_m) - 2)
        forward = state.route_m[ahead + 1] - state.route_m[ahead]
        left = np.array([-forward[1], forward[0]]) / max(float(np.hypot(*forward)), 1e-6)
        target_m = state.route_m[ahead] + left * config.lane_wander_m * wave[2]
        wheel_rad = driver.pursue(state.pose[:2], float(state.pose[2]), target_m, contract.wheelbase_m)
        pedal = acceleration / (contract.accel_full_mps2 if acceleration > 0 else contract.brake_full_mps2)
        moving = min(float(state.speed_mps) / 2.0, 1.0)
        action = np.array([pedal + config.action_noise[0] * wave[0] * moving,
                           -wheel_rad / contract.steer_full_rad + config.action_noise[1] * wave[1]])
        return np.clip(action, -1, 1).astype(np.float32)

    def reward(self, state: TownState) -> float:
        """How well things stand: 1 for the speed that the situation allows, in the lane and along it; -1 on collision.

        (1 - |speed - allowed| / fastest) * (1 - offset / 2 m) * cos(heading error), each factor at least 0.
        """
        if state.collided:
            return -1.0
        gap_m, leader_mps = self._gap(state)
        allowed_mps = min(self._limit_mps(state), float(leader_mps) + np.sqrt(4.0 * max(float(gap_m) - 1.0, 0)))
        offset_m, turn_rad = self._deviation(state)
        return float(max(0, 1 - abs(float(state.speed_mps) - allowed_mps) / self.config.cruise_mps[1])
                     * max(0, 1 - offset_m / 2) * max(0, np.cos(turn_rad)))

    def is_terminal(self, state: TownState) -> bool:
        """Whether the drive is over: a collision, off the route, or at its end."""
        return bool(state.collided) or self._deviation(state)[0] > LOST_M or int(state.progress) >= (
            len(state.route_m) - ROUTE_END_POINTS)

    def render(self, state: TownState) -> dict[str, Any]:
        """What the sensors measure; see renderer.Renderer.render for the images and points.

        Beside them: route_map uint8 [64, 64], speed_mps float32, reward float32, is_terminal bool.
        """
        weather = settings.WEATHERS[WEATHER_NAMES[int(state.weather)]]
        cars_move, people_move = traffic_lib.moving(state.traffic)
        moves = np.concatenate([cars_move, cars_move, np.zeros_like(cars_move), people_move, people_move])
        seen = self.renderer.render(state.pose, self._moving_boxes(state), moves, weather,
                                    [int(state.seed), int(state.frame)])
        route_m = state.route_m[max(int(state.progress) - 20, 0):int(state.progress) + 60]
        return {**seen, "route_map": renderer.draw_route(route_m, state.pose),
                "speed_mps": np.float32(state.speed_mps), "reward": np.float32(self.reward(state)),
                "is_terminal": np.bool_(self.is_terminal(state))}

    def occupancy(self, seen: Mapping[str, Any]) -> np.ndarray:
        """The occupancy target (uint8 [X, Y, Z]: 0, 1, 255) of what `render` returned."""
        return self.renderer.occupancy(seen)

    def _plan(self, rng: np.random.Generator):
        """A random drive through the town: points a metre apart, speed limits, junctions."""
        streets = self.streets
        segment = int(rng.choice(streets.lanes))
        skip_m = rng.uniform(2, 0.5 * streets.lengths_m[segment])
        segments, alongs, length_m = [], [], -skip_m
        while length_m < self.config.route_m:
            steps = np.arange(0, streets.lengths_m[segment], 0.25)
            segments.append(np.full(len(steps), segment))
            alongs.append(steps)
            length_m += streets.lengths_m[segment]
            segment = int(streets.successors[segment, rng.integers(streets.successor_count[segment])])
        visited = np.concatenate(segments)
        points_m, _ = map_lib.locate(streets, visited, np.concatenate(alongs))
        travelled_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])
        pick = np.searchsorted(travelled_m, skip_m + ROUTE_STEP_M * np.arange(int(self.config.route_m)))
        pick = np.minimum(pick, len(points_m) - 1)
        node = streets.junction[visited[pick]]
        node = np.where(streets.degree[np.maximum(node, 0)] > 2, node, -1)
        return points_m[pick], streets.limits_mps[visited[pick]], node

    def _ego_motion(self, state: TownState) -> tuple[np.ndarray, np.ndarray]:
        forward = np.array([np.cos(state.pose[2]), np.sin(state.pose[2])])
        return state.pose[:2] + EGO_MIDDLE_M * forward, float(state.speed_mps) * forward

    def _next_junction(self, state: TownState) -> tuple[int, float]:
        """The junction on the route within reach and the distance of the front bumper from it (0 or less inside)."""
        start = int(state.progress)
        nodes = state.route_node[start:start + int(traffic_lib.CLAIM_M + EGO_FRONT_M)]
        ahead = np.flatnonzero(nodes >= 0)
        if not len(ahead):
            return -1, np.inf
        return int(nodes[ahead[0]]), ahead[0] * ROUTE_STEP_M - EGO_FRONT_M

    def _gap(self, state: TownState) -> tuple[float, float]:
        """Free road in front of the ego vehicle's bumper along its route, and the speed of what ends it."""
        places_m, velocity_mps, radius_m = traffic_lib.obstacles(self.streets, state.traffic,
                                                                 *self._ego_motion(state))
        ahead = int(state.progress) + np.rint((driver.LOOK_AHEAD_M + EGO_MIDDLE_M) / ROUTE_STEP_M).astype(int)
        ahead = np.minimum(ahead, len(state.route_m) - 2)
        heading = state.route_m[ahead + 1] - state.route_m[ahead]
        yaw_rad = np.arctan2(heading[:, 1], heading[:, 0])
        distance_m, leader_mps = driver.find_leader(state.route_m[ahead][None], yaw_rad[None], places_m, velocity_mps,
                                                    radius_m, np.array([len(state.traffic.segment)]))
        rear_m = traffic_lib.CAR_FRONT_M if leader_mps[0] > 0 else 1.0
        gap_m, leader = float(distance_m[0]) - (EGO_FRONT_M - EGO_MIDDLE_M) - rear_m, float(leader_mps[0])
        node, to_junction_m = self._next_junction(state)
        if to_junction_m + 1.0 < gap_m and not traffic_lib.may_enter(self.streets, state.traffic, node,
                                                                     to_junction_m)[-1]:
            return to_junction_m + 1.0, 0.0
        return gap_m, leader

    def _limit_mps(self, state: TownState) -> float:
        """The speed from which the limits ahead on the route can be met by gentle braking."""
        limits = state.route_limit_mps[int(state.progress):int(state.progress) + 30]
        distance_m = ROUTE_STEP_M * np.arange(len(limits))
        return float(min(state.cruise_mps, np.sqrt(limits**2 + 2 * 1.8 * distance_m).min()))

    def _deviation(self, state: TownState) -> tuple[float, float]:
        """Distance from the route and angle to it."""
        index = min(int(state.progress), len(state.route_m) - 2)
        heading = state.route_m[index + 1] - state.route_m[index]
        offset = state.pose[:2] - state.route_m[index]
        across = (offset[1] * heading[0] - offset[0] * heading[1]) / max(float(np.hypot(*heading)), 1e-6)
        return abs(float(across)), float(state.pose[2] - np.arctan2(heading[1], heading[0]))

    def _collides(self, state: TownState) -> bool:
        """Whether the ego vehicle, seen as three discs, touches anything solid."""
        x, y, yaw_rad = state.pose
        discs_m = np.stack([x + EGO_DISCS_M * np.cos(yaw_rad), y + EGO_DISCS_M * np.sin(yaw_rad)], 1)
        near = np.abs(self._solid.centre_m - state.pose[None, :2]).max(1) < 20
        moving = self._moving_boxes(state)
        return any(box_lib.touches_discs(things, discs_m, EGO_RADIUS_M).any()
                   for things in (self._solid.take(near), moving.take(moving.material != box_lib.SHADOW)))

    def _moving_boxes(self, state: TownState) -> box_lib.Boxes:
        """Bodies, cabins and shadows of all cars, then bodies and heads of all pedestrians."""
        traffic = state.traffic
        cars_m, car_yaw_rad = traffic_lib.car_poses(self.streets, traffic)
        people_m, person_yaw_rad = traffic_lib.person_poses(traffic)
        return box_lib.join([
            box_lib.cars(cars_m, car_yaw_rad, traffic.length_m,
                         box_lib.CAR_COLOURS[traffic.look % len(box_lib.CAR_COLOURS)], traffic.look % 7 == 0),
            box_lib.people(people_m, person_yaw_rad, box_lib.CLOTHES[traffic.clothes % len(box_lib.CLOTHES)])])


def bicycle(pose: np.ndarray, speed_mps: float, action: np.ndarray, contract) -> tuple[np.ndarray, float]:
    """One period of the kinematic bicycle: returns the new pose [3] (x, y, yaw) and speed (never backwards)."""
    seconds = 1.0 / contract.rate_hz
    pedal, steering = np.clip(np.asarray(action, np.float64), -1, 1)
    full_mps2 = contract.accel_full_mps2 if pedal > 0 else contract.brake_full_mps2
    new_speed_mps = max(0.0, speed_mps + float(pedal) * full_mps2 * seconds)
    distance_m = 0.5 * (speed_mps + new_speed_mps) * seconds
    turn_rad = -distance_m * np.tan(steering * contract.steer_full_rad) / contract.wheelbase_m
    heading_rad = pose[2] + 0.5 * turn_rad
    change = np.array([distance_m * np.cos(heading_rad), distance_m * np.sin(heading_rad), turn_rad])
    return pose + change, new_speed_mps
