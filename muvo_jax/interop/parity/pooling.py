"""Pack p2_geometry, pooling into cells of the ground: image features along their rays, and points in pillars."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.geometry import BirdsEyeGrid
from muvo_jax.interop import packs
from muvo_jax.interop import reference_preprocess as preprocess
from muvo_jax.interop.parity import cases, drawing
from muvo_jax.model import lidar
from muvo_jax.nn import norm
from muvo_jax.ops import frustum, resample

Checks = Iterator[cases.Check]
TOLERANCE, GRADIENT_TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4, 1e-4
_GRID = BirdsEyeGrid()
_RAW_SIZE = (600, 960)
_FRUSTA = {"small": (2, 5, 13, 3, 64), "full": (None, 40, 104, 4, 8)}  # batch, rows, columns, channels, stride


def frusta(context: cases.Context) -> Checks:
    """Sums over the cells of features that lie on rays, of all distances and of the most probable ones."""
    for tag, (batch, rows, columns, channels, stride) in _FRUSTA.items():
        batch = batch or context.settings.size("p2", "frustum_full_batch")
        bins, side = _GRID.depth_bins, _GRID.cells
        draw = lambda name, *shape, tag=tag: context.draw(f"fp_{tag}_{name}", shape, "normal")
        matrix = preprocess.cropped_intrinsics(preprocess.intrinsics(_RAW_SIZE))
        repeat = lambda value, batch=batch: jnp.asarray(np.repeat(value[None], batch, 0), jnp.float32)
        points = frustum.frustum_points(repeat(matrix), repeat(preprocess.camera_to_ego()), (rows, columns), stride,
                                        bins, corners=True)
        yield cases.Check(f"frustum/{tag}_geometry", np.asarray(points)[:, None], TOLERANCE)
        cells = frustum.cell_indices(points, _GRID, truncate=True).reshape(batch, -1)
        probabilities = jax.nn.softmax(jnp.asarray(2 * draw("logit", batch, bins, rows, columns)), axis=1)
        depth = jnp.tensordot(probabilities, jnp.arange(1, bins + 1, dtype=jnp.float32), ((1,), (0,)))
        full_size = resample.upsample_linear(depth[..., None], stride)
        yield cases.Check(f"frustum/{tag}_depthmap", drawing.channels_first(full_size), TOLERANCE)
        values = jnp.asarray(draw("x", batch, 1, bins, rows, columns, channels).reshape(batch, -1, channels))
        weights = jnp.asarray(drawing.channels_last(draw("gw", batch, channels, side, side)))
        lifted = jnp.where(_most_probable(probabilities).reshape(batch, -1), cells, side**2)
        for kind, places in (("dense", cells), ("sparse", lifted)):
            pooled, gradient = _pooled(values, places, weights)
            yield cases.Check(f"frustum/{tag}_{kind}_out_f64accum", drawing.channels_first(pooled), TOLERANCE)
            gradient = np.asarray(gradient).reshape(batch, 1, bins, rows, columns, channels)
            for mode in ("eval", "train"):  # two ways to the same gradient, in the reference
                yield cases.Check(f"frustum/{tag}_{kind}_{mode}_grad", gradient, GRADIENT_TOLERANCE)


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
    sizes = context.settings.size
    clouds = [context.draw(f"pp_cloud{index}", (sizes("p2", "pillar_points"),), "cloud") for index in (0, 1)]
    points = jnp.asarray(np.stack(clouds).astype(np.float32))
    count = jnp.asarray(sizes("p2", "pillar_counts"), jnp.int32)
    net = lidar.PillarNet(config_lib.ModelConfig(numerics="reference"))
    shapes = jax.eval_shape(lambda key: net.init(key, points, count, drawing.EVAL), jax.random.key(0))
    variables = drawing.draw_variables(shapes, where="lidar/pillars/")
    occupied = context.pack["pillars/occupied_flat"]
    for tag, mode in (("pillars", drawing.EVAL), ("pillars_trainmode", norm.Mode(train=True))):
        canvas, _ = net.apply(variables, points, count, mode, mutable=["batch_stats"])
        flat = np.asarray(canvas).reshape(-1, canvas.shape[-1])
        yield cases.Check(f"{tag}/values_at_occupied", flat[occupied], TOLERANCE)
        if not mode.train:
            yield cases.Check(f"{tag}/canvas", drawing.channels_first(canvas), TOLERANCE)
            yield cases.Check(f"{tag}/occupied_flat", np.flatnonzero(flat.any(axis=1)), SHARE_TOLERANCE, _cells_apart)


def _cells_apart(pack: packs.Pack, entry: str, got: np.ndarray) -> float:
    """Share of the pillars that only one of the two sides has."""
    return len(np.setxor1d(pack[entry], got)) / len(pack[entry])


GROUPS: tuple[cases.Group, ...] = (frusta, point_pillars)
