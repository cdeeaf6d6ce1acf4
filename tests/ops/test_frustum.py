"""Lift-splat pooling against sums in float64, and the numbers of the reference's code."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_rule import Golden, make_input

from muvo_jax.geometry import BirdsEyeGrid
from muvo_jax.ops import frustum

GRID = BirdsEyeGrid()
SIZES = {"small": (5, 13, 3, 64), "full": (40, 104, 4, 8)}
PACK = "p2_geometry.npz"


@functools.cache
def case(tag, sparse):
    """The reference's inputs: values [B, P, C] on the rays, their cells, and the weights of the gradient."""
    rows, columns, channels, _ = SIZES[tag]
    shape = (2, 1, GRID.depth_bins, rows, columns, channels)
    values = make_input(f"fp_{tag}_x", shape, "normal")[:, 0]
    logits = 2 * make_input(f"fp_{tag}_logit", shape[:1] + shape[2:5], "normal")
    points = geometry(tag)
    cells = np.asarray(frustum.cell_indices(points, GRID, truncate=True))
    kept = np.argsort(np.argsort(-logits, axis=1), axis=1) < GRID.lifted_bins
    cells = np.where(kept, cells, GRID.cells**2) if sparse else cells
    weights = np.moveaxis(make_input(f"fp_{tag}_gw", (2, channels, GRID.cells, GRID.cells), "normal"), 1, -1)
    return values.reshape(2, -1, channels), cells.reshape(2, -1), weights


def geometry(tag):
    rows, columns, _, stride = SIZES[tag]
    pack = Golden(PACK)
    both = lambda name: jnp.asarray(np.stack([pack[name]] * 2))
    return frustum.frustum_points(both("camera/intrinsics_cropped"), both("camera/extrinsics"), (rows, columns), stride,
                                  GRID.depth_bins, corners=True)


@pytest.mark.parametrize("tag", SIZES)
def test_rays_of_the_reference(tag):
    assert Golden(PACK).error(f"frustum/{tag}_geometry", np.asarray(geometry(tag))[:, None]) < 1e-5


@pytest.mark.parametrize("tag", SIZES)
@pytest.mark.parametrize("mode", ["dense", "sparse"])
def test_pooling_and_its_gradient_as_the_reference_in_float64(tag, mode):
    values, cells, weights = case(tag, mode == "sparse")
    weighted = lambda values: jnp.sum(frustum.pool(values, cells, GRID) * weights)
    out, gradient = jax.jit(lambda values: (frustum.pool(values, cells, GRID), jax.grad(weighted)(values)))(values)
    pack = Golden(PACK)
    assert pack.error(f"frustum/{tag}_{mode}_out_f64accum", np.moveaxis(np.asarray(out), -1, 1)) < 1e-5
    rows, columns, channels, _ = SIZES[tag]
    gradient = np.asarray(gradient).reshape(2, 1, GRID.depth_bins, rows, columns, channels)
    for kind in ("eval", "train"):
        assert pack.error(f"frustum/{tag}_{mode}_{kind}_grad", gradient) < 1e-4


def test_lifting_is_pooling_of_the_products():
    generator = np.random.default_rng(0)
    features = generator.normal(size=(2, 60, 5)).astype(np.float32)
    probabilities = generator.random((2, 7, 60)).astype(np.float32)
    grid = BirdsEyeGrid(cells=4)
    cells = generator.integers(0, 17, (2, 7, 60)).astype(np.int32)
    products = np.einsum("bpc,bdp->bdpc", features, probabilities).reshape(2, -1, 5)

    def lifted(features, probabilities):
        return frustum.lift_splat(features, probabilities, cells, grid)

    def pooled(features, probabilities):
        products = jnp.einsum("bpc,bdp->bdpc", features, probabilities).reshape(2, -1, 5)
        return frustum.pool(products, cells.reshape(2, -1), grid)

    expected = np.zeros((2, 17, 5))
    for frame in range(2):
        np.add.at(expected[frame], cells[frame].ravel(), products[frame].astype(np.float64))
    out = jax.jit(lifted)(features, probabilities)
    np.testing.assert_allclose(out.reshape(2, 16, 5), expected[:, :16], rtol=1e-5, atol=1e-5)
    slopes = [jax.jit(jax.grad(lambda *args, run=run: jnp.sum(jnp.sin(run(*args))), (0, 1)))(features, probabilities)
              for run in (lifted, pooled)]
    for ours, theirs in zip(*slopes, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_cells_ahead_left_and_outside():
    points = np.array([[0.0, 0.0, 0.0], [31.9, 0.0, 0.0], [32.1, 0.0, 0.0], [0.0, 19.1, 0.0], [0.0, 19.3, 0.0],
                       [-6.3, -19.1, 0.0], [-6.5, 0.0, 0.0], [0.0, 0.0, 11.0]], np.float32)
    outside = GRID.cells**2
    expected = [24 * 48 + 8, 24 * 48 + 47, outside, 8, outside, 47 * 48, outside, outside]
    np.testing.assert_array_equal(frustum.cell_indices(points, GRID), expected)


def test_most_probable_keeps_the_largest_with_their_cells():
    probabilities = np.array([0.1, 0.5, 0.4], np.float32).reshape(1, 3, 1)
    cells = np.array([7, 8, 9], np.int32).reshape(1, 3, 1)
    chosen, places = frustum.most_probable(probabilities, cells, 2)
    np.testing.assert_array_equal(chosen.ravel(), np.float32([0.5, 0.4]))
    np.testing.assert_array_equal(places.ravel(), [8, 9])
