"""How the sensors and the world are cut into pixels, cells and voxels."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class RangeViewGeometry:
    """A lidar as a cylinder of pixels: row 0 looks highest, the middle column looks forward, columns grow to the right.

    Attributes:
      rows, columns: size in pixels.
      elevation_min_rad, elevation_max_rad: vertical field of view; points outside it fall into the edge rows.
      position_m: where the lidar sits in the ego frame.
    """

    rows: int = 64
    columns: int = 1024
    elevation_min_rad: float = -0.5235987755982988  # -30 degrees
    elevation_max_rad: float = 0.17453292519943295  # +10 degrees
    position_m: tuple[float, float, float] = (1.0, 0.0, 2.0)


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """A box of cubic voxels in the ego frame; `origin_m` is its lower corner."""

    shape: tuple[int, int, int] = (192, 192, 64)
    voxel_size_m: float = 0.5
    origin_m: tuple[float, float, float] = (-48.0, -48.0, -6.0)


@dataclasses.dataclass(frozen=True)
class PillarGrid:
    """The ground around the ego as a square of pillars (PointPillars): [-half_side_m, half_side_m)^2.

    Attributes:
      half_side_m, cells_per_m: size and resolution; the number of cells on a side is a multiple of 32.
      points: of a scan; a longer one is thinned to a random subset of that size.
      channels: of a pillar.
    """

    half_side_m: float = 48.0
    cells_per_m: float = 5.0
    points: int = 60_000
    channels: int = 32

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

    cells: int = 48
    cell_m: float = 0.8
    cells_behind: int = 8
    depth_bins: int = 37
    lifted_bins: int = 10
    hidden_channels: int = 512
