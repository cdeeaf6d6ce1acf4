"""The border to CARLA: carla_recorder.Simulator on a live server, in synchronous mode. carla is imported late."""

from __future__ import annotations

import contextlib
import importlib
import math
import queue
from collections.abc import Callable
from typing import Any

import numpy as np

from muvo_jax.data.carla import drives as carla_drives
from muvo_jax.data.carla import frames as carla_frames

EGO_BLUEPRINT = "vehicle.lincoln.mkz_2017"  # muvo.files.EGO_BOX_M is its size
WARM_UP_TICKS = 20  # the car settles, sensors start
_FASTEST_MPS = 30.0
_WALKING_MPS = 1.4

# make_agent(ego vehicle, route [P, 2]) -> agent(Tick) -> carla.VehicleControl
Agent = Callable[[carla_frames.Tick], Any]


def import_carla() -> Any:
    """The carla package; raises CarlaError naming the extra where it is not installed."""
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise carla_drives.CarlaError(f"the CARLA client cannot be imported ({error}); install it with  "
                                        f"pip install 'muvo_jax[carla]'") from error


def load_agent(name: str) -> Callable[[Any, np.ndarray], Agent]:
    """The function that "module:function" names.

    Raises:
      ValueError: where it is no such name, or there is no such module or function.
    """
    module_name, colon, function = name.partition(":")
    try:
        make_agent = getattr(importlib.import_module(module_name), function) if colon else None
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"--agent={name}: {error}") from error
    if not callable(make_agent):
        raise ValueError(f"--agent={name}: expected module:function, such as my_package.driver:make_agent")
    return make_agent


@contextlib.contextmanager
def server_errors(where: str):
    """What the client raises (RuntimeError, among it time-outs) as CarlaError."""
    try:
        yield
    except RuntimeError as error:
        raise carla_drives.CarlaError(f"{where}: {error} Is the server up and of the client's version?") from error


def drained(events: queue.Queue) -> bool:
    """Empties a queue; whether anything was in it."""
    count = 0
    with contextlib.suppress(queue.Empty):
        while True:
            events.get_nowait()
            count += 1
    return count > 0


