"""Everything in the town that stands still: houses, trees, hedges, street lamps and parked cars."""

from __future__ import annotations

import numpy as np

from muvo_jax.town import boxes as box_lib
from muvo_jax.town import map as map_lib
from muvo_jax.town import settings

_WALLS = np.array([[.78, .68, .55], [.72, .45, .36], [.85, .82, .75], [.62, .64, .67], [.80, .72, .48], [.55, .40, .33],
                   [.66, .74, .78], [.83, .62, .52]], np.float32)
_ROOFS = np.array([[.55, .25, .18], [.36, .22, .20], [.30, .32, .36]], np.float32)
_LEAVES = np.array([[.20, .42, .14], [.28, .48, .16], [.36, .46, .16], [.15, .34, .17]], np.float32)
STOREY_M = 3.0


def make_scenery(streets: map_lib.Streets, config: settings.TownConfig) -> box_lib.Boxes:
    """Places everything from the town's seed."""
    rng = np.random.default_rng([config.seed, 3])
    parts, footprints = [], np.zeros((0, 3))
    for first, second in streets.edges:
        start, end = streets.nodes_m[first], streets.nodes_m[second]
        for here, there in ((start, end), (end, start)):
            side = _Side(here, there)
            houses, footprints = _houses(side, streets, footprints, rng)
            parts += [*houses, *_trees(side, rng), *_lamps(side, rng), *_parked_cars(side, config.parked_share, rng)]
    return box_lib.join(parts)


class _Side:
    """The right-hand side of a street: places are given by metres along it and metres from its middle."""

    def __init__(self, start: np.ndarray, end: np.ndarray):
        self.start = start
        self.length = float(np.linalg.norm(end - start))
        self.forward = (end - start) / self.length
        self.right = np.array([self.forward[1], -self.forward[0]])
        self.yaw_rad = float(np.arctan2(self.forward[1], self.forward[0]))

    def place(self, along_m, across_m) -> np.ndarray:
        """Points [M, 2] in the frame of the map."""
        along_m, across_m = np.broadcast_arrays(np.atleast_1d(along_m), np.atleast_1d(across_m))
        return self.start + along_m[:, None] * self.forward + across_m[:, None] * self.right


def _houses(side: _Side, streets: map_lib.Streets, footprints: np.ndarray, rng: np.random.Generator):
    """A row of houses; those that would stand on a street or in another house are left out."""
    parts = []
    along_m = rng.uniform(9, 13)
    while along_m < side.length - 12:
        width_m, depth_m = rng.uniform(8, 17), rng.uniform(8, 13)
        middle_m, across_m = along_m + width_m / 2, 9.0 + rng.uniform(0, 2.5) + depth_m / 2
        along_m += width_m + rng.uniform(0.5, 6)
        is_house = rng.random() < 0.55
        storeys = int(rng.integers(1, 3) if is_house else rng.integers(3, 7))
        colour, roof = rng.choice(_WALLS) * rng.uniform(0.85, 1.1), rng.choice(_ROOFS)
        grid = np.stack(np.meshgrid(np.linspace(-.5, .5, 7) * width_m, np.linspace(-.5, .5, 7) * depth_m), -1)
        outline_m = side.place(middle_m + grid[..., 0].ravel(), across_m + grid[..., 1].ravel())
        centre_m = side.place(middle_m, across_m)
        radius_m = 0.5 * min(width_m, depth_m) + 0.5
        # Discs of the shorter side stand for the houses that are already there.
        clear = len(footprints) == 0 or (np.linalg.norm(outline_m[:, None] - footprints[None, :, :2], axis=-1)
                                         > footprints[None, :, 2]).all()
        if not clear or _street_distance_m(outline_m, streets).min() < map_lib.PAVEMENT_HALF_M + 0.3:
            continue
        spread = np.linspace(-0.5, 0.5, 3) * max(width_m - depth_m, 0)
        discs_m = side.place(middle_m + spread, across_m)
        footprints = np.concatenate([footprints, np.concatenate([discs_m, np.full((3, 1), radius_m)], 1)])
        height_m = storeys * STOREY_M + 0.6
        parts.append(box_lib.make(centre_m, side.yaw_rad, width_m, depth_m, (0, height_m), colour, box_lib.WALL))
        if is_house:
            for shrink_m, low_m, high_m in ((-1.0, 0, 0.9), (2.4, 0.9, 1.9)):
                parts.append(box_lib.make(centre_m, side.yaw_rad, width_m - shrink_m / 2, depth_m - shrink_m,
                                          (height_m + low_m, height_m + high_m), roof, box_lib.ROOF))
    if rng.random() < 0.5 and side.length > 40:
        middle_m, length_m = rng.uniform(18, side.length - 18), rng.uniform(5, 12)
        parts.append(box_lib.make(side.place(middle_m, 8.6), side.yaw_rad, length_m, 0.7, (0, 1.1), rng.choice(_LEAVES),
                                  box_lib.HEDGE))
    return parts, footprints


