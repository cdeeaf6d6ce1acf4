"""How the sensors and the world are cut into pixels, cells and voxels."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from muvo_jax.limits import COUNT, NOT_NEGATIVE, RangeError, above, between, check

ELEVATION_RAD = between(-0.5 * math.pi, 0.5 * math.pi, "rad")
_MOST_VOXELS = 1 << 30
MOUNTING_M = between(-30, 30, "m")  # of a sensor on a car or truck


@dataclasses.dataclass(frozen=True)
class RangeViewGeometry:
    """A lidar as a cylinder of pixels: row 0 looks highest, the middle column looks forward, columns grow to the right.

    Attributes:
      rows, columns: size in pixels.
      elevation_min_rad, elevation_max_rad: vertical field of view; points outside it fall into the edge rows.
      position_m: where the lidar sits in the ego frame.
    """

    rows: Annotated[int, between(1, 4096)] = 64
    columns: Annotated[int, between(1, 65536)] = 1024
    elevation_min_rad: Annotated[float, ELEVATION_RAD] = -0.5235987755982988  # -30 degrees
    elevation_max_rad: Annotated[float, ELEVATION_RAD] = 0.17453292519943295  # +10 degrees
    position_m: Annotated[tuple[float, float, float], MOUNTING_M] = (1.0, 0.0, 2.0)

    def __post_init__(self):
        check(self)
        if self.elevation_min_rad >= self.elevation_max_rad:
            raise RangeError("RangeViewGeometry", "elevation_min_rad",
                             f"is {self.elevation_min_rad:g}; it must be below elevation_max_rad, "
                             f"{self.elevation_max_rad:g}.")


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """A box of cubic voxels in the ego frame; `origin_m` is its lower corner."""

    shape: Annotated[tuple[int, int, int], COUNT] = (192, 192, 64)
    voxel_size_m: Annotated[float, above(0, 1000, "m")] = 0.5
    origin_m: Annotated[tuple[float, float, float], between(-1e5, 1e5, "m")] = (-48.0, -48.0, -6.0)

    def __post_init__(self):
        check(self)
        if math.prod(self.shape) > _MOST_VOXELS:
            raise RangeError("VoxelGrid", "shape", f"is {self.shape!r}; at most {_MOST_VOXELS} voxels fit a frame.")

    def layers(self, low_m: float, high_m: float = math.inf) -> slice:
        """Those of the last axis whose lower faces lie from `low_m` on and below `high_m` over the ground."""
        lower_m = [self.origin_m[2] + self.voxel_size_m * layer for layer in range(self.shape[2])]
        start, stop = (sum(face_m < limit_m - 1e-6 for face_m in lower_m) for limit_m in (low_m, high_m))
        return slice(start, stop)


@dataclasses.dataclass(frozen=True)
class PillarGrid:
    """The ground around the ego as a square of pillars (PointPillars): [-half_side_m, half_side_m)^2.

    Attributes:
      half_side_m, cells_per_m: size and resolution; the number of cells on a side is a multiple of 32.
      points: of a scan; a longer one is thinned to a random subset of that size.
      channels: of a pillar.
    """

    half_side_m: Annotated[float, above(0, unit="m")] = 48.0
    cells_per_m: Annotated[float, above(0)] = 5.0
    points: Annotated[int, COUNT] = 60_000
    channels: Annotated[int, COUNT] = 32

    def __post_init__(self):
        check(self)
        cells = 2 * self.half_side_m * self.cells_per_m
        if abs(cells - self.cells) > 1e-6:
            raise RangeError("PillarGrid", "cells_per_m", f"is {self.cells_per_m:g}: with half_side_m "
                             f"{self.half_side_m:g} a side has {cells:g} cells; 2 * half_side_m * cells_per_m must be "
                             f"a whole number.")

    @property
    def cells(self) -> int:
        """On a side."""
        return round(2 * self.half_side_m * self.cells_per_m)


@dataclasses.dataclass(frozen=True)
class BirdsEyeGrid:
    """The ground ahead as a square of cells, which image features are lifted to (Philion and Fidler, 2020).

    Attributes:
      cells: on a side; a multiple of 4.
      cell_m: their size.
      cells_behind: how many of them lie behind the ego's origin; sideways it stands in the middle.
      depth_bins: a pixel's features are spread over 1, 2, ... depth_bins metres.
      lifted_bins: only so many of them, the most probable ones, are lifted.
      hidden_channels: between the two convolutions that shrink the map to cells / 4 tokens a side.
    """

    cells: Annotated[int, COUNT] = 48
    cell_m: Annotated[float, above(0, unit="m")] = 0.8
    cells_behind: Annotated[int, NOT_NEGATIVE] = 8
    depth_bins: Annotated[int, COUNT] = 37
    lifted_bins: Annotated[int, COUNT] = 10
    hidden_channels: Annotated[int, COUNT] = 512

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class RouteMap:
    """Geometry of Batch.route_map: the car is in row `ego_row`, column `ego_column`, looking towards row 0.

    Places are continuous: pixel i covers [i, i + 1).
    """

    metres_per_px: Annotated[float, above(0, 100, "m")] = 0.75
    ego_row: Annotated[float, between(-1000, 1000, "px")] = 48.0
    ego_column: Annotated[float, between(-1000, 1000, "px")] = 32.0

    def __post_init__(self):
        check(self)
