"""Pinhole cameras: intrinsics, depth maps to points, points to pixels, resizing (host side, NumPy).

Image coordinates are continuous and pixel i covers [i, i + 1), so its centre is i + 0.5 and scaling an image by f
scales every intrinsic by f. (The reference takes integer coordinates for pixel centres, half a pixel off.)
Camera frame: x right, y down, z forward. Ego frame: x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from PIL import Image

from muvo_jax.ops import range_view


def intrinsics_from_fov(width_px: int, height_px: int, horizontal_fov_rad: float) -> np.ndarray:
    """Returns the float32 [3, 3] intrinsics of a camera with square pixels and a centred principal point."""
    focal_px = 0.5 * width_px / np.tan(0.5 * horizontal_fov_rad)
    return np.array([[focal_px, 0, 0.5 * width_px], [0, focal_px, 0.5 * height_px], [0, 0, 1]], np.float32)


def level_camera_to_ego(position_m: tuple[float, float, float]) -> np.ndarray:
    """Returns the float32 [4, 4] pose of a camera at `position_m` (ego frame) that looks straight ahead."""
    x, y, z = position_m
    return np.array([[0, 0, 1, x], [-1, 0, 0, y], [0, -1, 0, z], [0, 0, 0, 1]], np.float32)


def depth_to_points(depth_m: np.ndarray, intrinsics: np.ndarray, camera_to_ego: np.ndarray) -> np.ndarray:
    """Lifts the centre of every pixel with a finite, positive depth.

    Args:
      depth_m: [H, W], along the optical axis, metres; infinite (or NaN, or not positive) where nothing was hit.
      intrinsics: [3, 3].
      camera_to_ego: [4, 4].

    Returns:
      float32 [P, 3], ego frame, metres, row by row; P counts the pixels with a depth.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    row, column = np.nonzero(valid)
    depth = np.asarray(depth_m, np.float32)[valid]
    right = (column.astype(np.float32) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0] * depth
    down = (row.astype(np.float32) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1] * depth
    camera = np.stack([right, down, depth], axis=1).astype(np.float32)
    return camera @ camera_to_ego[:3, :3].T.astype(np.float32) + camera_to_ego[:3, 3].astype(np.float32)


def reference_depth_points(depth_m: np.ndarray, horizontal_fov_rad: float, position_m: tuple[float, float, float], *,
                           far_m: float = 1000.0, range_m: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Lifts a depth map as the reference's data tools do: whole pixel coordinates, in float64.

    Args:
      depth_m: [H, W], along the optical axis, metres.
      position_m: of the level camera, ego frame.
      far_m: depths from here on are sky.
      range_m: points from here on (distance from the camera) are left out.

    Returns:
      float64 [P, 3], ego frame, metres, row by row, and int64 [P], the flat number of each point's pixel.
    """
    height_px, width_px = depth_m.shape
    depth_m = np.asarray(depth_m, np.float64)
    focal_px = width_px / (2.0 * np.tan(0.5 * horizontal_fov_rad))
    right = ((np.arange(width_px) - width_px / 2.0) / focal_px)[None]
    down = ((np.arange(height_px) - height_px / 2.0) / focal_px)[:, None]
    # Where a pixel looks decides how deep it may be; so no point is made that is not kept.
    deepest_m = np.minimum(far_m, range_m / np.sqrt(1.0 + right * right + down * down))
    pixel = np.flatnonzero(depth_m.reshape(-1) < deepest_m.reshape(-1))
    row, column = np.divmod(pixel.astype(np.int32), np.int32(width_px))
    depth = depth_m.reshape(-1)[pixel]
    points_m = np.empty((len(pixel), 3))
    points_m[:, 0] = depth + position_m[0]
    points_m[:, 1] = position_m[1] - right[0][column] * depth
    points_m[:, 2] = position_m[2] - down[:, 0][row] * depth
    return points_m, pixel


def project_to_image(points_m: np.ndarray, intrinsics: np.ndarray,
                     camera_to_ego: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects points [P, 3] (ego frame, m) into the image.

    Returns:
      uv_px: float32 [P, 2], continuous (column, row) coordinates, NaN for points that are not in front of the camera.
      depth_m: float32 [P], along the optical axis, negative behind the camera.

    Raises:
      ValueError: for another shape or for points that are not finite.
    """
    points_m = range_view.check_points(points_m)
    ego_to_camera = np.linalg.inv(np.asarray(camera_to_ego, np.float64))
    camera = points_m @ ego_to_camera[:3, :3].T + ego_to_camera[:3, 3]
    depth_m = camera[:, 2]
    safe = np.where(depth_m > 1e-6, depth_m, np.nan)
    uv_px = np.stack([intrinsics[0, 0] * camera[:, 0] / safe + intrinsics[0, 2],
                      intrinsics[1, 1] * camera[:, 1] / safe + intrinsics[1, 2]], axis=1)
    return uv_px.astype(np.float32), depth_m.astype(np.float32)


def resize_crop(image: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Scales an image to the wanted width and cuts rows off its top (the road is at the bottom).

    Args:
      image: uint8 [H, W, 3] or [H, W].
      intrinsics: [3, 3] of `image`.
      size: wanted (rows, columns).

    Returns:
      The image, uint8 [rows, columns(, 3)], and its float32 [3, 3] intrinsics.

    Raises:
      ValueError: where the scaled image has fewer rows than wanted, saying how many there are.
    """
    height, width = image.shape[:2]
    rows, columns = size
    scaled_height = _scaled_height(height, width, size)
    if (scaled_height, columns) != (height, width):
        image = np.asarray(Image.fromarray(image).resize((columns, scaled_height), Image.Resampling.BILINEAR))
    scaled = np.array(intrinsics, np.float32)
    scaled[0] *= columns / width
    scaled[1] *= scaled_height / height
    scaled[1, 2] -= scaled_height - rows
    return np.ascontiguousarray(image[scaled_height - rows:]), scaled


def resize_crop_nearest(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """As `resize_crop` for what must not be mixed, classes or distances [H, W]: the nearest pixel, in its dtype.

    Raises:
      ValueError: as resize_crop.
    """
    (height, width), (rows, columns) = picture.shape, size
    scaled_height = _scaled_height(height, width, size)
    row = ((np.arange(scaled_height - rows, scaled_height) + 0.5) * height / scaled_height).astype(np.intp)
    column = ((np.arange(columns) + 0.5) * width / columns).astype(np.intp)
    return np.ascontiguousarray(picture[row[:, None], column[None]])


def _scaled_height(height: int, width: int, size: tuple[int, int]) -> int:
    rows, columns = size
    scaled_height = round(height * columns / width)
    if scaled_height < rows:
        raise ValueError(f"image of {height}x{width} pixels scaled to {columns} columns has {scaled_height} rows, "
                         f"fewer than the {rows} wanted; choose model.image_size with at most "
                         f"{scaled_height // 32 * 32} rows.")
    return scaled_height
