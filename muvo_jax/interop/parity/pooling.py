"""File p2_geometry, pooling into cells of the ground: image features along their rays, and points in pillars."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.geometry import BirdsEyeGrid, PillarGrid
from muvo_jax.interop import reference_preprocess as preprocess
from muvo_jax.interop.parity import cases, drawing, golden, rounding
from muvo_jax.model import encoders
from muvo_jax.nn import norm
from muvo_jax.ops import frustum, resample

Checks = Iterator[cases.Check]
TOLERANCE, GRADIENT_TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4, 1e-4
_GRID = BirdsEyeGrid()


def frusta(context: cases.Context) -> Checks:
    """Sums over the cells of features that lie on rays, of all distances and of the most probable ones."""
    for tag in ("small", "full"):
        yield from _frustum(context, tag)


def _frustum(context: cases.Context, tag: str) -> Checks:
    batch, rows, columns, channels, stride = _frustum_sizes(context, tag)
    bins, side = _GRID.depth_bins, _GRID.cells
    draw = lambda name, *shape: context.draw(f"fp_{tag}_{name}", shape, "normal")
    matrix = preprocess.cropped_intrinsics(preprocess.intrinsics(context.size("p2", "image_hw")))
    repeat = lambda value: jnp.asarray(np.repeat(value[None], batch, 0), jnp.float32)
    points = frustum.frustum_points(repeat(matrix), repeat(preprocess.camera_to_ego()), (rows, columns), stride, bins,
                                    corners=True)
    yield cases.Check(f"frustum/{tag}_geometry", np.asarray(points)[:, None], TOLERANCE)
    cells = frustum.cell_indices(points, _GRID, truncate=True).reshape(batch, -1)
    probabilities = jax.nn.softmax(jnp.asarray(2 * draw("logit", batch, bins, rows, columns)), axis=1)
    depth = jnp.tensordot(probabilities, jnp.arange(1, bins + 1, dtype=jnp.float32), ((1,), (0,)))
    full_size = resample.upsample_linear(depth[..., None], stride)
    yield cases.Check(f"frustum/{tag}_depthmap", drawing.channels_first(full_size), TOLERANCE)
    values = jnp.asarray(draw("x", batch, 1, bins, rows, columns, channels).reshape(batch, -1, channels))
    weights = jnp.asarray(drawing.channels_last(draw("gw", batch, channels, side, side)))

    def pooled(places: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        out, gradient = _pooled(values, places, weights)
        return drawing.channels_first(out), np.asarray(gradient).reshape(batch, 1, bins, rows, columns, channels)

    def sparse(probabilities: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        return pooled(jnp.where(_most_probable(probabilities).reshape(batch, -1), cells, side**2))

    # Which bins are the most probable ones is a choice: a jump where two of them tie.
    otherwise = [lambda part=part: (sparse(moved)[part] for moved in rounding.anew(probabilities)) for part in (0, 1)]
    for kind, (out, gradient), again in (("dense", pooled(cells), (None, None)),
                                         ("sparse", sparse(probabilities), otherwise)):
        yield cases.Check(f"frustum/{tag}_{kind}_out_f64accum", out, TOLERANCE, again=again[0])
        for mode in ("eval", "train"):  # two ways to the same gradient, in the reference
            yield cases.Check(f"frustum/{tag}_{kind}_{mode}_grad", gradient, GRADIENT_TOLERANCE, again=again[1])


def _frustum_sizes(context: cases.Context, tag: str) -> tuple[int, ...]:
    """Batch, rows, columns and channels of the features, and how many pixels of the image a row of them is."""
    sizes = list(context.size("p2", f"frustum_{tag}"))
    if tag == "full":
        sizes[0] = context.size("p2", "frustum_full_batch")
    geometry, pooled = context.shape(f"frustum/{tag}_geometry"), context.shape(f"frustum/{tag}_dense_out_f64accum")
    if geometry:
        sizes[0], sizes[1], sizes[2] = geometry[0], *geometry[3:5]
    if pooled:
        sizes[0], sizes[3] = pooled[:2]
    image = context.shape(f"frustum/{tag}_depthmap")
    if image:
        sizes[4] = image[2] // sizes[1]
    return tuple(sizes)


def _most_probable(probabilities: jax.Array) -> jax.Array:
    """bool [B, D, h, w]: the bins that are lifted."""
    ranks = jnp.argsort(jnp.argsort(-probabilities, axis=1), axis=1)
    return ranks < _GRID.lifted_bins


@jax.jit
def _pooled(values: jax.Array, cells: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The sums by cell, and the gradient of their weighted total by the values."""
    pooled, backward = jax.vjp(lambda values: frustum.pool(values, cells, _GRID), values)
    return pooled, backward(weights)[0]


def point_pillars(context: cases.Context) -> Checks:
    """The net of the pillars; values are compared in the pillars that the reference found occupied."""
    count = jnp.asarray(context.size("p2", "pillar_counts"), jnp.int32)
    clouds = [context.draw(f"pp_cloud{index}", (context.size("p2", "pillar_points"),), "cloud")
              for index in range(len(count))]
    points = jnp.asarray(np.stack(clouds).astype(np.float32))
    net = encoders.PillarNet(config_lib.ModelConfig(numerics="reference"), PillarGrid())
    shapes = jax.eval_shape(lambda key: net.init(key, points, count, drawing.EVAL), jax.random.key(0))
    variables = drawing.draw_variables(shapes, where="lidar/pillars/")
    occupied = context.file["pillars/occupied_flat"]
    for tag, mode in (("pillars", drawing.EVAL), ("pillars_trainmode", norm.Mode(train=True))):
        canvas, _ = net.apply(variables, points, count, mode, mutable=["batch_stats"])
        flat = np.asarray(canvas).reshape(-1, canvas.shape[-1])
        yield cases.Check(f"{tag}/values_at_occupied", flat[occupied], TOLERANCE)
        if not mode.train:
            yield cases.Check(f"{tag}/canvas", drawing.channels_first(canvas), TOLERANCE)
            yield cases.Check(f"{tag}/occupied_flat", np.flatnonzero(flat.any(axis=1)), SHARE_TOLERANCE, _cells_apart)


def _cells_apart(file: golden.File, entry: str, got: np.ndarray) -> float:
    """Share of the pillars that only one of the two sides has."""
    return len(np.setxor1d(file[entry], got)) / len(file[entry])


GROUPS: tuple[cases.Group, ...] = (frusta, point_pillars)
