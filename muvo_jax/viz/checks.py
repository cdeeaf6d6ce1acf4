"""Pictures that show at a glance whether a recording is sound: sensors laid over each other, actions beside motion."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from muvo_jax import config as config_lib
from muvo_jax.ops import camera as camera_ops
from muvo_jax.viz import canvas, curves, panels

_DOT_PX = 2
_FAR_M = 60.0


def lidar_in_image(image: np.ndarray, points_m: np.ndarray, intrinsics: np.ndarray, camera_to_ego: np.ndarray,
                   columns_px: int = 960) -> np.ndarray:
    """The picture with every lidar return where it should be, pale near and dark far, near ones on top."""
    place_px, depth_m = camera_ops.project_to_image(points_m, intrinsics, camera_to_ego)
    picture = canvas.resize(image, columns_px) if image.shape[1] < columns_px else image
    place_px = place_px * (picture.shape[1] / image.shape[1])
    height, width = picture.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (depth_m > 0) & (place_px[:, 0] >= 0) & (place_px[:, 0] < width) & (place_px[:, 1] >= 0) & (
            place_px[:, 1] < height)
    place_px, depth_m = place_px[inside], depth_m[inside]
    colours = canvas.colour_map(np.sqrt(depth_m / _FAR_M), canvas.RANGE_COLOURS)
    drawn = Image.fromarray((picture * 0.75).astype(np.uint8))
    draw = ImageDraw.Draw(drawn)
    for index in np.argsort(-depth_m):
        column, row = place_px[index]
        draw.rectangle([column, row, column + _DOT_PX - 1, row + _DOT_PX - 1],
                       fill=tuple(int(channel) for channel in colours[index]))
    return np.array(drawn)


def above(points_m: np.ndarray, occupancy: np.ndarray | None, grid: config_lib.VoxelGrid | None,
          side_px: int = 384, *, ego_m: tuple[float, float]) -> np.ndarray:
    """Points from above, beside the voxels (where there are any) with the same points as white dots over them."""
    extent_m = 48.0 if grid is None else max(abs(grid.origin_m[0]), abs(grid.origin_m[1]))
    heights = {} if grid is None else {"height_span_m": panels.height_span(grid)}  # of the voxels beside them
    seen = panels.birds_eye(points_m, extent_m=extent_m, side_px=side_px, ego_m=ego_m, **heights)
    parts = [canvas.caption(seen, "points from above")]
    if occupancy is not None and grid is not None:
        voxels = panels.occupancy_from_above(occupancy, grid, columns_px=side_px, ego_m=ego_m)
        scale = side_px / (grid.shape[1] * grid.voxel_size_m)
        rows = np.floor((grid.origin_m[0] + grid.shape[0] * grid.voxel_size_m - points_m[:, 0]) * scale).astype(int)
        columns = np.floor((grid.origin_m[1] + grid.shape[1] * grid.voxel_size_m - points_m[:, 1]) * scale).astype(int)
        inside = (rows >= 0) & (rows < voxels.shape[0]) & (columns >= 0) & (columns < voxels.shape[1])
        dotted = voxels.copy()
        dotted[rows[inside], columns[inside]] = 255
        parts += [canvas.caption(voxels, "voxels from above"), canvas.caption(dotted, "voxels, points in white")]
    return canvas.stack(parts, axis=1)


def action_against_motion(time_s: np.ndarray, steering: np.ndarray, yaw_rate_radps: np.ndarray,
                          acceleration: np.ndarray, acceleration_mps2: np.ndarray) -> np.ndarray:
    """Steering over the yaw rate to the right, and acceleration over the change of speed: they should go together.

    Each motion is scaled to the action's size by least squares of absolute values, so that only its sign and shape
    count. Values that are not finite leave gaps.
    """
    plots = []
    for title, action, motion, name in (
            ("steering", steering, -yaw_rate_radps, "yaw rate to the right"),
            ("acceleration", acceleration, acceleration_mps2, "change of speed")):
        finite = np.isfinite(motion) & np.isfinite(action)
        size = np.abs(motion[finite]).mean() if finite.any() else 0.0
        scale = np.abs(action[finite]).mean() / size if size > 0 else 1.0
        series = {title: (time_s.tolist(), action.tolist()),
                  f"{name} x {scale:.3g}": (time_s.tolist(), (motion * scale).tolist())}
        plots.append(curves.curve(series, title, size_px=(220, 760)))
    return canvas.stack(plots, axis=0)
