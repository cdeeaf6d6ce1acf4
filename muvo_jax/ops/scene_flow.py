"""What moved by itself: the scene flow of the cells of a voxel grid, by matching what was seen with what was before.

A returned voxel that older scans looked through was not there before; where the same shape stood a little further off
in them, it moves. Block matching finds that: for every cell the displacement at which the returns around it agree best
with all older evidence. Nothing is learned, and nothing is differentiable.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.config import FLOW_LAGS as LAGS
from muvo_jax.types import Array

REACH_CELLS = 2  # a cell moves at most so far in one observation, along each axis
WINDOW_CELLS = 5  # sides of the block that is matched
AGREEMENT = 0.25  # of the block's returns that older evidence must confirm along the way, those it denies taken off
MARGIN_VOXELS = 2.0  # and by so many more than where the block is taken to stand still


def cell_flow(hits: Array, older: Array) -> Array:
    """How far the content of each cell moves from one observation to the next.

    A cell moves only where older evidence says that its block of returns was not there before, so that what stands, and
    what comes into sight for the first time, stays.

    Args:
      hits: float32 [N, X, Y, Z], 1 where the newest scan has a return, of the layers in which things move.
      older: float32 [N, LAGS, X, Y, Z] in [-1, 1], evidence of the observations before it, the newest last: 1 hit, -1
        looked through, 0 nothing known.

    Returns:
      float32 [N, X, Y, 2], cells of the grid along x and y; 0 where nothing moves.
    """
    farthest = LAGS * REACH_CELLS  # displacements are tried to the cell over all lags, and taken evenly between them
    sides = np.arange(-farthest, farthest + 1)
    moves = jnp.asarray(np.stack(np.meshgrid(sides, sides, indexing="ij"), axis=-1).reshape(-1, 2), jnp.float32)
    starts = (farthest - np.round(sides[:, None] * (np.arange(1, LAGS + 1) / LAGS))).astype(np.int32)  # by lag
    # Layers and lags first, cells along y last: the loops below then run over whole rows of cells.
    layers = jnp.moveaxis(hits, -1, 0)
    margin = ((0, 0), (0, 0), (farthest, farthest), (farthest, farthest), (0, 0))
    room = jnp.moveaxis(jnp.pad(older, margin), (1, -1), (0, 1))  # starts count in it
    rows, columns = hits.shape[1:3]

    def agreements_along(starts_x: Array) -> Array:
        """With all moves along y at once, whose slices are static, and each of which several moves share."""
        strips = [jax.lax.dynamic_slice_in_dim(room[LAGS - lag], starts_x[lag - 1], rows, axis=2)
                  for lag in range(1, LAGS + 1)]
        matches: dict[tuple[int, int], Array] = {}
        for lag, start in sorted({place for starts_y in starts.tolist() for place in enumerate(starts_y)}):
            moved = strips[lag][..., start:start + columns]
            matches[lag, start] = functools.reduce(operator.add, layers * moved) / LAGS
        return jnp.stack([_block(functools.reduce(operator.add, (matches[place] for place in enumerate(starts_y))))
                          for starts_y in starts.tolist()])

    agreements = jax.lax.map(agreements_along, jnp.asarray(starts)).reshape(-1, *hits.shape[:3])
    standing = agreements[moves.shape[0] // 2]
    # Of moves that agree alike the shortest is taken.
    best = (agreements - 0.05 * jnp.linalg.norm(moves, axis=-1)[:, None, None, None]).argmax(axis=0)
    agreed = jnp.take_along_axis(agreements, best[None], axis=0)[0]
    moves_on = (agreed > standing + MARGIN_VOXELS) & (agreed > AGREEMENT * _block(hits.sum(axis=-1))) & (standing < 0.0)
    return jnp.where(jnp.expand_dims(moves_on, -1), moves[best] / LAGS, 0.0)


def _block(values: Array) -> Array:
    """Sums of [N, X, Y] over the block around each cell: along x, then along y (a window reduction is slow on CPUs)."""
    half = WINDOW_CELLS // 2
    wide = jnp.pad(values, ((0, 0), (half, half), (half, half)))
    x, y = values.shape[1:]
    across = functools.reduce(operator.add, (wide[:, place:place + x] for place in range(WINDOW_CELLS)))
    return functools.reduce(operator.add, (across[:, :, place:place + y] for place in range(WINDOW_CELLS)))
