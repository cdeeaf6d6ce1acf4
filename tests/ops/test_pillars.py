"""Which pillar a point is in and what is made of it, in worked arithmetic."""

import functools

import jax
import numpy as np
import pytest

from muvo_jax.geometry import PillarGrid
from muvo_jax.ops import pillars

GRID = PillarGrid(half_side_m=16.0, cells_per_m=1.0, points=6)
POINTS = np.array([[[0.25, 1.5, 0.0], [0.75, 1.25, 2.0], [-16.0, 15.75, 1.0], [16.0, 0.0, 0.0], [1.0, 1.0, 1.0]]],
                  np.float32)


def test_pillars_padding_and_points_outside():
    index, cell = pillars.pillar_indices(POINTS, np.array([4], np.int32), GRID)
    nowhere = GRID.cells**2
    np.testing.assert_array_equal(index, [[16 * 32 + 17, 16 * 32 + 17, 31, nowhere, nowhere]])
    np.testing.assert_array_equal(cell[0, 2], [0, 31])


@pytest.mark.parametrize("swapped", [False, True])
def test_decoration(swapped):
    @jax.jit
    def decorated(points):
        return pillars.decorate(points, *pillars.pillar_indices(points, np.array([4], np.int32), GRID), GRID,
                                swapped_corners=swapped)

    out = np.asarray(decorated(POINTS))[0, 0]
    centre = (1.0, 0.0) if swapped else (0.5, 1.5)
    np.testing.assert_allclose(out, [0.25, 1.5, 0.0, -0.25, 0.125, -1.0, 0.25 - centre[0], 1.5 - centre[1]], atol=1e-6)


def test_canvas_keeps_the_largest_and_looks_ahead_at_the_top():
    features = np.arange(1, 6, dtype=np.float32).reshape(1, 5, 1)
    index, _ = pillars.pillar_indices(POINTS, np.array([4], np.int32), GRID)
    canvas = np.asarray(jax.jit(functools.partial(pillars.canvas, grid=GRID))(features, index))[0, ..., 0]
    assert canvas[31 - 16, 17] == 2.0
    assert canvas[31, 31] == 3.0
    assert np.count_nonzero(canvas) == 2