def _trees(side: _Side, rng: np.random.Generator) -> list[box_lib.Boxes]:
    along_m = np.arange(rng.uniform(13, 20), side.length - 13, 13.0)
    along_m = along_m[rng.random(len(along_m)) < 0.6] + rng.uniform(-2, 2, 1)
    count = len(along_m)
    centre_m = side.place(along_m, 7.2)
    yaw_rad = rng.uniform(0, np.pi / 2, count)
    trunk_m, crown_m, width_m = rng.uniform(2.0, 2.8, count), rng.uniform(1.8, 2.8, count), rng.uniform(2.4, 3.6, count)
    colour = _LEAVES[rng.integers(0, len(_LEAVES), count)] * rng.uniform(0.85, 1.15, (count, 1))
    middle_m = trunk_m + crown_m
    top_m = middle_m + 0.45 * crown_m
    return [box_lib.make(centre_m, yaw_rad, 0.34, 0.34, np.stack([np.zeros(count), trunk_m + 0.3], 1),
                         (0.33, 0.24, 0.17), box_lib.TRUNK),
            box_lib.make(centre_m, yaw_rad, width_m, width_m, np.stack([trunk_m, middle_m], 1), colour, box_lib.LEAVES),
            box_lib.make(centre_m, yaw_rad, 0.6 * width_m, 0.6 * width_m, np.stack([middle_m, top_m], 1), colour * 1.1,
                         box_lib.LEAVES)]


def _lamps(side: _Side, rng: np.random.Generator) -> list[box_lib.Boxes]:
    along_m = np.arange(rng.uniform(12, 22), side.length - 12, 28.0)
    grey = (0.38, 0.39, 0.40)
    return [box_lib.make(side.place(along_m, 5.95), side.yaw_rad, 0.16, 0.16, (0, 5.8), grey, box_lib.POLE),
            box_lib.make(side.place(along_m, 5.1), side.yaw_rad, 0.12, 1.7, (5.6, 5.75), grey, box_lib.POLE),
            box_lib.make(side.place(along_m, 4.3), side.yaw_rad, 0.3, 0.6, (5.45, 5.6), (0.85, 0.85, 0.8),
                         box_lib.LAMP)]


def _parked_cars(side: _Side, share: float, rng: np.random.Generator) -> list[box_lib.Boxes]:
    slot_m = np.arange(17.0, side.length - 17, 6.4)
    slot_m = slot_m[rng.random(len(slot_m)) < share]
    count = len(slot_m)
    centre_m = side.place(slot_m + rng.uniform(-0.4, 0.4, count),
                          map_lib.PARKING_OFFSET_M + rng.uniform(-0.1, 0.1, count))
    return [box_lib.cars(centre_m, side.yaw_rad + rng.normal(0, 0.015, count), rng.uniform(4.0, 4.8, count),
                         box_lib.CAR_COLOURS[rng.integers(0, len(box_lib.CAR_COLOURS), count)],
                         rng.random(count) < 0.15)]


def _street_distance_m(points_m: np.ndarray, streets: map_lib.Streets) -> np.ndarray:
    """Distance of each point [P, 2] from the middle of the nearest street."""
    start = streets.nodes_m[streets.edges[:, 0]]
    along = streets.nodes_m[streets.edges[:, 1]] - start
    offset = points_m[:, None] - start[None]
    share = np.clip((offset * along[None]).sum(-1) / (along**2).sum(-1)[None], 0, 1)
    return np.linalg.norm(offset - share[..., None] * along[None], axis=-1).min(1)
