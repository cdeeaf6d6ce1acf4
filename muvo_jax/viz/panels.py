"""One sensor, one frame, one picture: plain NumPy in, uint8 [rows, columns, 3] out, at the data's own resolution.

Seen from above, forward is up and left is left. Colours: range from pale (near) to dark (far), height from blue (low)
to red (high); what a sensor does not know stays near black.
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.viz import canvas

NO_RETURN = (12, 13, 18)
UNKNOWN = (44, 47, 58)
EGO = (250, 250, 250)
SKY = (20, 23, 31)
MOST_CLASSES = 32
EGO_WIDTH_M = 2.0
# From a car's rear end to its front, in the ego frame.
OVER_REAR_AXLE_M, OVER_MIDDLE_M = (-1.1, 3.7), (-2.3, 2.3)
_BEHIND_M = 4.6  # farther behind things would hide what is ahead


def ego_of(contract: config_lib.ActionContract) -> tuple[float, float]:
    """From where to where the car reaches: a bicycle's ego frame lies over its rear axle, CARLA's over the middle."""
    return OVER_REAR_AXLE_M if contract.kinematics == "bicycle" else OVER_MIDDLE_M


def camera(image: np.ndarray) -> np.ndarray:
    """An RGB image, uint8 or float in [0, 1] (clipped)."""
    if image.dtype == np.uint8:
        return image
    return (np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0).round().astype(np.uint8)


def range_image(range_view: np.ndarray, *, far_m: float, threshold_m: float = 1.0) -> np.ndarray:
    """A range view [Hr, Wr, 4] coloured by its range in metres; pixels without return are near black.

    The scale is square-root, so that near structure, where most pixels are, keeps its contrast.
    """
    range_m = np.asarray(range_view)[..., 3]
    colours = canvas.colour_map(np.sqrt(np.clip(range_m / far_m, 0.0, 1.0)), canvas.RANGE_COLOURS)
    return np.where((range_m > threshold_m)[..., None], colours, np.array(NO_RETURN, np.uint8))


def depth_image(depth_m: np.ndarray, *, far_m: float) -> np.ndarray:
    """Distances [H, W] in metres in the colours of `range_image`; what is not positive is near black."""
    return range_image(np.repeat(depth_m[..., None], 4, axis=-1), far_m=far_m, threshold_m=0.0)


def class_image(classes: np.ndarray) -> np.ndarray:
    """Class numbers [H, W], each in its colour; 255, unlabelled, is black."""
    return canvas.class_colours(MOST_CLASSES)[classes]


def ground_plan(classes: np.ndarray, side_px: int) -> np.ndarray:
    """Class numbers [X, Y] from above: forward up, left left; background near black."""
    picture = class_image(classes)
    picture[classes == 0] = NO_RETURN
    return canvas.resize_hard(np.ascontiguousarray(picture[::-1, ::-1]), side_px)


def height_fraction(height_m: np.ndarray, height_span_m: tuple[float, float]) -> np.ndarray:
    low, high = height_span_m
    return (height_m - low) / max(high - low, 1e-6)


def birds_eye(points_m: np.ndarray, *, extent_m: float, side_px: int = 256,
              height_span_m: tuple[float, float] = (0.0, 6.0),
              ego_m: tuple[float, float] = OVER_REAR_AXLE_M) -> np.ndarray:
    """Points [P, 3] (ego frame) from above, coloured by height, higher over lower; rings every 10 m around the ego."""
    picture = canvas.blank(side_px, side_px, NO_RETURN)
    scale = side_px / (2.0 * extent_m)
    picture = _rings(picture, scale, extent_m)
    points_m = np.asarray(points_m, np.float64)
    points_m = points_m[np.isfinite(points_m).all(axis=-1)]
    points_m = points_m[np.argsort(points_m[:, 2], kind="stable")]
    rows = np.floor((extent_m - points_m[:, 0]) * scale).astype(np.int64)
    columns = np.floor((extent_m - points_m[:, 1]) * scale).astype(np.int64)
    inside = (rows >= 0) & (rows < side_px) & (columns >= 0) & (columns < side_px)
    colours = canvas.colour_map(height_fraction(points_m[:, 2], height_span_m), canvas.HEIGHT_COLOURS)
    picture[rows[inside], columns[inside]] = colours[inside]
    return _ego_box(picture, scale, extent_m, extent_m, ego_m)


def occupancy_from_above(occupancy: np.ndarray, grid: config_lib.VoxelGrid,
                         height_span_m: tuple[float, float] | None = None, columns_px: int | None = None,
                         ego_m: tuple[float, float] = OVER_REAR_AXLE_M) -> np.ndarray:
    """Voxels [X, Y, Z] (0 empty, 1 occupied, 255 unknown) from above: each column in the colour of its highest voxel.

    Columns of which nothing is known are dark grey, known and empty ones near black.
    """
    occupied = occupancy == types.OCCUPANCY_OCCUPIED
    top = occupancy.shape[2] - 1 - np.argmax(occupied[:, :, ::-1], axis=2)
    height_m = grid.origin_m[2] + (top + 0.5) * grid.voxel_size_m
    colours = canvas.colour_map(height_fraction(height_m, height_span_m or height_span(grid)), canvas.HEIGHT_COLOURS)
    unknown = (occupancy == types.OCCUPANCY_UNKNOWN).all(axis=2)
    ground = np.where(unknown[..., None], np.array(UNKNOWN, np.uint8), np.array(NO_RETURN, np.uint8))
    picture = np.where(occupied.any(axis=2)[..., None], colours, ground)
    picture = picture[::-1, ::-1]  # array x grows forward and y to the left; picture rows grow down, columns right
    picture = canvas.resize_hard(picture, columns_px or grid.shape[1])
    scale = picture.shape[1] / grid.shape[1]
    front_m = grid.origin_m[0] + grid.shape[0] * grid.voxel_size_m
    left_m = grid.origin_m[1] + grid.shape[1] * grid.voxel_size_m
    return _ego_box(np.ascontiguousarray(picture), scale / grid.voxel_size_m, front_m, left_m, ego_m)


def height_span(grid: config_lib.VoxelGrid, top_m: float = 6.0) -> tuple[float, float]:
    """Heights between which colours vary: from the grid's floor (at lowest -1 m) to its top, at most 6 m."""
    return max(grid.origin_m[2], -1.0), min(grid.origin_m[2] + grid.shape[2] * grid.voxel_size_m, top_m)


