"""Which pillar a point is in and what is made of it, in worked arithmetic; what is no point has no effect."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.geometry import PillarGrid
from muvo_jax.model import checks, encoders
from muvo_jax.nn import norm
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


@pytest.mark.parametrize("garbage", [np.nan, 3e38])
def test_what_lies_beyond_the_count_changes_neither_values_nor_gradients(garbage):
    config = dataclasses.replace(presets.tiny().model, lidar=config_lib.PillarLidar(GRID))
    network, count = encoders.PillarNet(config, GRID), jnp.array([4], jnp.int32)
    variables = jax.tree.map(lambda leaf: leaf + 0.3, network.init(jax.random.key(0), POINTS, count, norm.Mode()))

    @jax.jit
    @jax.value_and_grad
    def loss(params, points):
        canvas, _ = network.apply({**variables, "params": params}, points, count, norm.Mode(train=True),
                                  mutable=["batch_stats"])
        return jnp.square(canvas).sum()

    padded = POINTS.copy()
    padded[0, 4:] = garbage
    expected, got = loss(variables["params"], POINTS), loss(variables["params"], padded)
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(expected))
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def test_garbage_beyond_the_count_is_accepted_and_among_the_points_refused():
    count = np.array([[4]], np.int32)
    padded, wrong = POINTS[None].copy(), POINTS[None].copy()
    padded[..., 4:, :], wrong[..., 3, 0] = np.nan, np.inf
    for check, given in ((checks.finite, np.asarray), (checks.finite, jnp.array), (checks.finite_on_host, np.array)):
        check("here", points=given(padded), point_count=given(count))
        with pytest.raises(ValueError, match=r"points .* holds 1 values that are not finite"):
            check("here", points=given(wrong), point_count=given(count))
    checks.finite_on_host("here", points=padded, point_count=jnp.asarray(count))  # the count is not at hand
