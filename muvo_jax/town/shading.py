"""Colours of the town: textures that are functions of place, sunlight, wet roads, fog, sky and rain."""

from __future__ import annotations

import numpy as np

from muvo_jax.town import boxes as box_lib
from muvo_jax.town import ground as ground_lib
from muvo_jax.town import raycast, settings
from muvo_jax.town.scenery import STOREY_M


def shade(fan: raycast.Fan, hits: raycast.Hits, origin_m: np.ndarray, yaw_rad: float, boxes: box_lib.Boxes,
          ground: ground_lib.Ground, weather: settings.Weather, focal_px: float,
          rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Colours every ray of the camera's fan.

    Returns:
      image uint8 [R, C, 3] and classes uint8 [R, C].
    """
    shape = fan.slopes.shape
    found, distance_m, slope = hits.box.ravel(), hits.distance_m.ravel(), fan.slopes.ravel()
    azimuth_rad = np.repeat((fan.azimuths_rad + yaw_rad).astype(np.float32), shape[1])
    flat = np.stack([np.cos(azimuth_rad[::shape[1]]), np.sin(azimuth_rad[::shape[1]])], 1)
    origin = origin_m.astype(np.float32)
    colour = np.empty((len(found), 3), np.float32)
    classes = np.full(len(found), box_lib.SKY, np.uint8)

    sky = np.flatnonzero(found == raycast.NOTHING)
    colour[sky] = _sky(azimuth_rad[sky], slope[sky], weather)

    here = np.flatnonzero(found == raycast.GROUND)
    away_m = distance_m[here]
    # A pixel covers more ground along the view than across it: the geometric mean is a fair level of detail.
    footprint_m = away_m / np.float32(focal_px) * np.sqrt(np.maximum(away_m / origin[2], 1))
    albedo, classes[here] = ground_lib.look_up(ground, flat[here // shape[1]] * away_m[:, None] + origin[None, :2],
                                               footprint_m)
    colour[here] = _wet_ground(albedo, classes[here], azimuth_rad[here], slope[here], weather)

    here = np.flatnonzero(found >= 0)
    away_m, box = distance_m[here], found[here]
    colour[here] = _surface(boxes, box, flat[here // shape[1]] * away_m[:, None] + origin[None, :2],
                            away_m * slope[here] + origin[2], weather)
    classes[here] = box_lib.CLASS_OF_MATERIAL[boxes.material[box]]

    haze = np.exp(-np.float32(weather.fog_per_m) * distance_m)
    haze[sky] = 1
    colour = colour * haze[:, None] + np.asarray(weather.horizon, np.float32) * (1 - haze)[:, None]
    image = np.ascontiguousarray(colour.reshape(*shape, 3).transpose(1, 0, 2))
    if weather.rain:
        _add_rain(image, weather, rng)
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), np.ascontiguousarray(classes.reshape(shape).T)


def _sun_direction(weather: settings.Weather) -> np.ndarray:
    low = np.cos(weather.sun_elevation_rad)
    return np.array([low * np.cos(weather.sun_azimuth_rad), low * np.sin(weather.sun_azimuth_rad),
                     np.sin(weather.sun_elevation_rad)], np.float32)


def _sky(azimuth_rad: np.ndarray, slope: np.ndarray, weather: settings.Weather) -> np.ndarray:
    """From horizon to zenith, a glow about the sun, and soft clouds, [P, 3]."""
    height = np.clip(slope / 0.45, 0, 1)[:, None] ** 0.7
    colour = np.asarray(weather.horizon, np.float32) * (1 - height) + np.asarray(weather.zenith, np.float32) * height
    turn = np.cos(azimuth_rad - np.float32(weather.sun_azimuth_rad))
    glow = np.clip(turn, 0, 1) ** 12 * np.exp(-np.abs(np.arctan(slope) - weather.sun_elevation_rad) * 4)
    colour = colour + 0.6 * glow[:, None] * np.asarray(weather.sun, np.float32)
    puffs = (np.sin(azimuth_rad * 5 + 3 * np.sin(slope * 9)) * np.sin(slope * 17 + 2 * np.sin(azimuth_rad * 3))
             + 0.5 * np.sin(azimuth_rad * 13 + slope * 21))
    cloud = np.clip(puffs * 0.6 + weather.clouds - 0.35, 0, 1)[:, None] * 0.5
    white = 0.5 * np.asarray(weather.horizon, np.float32) + 0.5 * np.asarray(weather.ambient, np.float32) + 0.1
    return colour * (1 - cloud) + white * cloud


def _wet_ground(albedo: np.ndarray, classes: np.ndarray, azimuth_rad: np.ndarray, slope: np.ndarray,
                weather: settings.Weather) -> np.ndarray:
    """Lights the ground; water darkens hard surfaces and mirrors the sky at flat angles."""
    light = np.asarray(weather.ambient, np.float32) + np.asarray(weather.sun, np.float32) * _sun_direction(weather)[2]
    wet = np.where(classes == box_lib.GRASS, np.float32(0.15), np.float32(1.0)) * np.float32(weather.wetness)
    colour = albedo * light * (1 - 0.35 * wet)[:, None]
    if weather.wetness == 0:
        return colour
    mirror = np.clip(wet * (0.08 + 0.75 * (1 - np.clip(-slope / 0.35, 0, 1)) ** 3), 0, 0.7)[:, None]
    return colour * (1 - mirror) + 0.85 * _sky(azimuth_rad, -slope, weather) * mirror


def _surface(boxes: box_lib.Boxes, box: np.ndarray, place_m: np.ndarray, height_m: np.ndarray,
             weather: settings.Weather) -> np.ndarray:
    """Lit colours [P, 3] of points on boxes."""
    heading, half_m, z_m = boxes.heading[box], boxes.half_m[box], boxes.z_m[box]
    offset = place_m - boxes.centre_m[box]
    along = offset[:, 0] * heading[:, 0] + offset[:, 1] * heading[:, 1]
    across = offset[:, 1] * heading[:, 0] - offset[:, 0] * heading[:, 1]
    up = height_m - 0.5 * (z_m[:, 0] + z_m[:, 1])
    # The face of a surface point is the one it is nearest to.
    depth_x, depth_y = half_m[:, 0] - np.abs(along), half_m[:, 1] - np.abs(across)
    depth_z = 0.5 * (z_m[:, 1] - z_m[:, 0]) - np.abs(up)
    face = np.where(depth_z < np.minimum(depth_x, depth_y), 2, np.where(depth_x <= depth_y, 0, 1))
    sign = np.sign(np.where(face == 0, along, np.where(face == 1, across, up)))
    # On a vertical face u runs along the wall.
    u = np.where(face == 0, across, along)
    half_u = np.where(face == 0, half_m[:, 1], half_m[:, 0])
    albedo = boxes.colour[box]
    material = boxes.material[box]
    for kind, paint in _PAINTERS.items():
        here = np.flatnonzero(material == kind)
        if len(here):
            albedo[here] = paint(albedo[here], face[here], sign[here], u[here], half_u[here], height_m[here], z_m[here],
                                 place_m[here])
    return albedo * _face_light(boxes, weather)[box, 2 * face + (sign > 0)]


def _face_light(boxes: box_lib.Boxes, weather: settings.Weather) -> np.ndarray:
    """Light on the faces back, front, right, left, bottom, top of each box, float32 [M, 6, 3]."""
    cosine, sine = boxes.heading[:, 0], boxes.heading[:, 1]
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    normal = np.stack([np.stack(axis, -1) for axis in (
        (-cosine, -sine, zero), (cosine, sine, zero), (sine, -cosine, zero), (-sine, cosine, zero),
        (zero, zero, -one), (zero, zero, one))], 1)
    sunny = np.clip(normal @ _sun_direction(weather), 0, 1)[..., None]
    sky_share = (0.80 + 0.20 * normal[..., 2] + 0.08 * normal[..., 0])[..., None]
    return np.asarray(weather.ambient, np.float32) * sky_share + np.asarray(weather.sun, np.float32) * sunny


def _paint_wall(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    """Rows of windows, a darker base, doors in the middle of the wide faces."""
    albedo = albedo * (1 - 0.08 * (face == 0))[:, None]
    pitch = 2 * half_u / np.maximum(np.round(2 * half_u / 2.6), 1)
    across = (u + half_u) / pitch
    up = height_m / STOREY_M
    window = ((np.abs(across % 1 - 0.5) < 0.27) & (np.abs(up % 1 - 0.55) < 0.26) & (face != 2)
              & (height_m < z_m[:, 1] - 0.8))
    frame = ((np.abs(across % 1 - 0.5) < 0.33) & (np.abs(up % 1 - 0.55) < 0.32) & (face != 2)
             & (height_m < z_m[:, 1] - 0.8))
    shine = 0.75 + 0.5 * _noise(np.floor(across), np.floor(up), np.floor(half_u * 7))
    glass = np.array([0.20, 0.26, 0.33], np.float32) * shine[:, None]
    base = (height_m < 0.5)[:, None]
    door = (face == 1) & (np.abs(u) < 0.65) & (height_m < 2.2)
    albedo = np.where(frame[:, None], np.clip(albedo * 1.25, 0, 1), albedo)
    albedo = np.where(window[:, None], glass, albedo)
    albedo = np.where(base, 0.6 * albedo, albedo)
    return np.where(door[:, None], np.array([0.30, 0.18, 0.12], np.float32), albedo)


def _paint_roof(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    return albedo * (0.88 + 0.18 * ((height_m - z_m[:, 0]) % 0.5 < 0.28))[:, None]


def _paint_leaves(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    blotch = _noise(np.floor(place_m[:, 0] * 2.5), np.floor(place_m[:, 1] * 2.5), np.floor(height_m * 2.5))
    rounded = 0.75 + 0.35 * (height_m - z_m[:, 0]) / (z_m[:, 1] - z_m[:, 0])
    return albedo * (rounded * (0.75 + 0.5 * blotch))[:, None]


def _paint_body(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    """Wheels on the flanks, red lights behind, white ones in front, a dark bumper."""
    wheel = (face == 1) & (np.hypot(np.abs(u) - 0.62 * half_u, height_m - 0.34) < 0.36)
    lamp = (face == 0) & (np.abs(u) > 0.55 * half_u) & (height_m > 0.52) & (height_m < 0.78)
    dark = (height_m < 0.38) | wheel
    albedo = np.where(dark[:, None], np.array([0.06, 0.06, 0.07], np.float32), albedo)
    light = np.where((sign > 0)[:, None], np.array([1.0, 1.0, 0.85], np.float32),
                     np.array([0.85, 0.08, 0.06], np.float32))
    return np.where(lamp[:, None], light, albedo)


def _paint_cabin(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    """Windows all round, with pillars, below a painted roof."""
    glass = ((face != 2) & (height_m < z_m[:, 1] - 0.12) & (np.abs(u) < 0.92 * half_u)
             & ((face == 0) | (np.abs(u) > 0.05)))
    return np.where(glass[:, None], np.array([0.13, 0.17, 0.21], np.float32), albedo)


def _paint_person(albedo, face, sign, u, half_u, height_m, z_m, place_m):
    """Trousers below, a coloured top above."""
    return np.where((height_m < 0.82)[:, None], np.array([0.13, 0.15, 0.24], np.float32), albedo)


_PAINTERS = {box_lib.WALL: _paint_wall, box_lib.ROOF: _paint_roof, box_lib.LEAVES: _paint_leaves,
             box_lib.HEDGE: _paint_leaves, box_lib.CAR_BODY: _paint_body, box_lib.CAR_CABIN: _paint_cabin,
             box_lib.PERSON: _paint_person}


def _noise(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """A hash of three whole numbers to [0, 1), float32."""
    value = (first.astype(np.int32).view(np.uint32) * np.uint32(73856093)
             ^ second.astype(np.int32).view(np.uint32) * np.uint32(19349663)
             ^ third.astype(np.int32).view(np.uint32) * np.uint32(83492791))
    value = (value ^ (value >> np.uint32(13))) * np.uint32(0x5BD1E995)
    return (value >> np.uint32(8)).astype(np.float32) / np.float32(2**24)


def _add_rain(image: np.ndarray, weather: settings.Weather, rng: np.random.Generator) -> None:
    """Draws short bright streaks."""
    rows, columns = image.shape[:2]
    count = round(weather.rain * rows * columns / 160)
    row, column = rng.integers(0, rows, count), rng.integers(0, columns, count)
    length = rng.integers(2, max(3, rows // 12), count)
    strength = rng.uniform(0.06, 0.20, count).astype(np.float32)
    for step in range(int(length.max(initial=0))):
        rows_here = row + step
        drawn = (step < length) & (rows_here < rows)
        pixel = image[rows_here[drawn], column[drawn]]
        image[rows_here[drawn], column[drawn]] = pixel + strength[drawn, None] * (0.9 - pixel)