def occupancy_from_behind(occupancy: np.ndarray, grid: config_lib.VoxelGrid, *, size_px: tuple[int, int] = (144, 384),
                          height_span_m: tuple[float, float] | None = None) -> np.ndarray:
    """The occupied voxels in perspective: a camera behind and above the ego looks forward over what is ahead.

    Every pixel walks its ray from voxel to voxel (Amanatides and Woo), so that near blocks hide far ones; faces are
    shaded by their direction and fade with distance. What lies behind the ego is left out: it would hide the rest.
    """
    directions, eye_m = _oblique_camera(size_px, grid)
    behind = max(0, int((-_BEHIND_M - grid.origin_m[0]) / grid.voxel_size_m))
    occupied = occupancy == types.OCCUPANCY_OCCUPIED
    occupied[:behind] = False
    voxel, axis, distance_m = _march(occupied, grid, eye_m, directions)
    height_m = grid.origin_m[2] + (voxel[:, 2] + 0.5) * grid.voxel_size_m
    colours = canvas.colour_map(height_fraction(height_m, height_span_m or height_span(grid)), canvas.HEIGHT_COLOURS)
    shade = np.array([0.78, 0.6, 1.0, 0.0])[axis]
    reach_m = grid.shape[0] * grid.voxel_size_m
    fog = np.clip(distance_m / reach_m, 0.0, 1.0)[:, None] * 0.55
    lit = colours * shade[:, None] * (1.0 - fog) + np.array(SKY, np.float64) * fog
    picture = np.where((axis == 3)[:, None], np.array(SKY, np.float64), lit)
    return picture.round().astype(np.uint8).reshape(*size_px, 3)


def action_bars(action: np.ndarray, columns: int, labels: bool = True) -> np.ndarray:
    """Acceleration (green throttle, red brake) and steering (blue), each a bar from the middle; +1 is right."""
    acceleration, steering = (float(value) for value in action)
    throttle_colour = (96, 200, 120) if acceleration >= 0 else (228, 86, 86)
    bars = [_bar(acceleration, throttle_colour, columns, "accel" if labels else "", ("brake", "throttle")),
            _bar(steering, (92, 168, 236), columns, "steer" if labels else "", ("left", "right"))]
    return canvas.stack(bars, axis=0, gap=3)


def _bar(value: float, colour: canvas.Colour, columns: int, label: str, ends: tuple[str, str]) -> np.ndarray:
    picture = canvas.blank(18, columns)
    left = 44 if label else 0
    right = columns - (46 if label else 0)
    middle, half = (left + right) // 2, (right - left) // 2 - 2
    picture[2:16, left:right] = np.array(canvas.PANEL, np.uint8)
    stop = middle + round(np.clip(value, -1.0, 1.0) * half)
    picture[4:14, min(middle, stop) : max(middle, stop) + 1] = np.array(colour, np.uint8)
    picture[2:16, middle : middle + 1] = np.array(canvas.FAINT_INK, np.uint8)
    if label:
        picture = canvas.write(picture, label, 9, 2, size_px=12, colour=canvas.FAINT_INK, anchor="lm")
        picture = canvas.write(picture, f"{value:+.2f}", 9, columns - 2, size_px=12, anchor="rm")
        if right - left > 220:
            picture = canvas.write(picture, ends[0], 9, left + 5, size_px=11, colour=canvas.FAINT_INK, anchor="lm")
            picture = canvas.write(picture, ends[1], 9, right - 5, size_px=11, colour=canvas.FAINT_INK, anchor="rm")
    return picture


