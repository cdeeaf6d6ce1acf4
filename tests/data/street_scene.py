"""A street of boxes on a textured ground under a sky, exactly as a camera and a lidar of any number of rows see it."""

import functools
import math

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view

WIDTH_PX, HEIGHT_PX = 480, 160
INTRINSICS = camera_ops.intrinsics_from_fov(WIDTH_PX, HEIGHT_PX, math.radians(80.0))
CAMERA_M, LIDAR_M = (1.2, 0.0, 1.5), (0.0, 0.0, 1.8)
CAMERA_TO_EGO = camera_ops.level_camera_to_ego(CAMERA_M)
FARTHEST_M = 90.0


def lidar(rows, columns=1024):
    """A lidar of so many rows over 30 degrees."""
    return config_lib.RangeViewGeometry(rows=rows, columns=columns, elevation_min_rad=math.radians(-25.0),
                                        elevation_max_rad=math.radians(5.0), position_m=LIDAR_M)


def frame(seed, rows, *, right_rad=0.0, down_rad=0.0, slope=0.0):
    """One raw frame; what the picture shows lies farther right and down than camera_to_ego says.

    Args:
      right_rad, down_rad: the error of camera_to_ego: the true camera looks farther left and up.
      slope: how steeply the road rises ahead.
    """
    return {"image": picture(seed, right_rad, down_rad, slope), "points_m": scan(seed, rows, slope),
            "intrinsics": INTRINSICS, "camera_to_ego": CAMERA_TO_EGO}


@functools.cache
def picture(seed, right_rad, down_rad, slope):
    """uint8 [H, W, 3]."""
    low_m, high_m, colour = _street(seed)
    column, row = np.meshgrid(np.arange(WIDTH_PX) + 0.5, np.arange(HEIGHT_PX) + 0.5)
    rays = np.stack([np.ones(column.size), -(column.ravel() - INTRINSICS[0, 2]) / INTRINSICS[0, 0],
                     -(row.ravel() - INTRINSICS[1, 2]) / INTRINSICS[1, 1]], axis=1) @ turn(right_rad, -down_rad).T
    distance, hit, axis = _cast(np.array(CAMERA_M), rays, low_m, high_m, slope)
    shade = np.array([0.8, 1.0, 1.2, 1.0])[axis]
    image = np.where(hit[:, None] >= 0, colour[np.maximum(hit, 0)] * shade[:, None], [180.0, 200.0, 230.0])
    ends_m = np.array(CAMERA_M) + rays * np.where(np.isfinite(distance), distance, 0.0)[:, None]
    road = np.abs(ends_m[:, 1]) < 3.5
    stripes = road & (np.abs(np.abs(ends_m[:, 1]) - 1.7) < 0.12) & (ends_m[:, 0] % 6 < 3)
    ground = np.where(stripes[:, None], 200.0, np.where(road[:, None], 85.0, np.array([70.0, 100.0, 60.0])))
    image = np.where((hit == -1)[:, None], ground, image) + np.random.default_rng(seed).normal(0, 4, image.shape)
    return np.clip(image, 0, 255).reshape(HEIGHT_PX, WIDTH_PX, 3).astype(np.uint8)


@functools.cache
def scan(seed, rows, slope):
    """float32 [N, 3], ego frame, with 2 cm of noise."""
    low_m, high_m, _ = _street(seed)
    directions = range_view.beam_directions(lidar(rows)).reshape(-1, 3).astype(np.float64)
    range_m, _, _ = _cast(np.array(LIDAR_M), directions, low_m, high_m, slope)
    seen = np.isfinite(range_m) & (range_m < FARTHEST_M)
    noise_m = np.random.default_rng(seed).normal(0, 0.02, int(seen.sum()))
    return (np.array(LIDAR_M) + directions[seen] * (range_m[seen] + noise_m)[:, None]).astype(np.float32)


def turn(yaw_rad, pitch_rad):
    """Rotation of the ego axes: yaw to the left, pitch downwards for positive angles."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    yaw = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    cosine, sine = math.cos(pitch_rad), math.sin(pitch_rad)
    return yaw @ np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def _street(seed):
    """Parked cars, poles and houses on both sides: corners low and high [N, 3], colours [N, 3]."""
    rng = np.random.default_rng(seed)
    low, high = [], []
    for side in (-1, 1):
        ahead = rng.uniform(5, 9)
        while ahead < 60:
            length, width, height, gap = {
                0: (4.2, 1.8, 1.5, 4.0), 1: (0.3, 0.3, 5.0, 3.0), 2: (5.5, 2.2, 2.8, 6.0)}[int(rng.integers(3))]
            middle = side * rng.uniform(3.6, 5.0)
            low.append((ahead, middle - width / 2, -0.5))
            high.append((ahead + length, middle + width / 2, height * rng.uniform(0.9, 1.1)))
            ahead += length + rng.uniform(1, gap + 3)
        ahead = rng.uniform(0, 15)
        while ahead < 80:
            length, height = rng.uniform(6, 14), rng.uniform(4, 9)
            inner = side * rng.uniform(9, 14)
            low.append((ahead, min(inner, inner + side * 8), -0.5))
            high.append((ahead + length, max(inner, inner + side * 8), height))
            ahead += length + rng.uniform(1, 10)
    return np.array(low), np.array(high), rng.uniform(20, 235, (len(low), 3))


def _cast(origin_m, rays, low_m, high_m, slope):
    """Distance along each ray (in its lengths), the box hit (-1 ground, -2 nothing) and the face's axis (3: ground)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        down = slope * rays[:, 0] - rays[:, 2]
        best = np.where(down > 1e-9, (origin_m[2] - slope * origin_m[0]) / down, np.inf)
        hit, axis = np.where(np.isfinite(best), -1, -2), np.full(len(rays), 3)
        for number, (low, high) in enumerate(zip(low_m, high_m, strict=True)):
            lift = slope * low[0] * np.array([0.0, 0.0, 1.0])
            first, second = (low + lift - origin_m) / rays, (high + lift - origin_m) / rays
            near, far = np.minimum(first, second), np.maximum(first, second)
            enter = near.max(axis=1)
            nearer = (enter < far.min(axis=1)) & (enter > 0) & (enter < best)
            best, hit = np.where(nearer, enter, best), np.where(nearer, number, hit)
            axis = np.where(nearer, near.argmax(axis=1), axis)
    return best, hit, axis