class Client:
    """See carla_recorder.Simulator. Without an agent the traffic manager's autopilot drives along the route."""

    def __init__(self, settings: carla_drives.Settings, *, host: str = "127.0.0.1", port: int = 2000,
                 traffic_port: int = 8000, vehicles: int = 80, walkers: int = 80, timeout_s: float = 60.0,
                 make_agent: Callable[[Any, np.ndarray], Agent] | None = None):
        """Raises CarlaError where carla is not installed, no server answers, or it is of another version."""
        self._carla = import_carla()
        self._settings, self._make_agent, self._timeout_s = settings, make_agent, timeout_s
        self._vehicles, self._walkers, self._traffic_port = vehicles, walkers, traffic_port
        self._where = f"CARLA at {host}:{port}"
        self._world: Any = None
        self._actors: list[Any] = []
        self._controllers: list[Any] = []
        with server_errors(self._where):
            self._client = self._carla.Client(host, port)
            self._client.set_timeout(timeout_s)
            versions = self._client.get_client_version(), self._client.get_server_version()
        if versions[0] != versions[1]:  # semantic tags depend on it
            raise carla_drives.CarlaError(f"{self._where}: client {versions[0]}, server {versions[1]}; expected "
                                            f"equal versions.")

    def start(self, job: carla_drives.CarlaDrive) -> carla_frames.Tick:
        with server_errors(f"{self._where}, starting {job.split}/{job.run}"):
            rng = np.random.default_rng(job.seed)
            self._world = self._client.load_world(job.town)
            traffic = self._client.get_trafficmanager(self._traffic_port)
            self._make_synchronous(traffic, job.seed)
            self._world.set_weather(getattr(self._carla.WeatherParameters, job.weather))
            spawn_points = self._world.get_map().get_spawn_points()
            order = rng.permutation(len(spawn_points))
            ego = self._spawn(self._blueprint(EGO_BLUEPRINT, role_name="hero"), spawn_points[order[0]])
            self._ego = ego
            route = self._plan_route(spawn_points[order[0]].location, job.frames / self._settings.rate_hz, rng)
            self._place_traffic([spawn_points[index] for index in order[1:]], rng)
            self._place_sensors()
            self._agent = self._make_agent(ego, self._route_m) if self._make_agent else None
            if self._agent is None:
                ego.set_autopilot(True, self._traffic_port)
                traffic.auto_lane_change(ego, False)
                traffic.set_path(ego, route)
            for _ in range(WARM_UP_TICKS - 1):
                self._world.tick(self._timeout_s)
            return self._tick()

    def step(self) -> carla_frames.Tick:
        with server_errors(f"{self._where}, driving"):
            if self._agent is not None:
                self._ego.apply_control(self._agent(self._observed))
            return self._tick()

    def route_m(self) -> np.ndarray:
        return self._route_m

    def stop(self) -> None:
        """Raises nothing: what failed before is what should be told."""
        if self._world is None:
            return
        with contextlib.suppress(RuntimeError):
            for actor in self._controllers + [actor for actor in self._actors if "sensor" in actor.type_id]:
                actor.stop()
            destroy = self._carla.command.DestroyActor
            self._client.apply_batch([destroy(actor) for actor in self._controllers + self._actors[::-1]])
            settings = self._world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = False, None
            self._world.apply_settings(settings)
            self._client.get_trafficmanager(self._traffic_port).set_synchronous_mode(False)
        self._actors, self._controllers = [], []

    def _tick(self) -> carla_frames.Tick:
        frame = self._world.tick(self._timeout_s)
        measurements = carla_frames.collect(self._queues, frame, self._timeout_s)
        self._observed = carla_frames.Tick(
            frame, self._world.get_snapshot().timestamp.elapsed_seconds, self._ego.get_transform(),
            self._ego.get_velocity(), self._ego.get_control(), measurements, collided=drained(self._collisions))
        return self._observed

    def _make_synchronous(self, traffic: Any, seed: int) -> None:
        settings = self._world.get_settings()
        settings.synchronous_mode, settings.no_rendering_mode = True, False
        settings.fixed_delta_seconds = 1.0 / self._settings.rate_hz
        settings.substepping, settings.max_substep_delta_time = True, 0.01
        settings.max_substeps = math.ceil(100 / self._settings.rate_hz)
        self._world.apply_settings(settings)
        traffic.set_synchronous_mode(True)
        traffic.set_random_device_seed(seed)
        self._world.set_pedestrians_seed(seed)

    def _plan_route(self, start: Any, duration_s: float, rng: np.random.Generator) -> list[Any]:
        """A random way through the lanes, as carla.Location; the agent and the route map get it in metres."""
        waypoint = self._world.get_map().get_waypoint(start)
        waypoints = [waypoint]
        for _ in range(int(duration_s * _FASTEST_MPS / carla_frames.ROUTE_SPACING_M)):
            choices = waypoints[-1].next(carla_frames.ROUTE_SPACING_M)
            if not choices:
                break
            waypoints.append(choices[rng.integers(len(choices))])
        route = [waypoint.transform.location for waypoint in waypoints]
        self._route_m = np.array([(place.x, -place.y) for place in route])
        return route

    def _place_traffic(self, spawn_points: list[Any], rng: np.random.Generator) -> None:
        library = self._world.get_blueprint_library()
        cars = [car for car in library.filter("vehicle.*") if int(car.get_attribute("number_of_wheels")) == 4]
        for spawn_point in spawn_points[:self._vehicles]:
            car = self._world.try_spawn_actor(cars[rng.integers(len(cars))], spawn_point)
            if car is not None:
                self._actors.append(car)
                car.set_autopilot(True, self._traffic_port)
        people = library.filter("walker.pedestrian.*")
        control = library.find("controller.ai.walker")
        pedestrians = []
        for _ in range(self._walkers):
            place = self._world.get_random_location_from_navigation()
            pedestrian = place and self._world.try_spawn_actor(people[int(rng.integers(len(people)))],
                                                               self._carla.Transform(place))
            if pedestrian:
                pedestrians.append(pedestrian)
        self._actors += pedestrians
        self._controllers = [self._world.spawn_actor(control, self._carla.Transform(), pedestrian)
                             for pedestrian in pedestrians]
        self._world.tick(self._timeout_s)  # controllers can be started from the next tick on
        for controller in self._controllers:
            controller.start()
            controller.go_to_location(self._world.get_random_location_from_navigation())
            controller.set_max_speed(_WALKING_MPS)

    def _place_sensors(self) -> None:
        settings = self._settings
        picture = {"image_size_x": settings.width_px, "image_size_y": settings.height_px,
                   "fov": math.degrees(settings.fov_rad)}
        scan = {"channels": settings.lidar_rows, "range": settings.lidar_range_m,
                "points_per_second": round(settings.points_per_frame * settings.rate_hz),
                "rotation_frequency": settings.rate_hz,  # a whole turn each frame
                "upper_fov": math.degrees(settings.lidar.elevation_max_rad),
                "lower_fov": math.degrees(settings.lidar.elevation_min_rad)}
        x, y, z = settings.position_m
        mount = self._carla.Transform(self._carla.Location(x, -y, z))
        self._queues: dict[str, queue.Queue] = {}
        for name, kind, attributes in (("image", "camera.rgb", picture), ("depth", "camera.depth", picture),
                                       ("classes", "camera.semantic_segmentation", picture),
                                       ("lidar", "lidar.ray_cast_semantic", scan)):
            sensor = self._spawn(self._blueprint(f"sensor.{kind}", **attributes), mount, self._ego)
            self._queues[name] = queue.Queue()
            sensor.listen(self._queues[name].put)
        self._collisions: queue.Queue = queue.Queue()
        self._spawn(self._blueprint("sensor.other.collision"), mount, self._ego).listen(self._collisions.put)

    def _blueprint(self, name: str, **attributes: Any) -> Any:
        blueprint = self._world.get_blueprint_library().find(name)
        for attribute, value in attributes.items():
            blueprint.set_attribute(attribute, str(value))
        return blueprint

    def _spawn(self, blueprint: Any, transform: Any, parent: Any = None) -> Any:
        actor = self._world.spawn_actor(blueprint, transform, parent)
        self._actors.append(actor)
        return actor
