"""From the CARLA client's measurements of one tick to a frame in the plain format; nothing here imports carla.

The client hands over BGRA images, depth in three bytes, semantic tags in the red channel, lidar detections of 24 bytes.
Right-handed from here on: y left.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from muvo_jax.data.carla.drives import CarlaError, Settings
from muvo_jax.data.muvo import files as muvo_files

CAMERAS = ("image", "depth", "classes")
SENSORS = (*CAMERAS, "lidar")
_DETECTION = np.dtype([("point", "<f4", 3), ("cos_angle", "<f4"), ("object", "<u4"), ("tag", "<u4")])
# The layout's route map: 192 pixels, 5 a metre, the ego vehicle 32 above the lower edge; its reader takes every third.
_ROUTE_PX, _ROUTE_PX_PER_M, _EGO_ROW, _ROUTE_WIDTH_PX, _ROUTE_STEP = 192, 5.0, 160, 16, 3
_ROUTE_AHEAD = 40  # points drawn, and searched for the nearest
ROUTE_SPACING_M = 2.0


class Tick(NamedTuple):
    """One tick. transform, velocity and control are the client's; `control` led from the tick before to this one, and
    `collided` tells whether the car hit something on the way.
    """

    frame: int
    timestamp_s: float
    transform: Any
    velocity: Any
    control: Any
    measurements: Mapping[str, Any]
    collided: bool = False


def collect(queues: Mapping[str, queue.Queue], frame: int, timeout_s: float) -> dict[str, Any]:
    """Each sensor's measurement of this frame; what is older is passed over.

    Raises:
      CarlaError: naming the sensor that sends nothing in time or has gone past the frame.
    """
    found = {}
    for name, waiting in queues.items():
        while name not in found:
            try:
                measurement = waiting.get(timeout=timeout_s)
            except queue.Empty:
                raise CarlaError(f"sensor {name} stalled: nothing for frame {frame} in {timeout_s:g} s. Restart the "
                                 f"server (and see that it renders), then run the command again.") from None
            if measurement.frame > frame:
                raise CarlaError(f"sensor {name} sent frame {measurement.frame} while {frame} was awaited: another "
                                 f"client ticks this server, or the sensor dropped a frame.")
            if measurement.frame == frame:
                found[name] = measurement
    return found


def decode(seen: Tick, settings: Settings) -> dict[str, np.ndarray]:
    """The measurements of a tick as plain.writer.RunWriter.write takes them."""
    pixels = {name: bgra(seen.measurements[name], name, settings) for name in CAMERAS}
    detections = np.frombuffer(seen.measurements["lidar"].raw_data, _DETECTION)
    points_m = muvo_files.to_ego_frame(detections["point"], settings.position_m)
    keep = np.isfinite(points_m).all(axis=1) & ~muvo_files.in_ego_box(points_m)
    return {"image": pixels["image"][..., 2::-1],
            # Blue is the most significant byte.
            "depth_m": muvo_files.DEPTH_RANGE_M * muvo_files.decode_depth(pixels["depth"]),
            "classes": muvo_files.LAYOUT_TAGS[pixels["classes"][..., 2]], "points_m": points_m[keep],
            "point_tags": muvo_files.LAYOUT_TAGS[np.minimum(detections["tag"][keep], 255)]}


def bgra(measurement: Any, name: str, settings: Settings) -> np.ndarray:
    """A camera's raw_data, uint8 [H, W, 4]; raises CarlaError for another size than asked for."""
    pixels = np.frombuffer(measurement.raw_data, np.uint8)
    shape = (settings.height_px, settings.width_px, 4)
    if (measurement.height, measurement.width) != shape[:2] or pixels.size != math.prod(shape):
        raise CarlaError(f"sensor {name}: {measurement.width}x{measurement.height} pixels in {pixels.size} bytes, "
                         f"expected {settings.width_px}x{settings.height_px} of 4 bytes.")
    return pixels.reshape(shape)


def pose_of(transform: Any) -> tuple[float, float, float]:
    """x_m, y_m, yaw_rad, right-handed, of a carla.Transform."""
    return transform.location.x, -transform.location.y, -math.radians(transform.rotation.yaw)


def forward_speed(transform: Any, velocity: Any) -> float:
    """Metres a second along the car's axis; negative when it rolls back."""
    pitch, yaw = math.radians(transform.rotation.pitch), math.radians(transform.rotation.yaw)
    return (math.cos(pitch) * (velocity.x * math.cos(yaw) + velocity.y * math.sin(yaw)) + velocity.z * math.sin(pitch))


class Route:
    """A planned route, and how far along it the car is."""

    def __init__(self, points_m: np.ndarray):
        self._points_m, self._next = np.asarray(points_m, np.float64), 0

    def advance(self, pose: tuple[float, float, float]) -> float:
        """Moves on to the nearest point ahead; returns the distance to it, metres."""
        ahead = self._points_m[self._next:self._next + _ROUTE_AHEAD]
        distances_m = np.hypot(*(ahead - pose[:2]).T)
        self._next += int(distances_m.argmin())
        return float(distances_m.min())

    def draw(self, pose: tuple[float, float, float]) -> np.ndarray:
        """The way ahead from above, uint8 [64, 64], 255 on the route, forward is up."""
        offset = self._points_m[self._next:self._next + _ROUTE_AHEAD] - pose[:2]
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        forward, left = offset[:, 0] * cosine + offset[:, 1] * sine, offset[:, 1] * cosine - offset[:, 0] * sine
        picture = Image.new("L", (_ROUTE_PX, _ROUTE_PX))
        line = np.stack([_ROUTE_PX / 2 - left * _ROUTE_PX_PER_M, _EGO_ROW - forward * _ROUTE_PX_PER_M], axis=1)
        ImageDraw.Draw(picture).line(list(map(tuple, line.tolist())), fill=255, width=_ROUTE_WIDTH_PX)
        return np.asarray(picture)[::_ROUTE_STEP, ::_ROUTE_STEP]

    def deviation(self, pose: tuple[float, float, float]) -> tuple[float, float]:
        """How far the car is beside the route where it stands, metres, and turned away from it, radians, 0 to pi."""
        here = self._points_m[min(self._next, len(self._points_m) - 2):][:2]
        along, offset = here[1] - here[0], np.asarray(pose[:2]) - here[0]
        aside_m = abs(along[0] * offset[1] - along[1] * offset[0]) / max(float(np.hypot(*along)), 1e-6)
        return float(aside_m), abs((pose[2] - math.atan2(along[1], along[0]) + math.pi) % (2 * math.pi) - math.pi)
