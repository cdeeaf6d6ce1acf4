"""The ground as a picture seen from above: what each patch is, and its colour at several resolutions.

The coarser copies (each pixel the mean of 2 x 2) are what a distant pixel of the camera sees, so that far markings fade
instead of flickering.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from muvo_jax.town import boxes as box_lib
from muvo_jax.town import map as map_lib

CELL_M = 0.2
LEVELS = 6
BORDER_M = 60.0
KERB_M = 0.3
CROSSING_M = (7.4, 9.8)  # zebra crossings, measured from the middle of a junction
STOP_LINE_M = (10.4, 10.9)
_COLOURS = {"grass": (0.30, 0.42, 0.20), "pavement": (0.60, 0.58, 0.55), "kerb": (0.72, 0.71, 0.69),
            "road": (0.26, 0.26, 0.27), "parking": (0.31, 0.31, 0.32), "marking": (0.88, 0.88, 0.85)}


@dataclasses.dataclass(frozen=True)
class Ground:
    """Attributes:
      origin_m: the corner of pixel [0, 0] in the frame of the map; axes are [x, y].
      classes: uint8 [X, Y], indices into boxes.CLASSES.
      colours: per level, float32 [X / 2**level, Y / 2**level, 3], RGB in [0, 1].
    """

    origin_m: np.ndarray
    classes: np.ndarray
    colours: tuple[np.ndarray, ...]


def make_ground(streets: map_lib.Streets, seed: int) -> Ground:
    """Paints streets, pavements, markings and grass."""
    rng = np.random.default_rng([seed, 2])
    origin_m = streets.nodes_m.min(0) - BORDER_M
    multiple = 2 ** (LEVELS - 1)
    size = (np.ceil((streets.nodes_m.max(0) + BORDER_M - origin_m) / CELL_M / multiple) * multiple).astype(int)
    distance_m = np.full(size, np.inf, np.float32)
    marked = np.zeros(size, bool)
    for first, second in streets.edges:
        _paint_street(distance_m, marked, origin_m, streets, first, second)

    classes = np.full(size, box_lib.GRASS, np.uint8)
    colours = np.empty((*size, 3), np.float32)
    colours[:] = _COLOURS["grass"]
    bands = ((map_lib.PAVEMENT_HALF_M, box_lib.PAVEMENT, "pavement"),
             (map_lib.ROAD_HALF_M + KERB_M, box_lib.PAVEMENT, "kerb"),
             (map_lib.ROAD_HALF_M, box_lib.ROAD, "parking"), (map_lib.PARKING_OFFSET_M - 1.05, box_lib.ROAD, "road"))
    for half_m, kind, name in bands:
        classes[distance_m < half_m] = kind
        colours[distance_m < half_m] = _COLOURS[name]
    marked &= distance_m < map_lib.ROAD_HALF_M
    classes[marked], colours[marked] = box_lib.MARKING, _COLOURS["marking"]

    rough = np.where(classes == box_lib.GRASS, 0.16, 0.05).astype(np.float32)
    colours *= (1 + rough * _blotches(size, rng))[..., None]
    levels = [np.clip(colours, 0, 1)]
    for _ in range(LEVELS - 1):
        fine = levels[-1]
        levels.append(fine.reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2, 3).mean((1, 3)))
    return Ground(origin_m.astype(np.float32), classes, tuple(levels))


def look_up(ground: Ground, points_m: np.ndarray, footprint_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns colours [P, 3] and classes [P] at points [P, 2] seen with pixels as wide as `footprint_m` [P]."""
    cell = ((points_m - ground.origin_m) * np.float32(1 / CELL_M)).astype(np.int32)
    limit = np.array(ground.classes.shape, np.int32) - 1
    cell = np.clip(cell, 0, limit)
    level = np.clip(np.log2(np.maximum(footprint_m, 1e-3) / CELL_M) + 0.5, 0, LEVELS - 1).astype(np.int8)
    colours = np.empty((len(cell), 3), np.float32)
    for index, picture in enumerate(ground.colours):
        here = level == index
        colours[here] = picture[cell[here, 0] >> index, cell[here, 1] >> index]
    return colours, ground.classes[cell[:, 0], cell[:, 1]]


def _paint_street(distance_m: np.ndarray, marked: np.ndarray, origin_m: np.ndarray, streets: map_lib.Streets,
                  first: int, second: int) -> None:
    """Lowers the distance to the middle of the nearest street, and marks lines, within one street's surroundings."""
    start, end = streets.nodes_m[first], streets.nodes_m[second]
    length = np.linalg.norm(end - start)
    forward = (end - start) / length
    low = np.floor((np.minimum(start, end) - 10 - origin_m) / CELL_M).astype(int)
    high = np.ceil((np.maximum(start, end) + 10 - origin_m) / CELL_M).astype(int)
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    x, y = ((np.arange(low[axis], high[axis]) + 0.5) * CELL_M + origin_m[axis] - start[axis] for axis in range(2))
    x, y = x[:, None].astype(np.float32), y[None, :].astype(np.float32)
    along = (x * forward[0] + y * forward[1]).astype(np.float32)
    across = (y * forward[0] - x * forward[1]).astype(np.float32)
    beyond = np.maximum(np.maximum(-along, along - length), 0)
    distance_m[window] = np.minimum(distance_m[window], np.hypot(across, beyond))

    inner = (along > map_lib.JUNCTION_M) & (along < length - map_lib.JUNCTION_M)
    side = np.abs(across)
    lines = inner & (((side < 0.13) & (along % 5.0 < 2.8)) | (np.abs(side - 3.5) < 0.08))
    for node, reach in ((first, along), (second, length - along)):
        if streets.degree[node] < 3:
            continue
        lines |= (reach > CROSSING_M[0]) & (reach < CROSSING_M[1]) & (side < 5.3) & ((across + 0.5) % 1.2 < 0.6)
        arriving = across > 0 if node == first else across < 0
        lines |= (reach > STOP_LINE_M[0]) & (reach < STOP_LINE_M[1]) & arriving & (side < 3.4)
    marked[window] |= lines


def _blotches(size: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noise in [-1, 1] with details of one, four and sixteen cells."""
    total = np.zeros(size, np.float32)
    for scale, weight in ((1, 0.3), (4, 0.3), (16, 0.4)):
        coarse = rng.random((size[0] // scale + 1, size[1] // scale + 1), np.float32) * 2 - 1
        total += weight * np.repeat(np.repeat(coarse, scale, 0), scale, 1)[:size[0], :size[1]]
    return total