def _rings(picture: np.ndarray, scale: float, extent_m: float) -> np.ndarray:
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    centre = picture.shape[0] / 2.0
    for radius_m in np.arange(10.0, extent_m + 0.1, 10.0):
        radius = radius_m * scale
        draw.ellipse([centre - radius, centre - radius, centre + radius, centre + radius], outline=(44, 48, 60))
    return np.array(image)


def _ego_box(picture: np.ndarray, scale: float, front_m: float, left_m: float,
             ego_m: tuple[float, float]) -> np.ndarray:
    image = Image.fromarray(picture)
    box = [(left_m - EGO_WIDTH_M / 2.0) * scale, (front_m - ego_m[1]) * scale,
           (left_m + EGO_WIDTH_M / 2.0) * scale, (front_m - ego_m[0]) * scale]
    ImageDraw.Draw(image).rectangle(box, outline=EGO)
    return np.array(image)


def _oblique_camera(size_px: tuple[int, int], grid: config_lib.VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Unit ray directions [rows * columns, 3] and the eye, both in the ego frame."""
    rows, columns = size_px
    extent_m = grid.shape[0] * grid.voxel_size_m
    eye_m = np.array([-0.22 * extent_m, 0.0, 0.2 * extent_m])
    pitch_rad, half_width = np.deg2rad(20.0), np.tan(np.deg2rad(38.0))
    right = ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * half_width
    down = ((np.arange(rows) + 0.5) / rows * 2.0 - 1.0) * half_width * rows / columns
    down, right = np.meshgrid(down, right, indexing="ij")
    forward = np.cos(pitch_rad) - np.sin(pitch_rad) * down
    up = -np.sin(pitch_rad) - np.cos(pitch_rad) * down
    directions = np.stack([forward, -right, up], axis=-1).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True), eye_m


def _march(occupied: np.ndarray, grid: config_lib.VoxelGrid, eye_m: np.ndarray,
           directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First occupied voxel along each ray: its index [R, 3], the axis of the face hit (3: nothing), distance (m)."""
    shape = np.array(occupied.shape)
    direction = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    eye = (eye_m - np.array(grid.origin_m)) / grid.voxel_size_m
    to_low, to_high = (0.0 - eye) / direction, (shape - eye) / direction
    near, far = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
    entry = np.maximum(near.max(axis=1), 0.0)
    voxel = np.clip(np.floor(eye + direction * (entry + 1e-6)[:, None]), 0, shape - 1).astype(np.int64)
    padded = np.pad(np.where(occupied, 1, 0).astype(np.int8), 1, constant_values=2)  # 2: outside, so no bounds checks
    strides = np.array(padded.strides)
    cells, axes = (voxel + 1) @ strides, near.argmax(axis=1)
    cells[entry >= far.min(axis=1)] = 0
    distances = entry.astype(np.float32)
    crossings = [column.astype(np.float32) for column in ((voxel + (direction > 0) - eye) / direction).T]
    spacings = [column.astype(np.float32) for column in np.abs(1.0 / direction).T]
    moves = list((np.sign(direction) * strides).astype(np.int64).T)
    rays, flat = np.arange(len(direction)), padded.ravel()
    found = [np.zeros(0, np.int64)] * 3 + [np.zeros(0, np.float32)]
    while rays.size:
        moving = flat[cells] == 0
        if moving.mean() < 0.8:
            stopped = ~moving
            found = [np.concatenate(pair) for pair in zip(found, [values[stopped] for values in
                                                                  (rays, cells, axes, distances)], strict=True)]
            rays, cells, axes, distances = (values[moving] for values in (rays, cells, axes, distances))
            crossings, spacings, moves = ([values[moving] for values in group]
                                          for group in (crossings, spacings, moves))
            moving = moving[moving]
        nearest = np.minimum(np.minimum(crossings[0], crossings[1]), crossings[2])
        along_x = crossings[0] == nearest
        along_y = ~along_x & (crossings[1] == nearest)
        along = (along_x, along_y, ~(along_x | along_y))
        for crossing, spacing, chosen in zip(crossings, spacings, along, strict=True):
            crossing += spacing * chosen
        cells = cells + np.where(along_x, moves[0], np.where(along_y, moves[1], moves[2])) * moving
        axes = np.where(moving, np.where(along_x, 0, np.where(along_y, 1, 2)), axes)
        distances = np.where(moving, nearest, distances)
    rays, cells, axes, distances = (values[np.argsort(found[0])] for values in found)
    voxel = np.stack(np.unravel_index(cells, padded.shape), axis=-1) - 1
    return voxel.clip(0, shape - 1), np.where(flat[cells] == 1, axes, 3), distances * grid.voxel_size_m
