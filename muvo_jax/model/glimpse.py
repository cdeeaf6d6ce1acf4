"""How the memory looks from where a state is: what its decoders see (model/guided.py).

What a state's own observation showed is hidden from its decoders, since copying it would teach nothing: a state that
observed sees what was there before, an imagined one everything.
"""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import head as head_lib
from muvo_jax.config import LastSeen, ModelConfig, as_kind
from muvo_jax.geometry import VoxelGrid
from muvo_jax.model import memory as memory_lib
from muvo_jax.ops import motion as motion_ops
from muvo_jax.ops import reproject, scene_flow
from muvo_jax.types import RANGE_NO_RETURN_M, Array, Memory, Vantage

FADE = 0.8  # weight of evidence that is one observation older: what moved away is forgotten
EDGE = 0.5  # half of what came into view is guessed from the edge of what was seen, half from the average frame
FORESEEN_STEPS = 12  # for so many steps `with_evidence` works out where what moves goes; it is gone afterwards
_MOVING_M = (0.5, 2.5)  # heights over the road between which road users are looked for


@flax.struct.dataclass
class ImageGlimpse:
    """The memory of the head image from n vantages, at full size.

    Attributes:
      covered: float32 [n, H, W, 1], how far the newest image, moved, is to be believed: 1 where it was seen, EDGE where
        it is continued from its edge, 0 without an image.
      image: float32 [n, H, W, 3] in [0, 1], that image times `covered`.
      colour: float32 [n, 1, 1, 3], its mean as it was; 0 without an image.
    """

    image: Array
    covered: Array
    colour: Array


@flax.struct.dataclass
class RangeGlimpse:
    """The memory of the head range_view from n vantages, at full size.

    Attributes:
      moved_m, newest_m, still_m: float32 [n, Hr, Wr] ranges, -1 where nothing is: all scans moved, the newest moved,
        and the newest as it was.
      filled_m: float32 [n, Hr, Wr], moved_m with its small holes filled.
      sky: float32 [n, Hr, Wr], 1 where a pixel without a return came to lie.
      height_m: float32 [n, Hr, Wr], of the moved returns over the road.
      off_beam_m: float32 [n, Hr, Wr, 3], from the middle of the pixel's beam to the moved return; 0 without one.
    """

    moved_m: Array
    newest_m: Array
    still_m: Array
    filled_m: Array
    sky: Array
    height_m: Array
    off_beam_m: Array


@flax.struct.dataclass
class VoxelGlimpse:
    """The memory of the head occupancy from n vantages, at full size.

    Attributes:
      newest, older: float32 [n, X, Y, Z] in [-1, 1], evidence of the newest scan and of all before it.
      onward: float32 [n, X, Y, Z], 1 where a return of the newest scan has come to that moved before and goes on as it
        did; None without follow_movers.
    """

    newest: Array
    older: Array
    onward: Array | None


Glimpse = ImageGlimpse | RangeGlimpse | VoxelGlimpse


@flax.struct.dataclass
class Sight:
    """Which observations n vantages look at, the newest last.

    Attributes:
      rows: int32 [n], the drive of each.
      places: int32 [n, F], in the drive's memory; `known`, bool [n, F], whether something was observed there.
      pose: float32 [n, F, 3], where the vantage stands in the ego frame of each.
      ahead: int32 [n], steps from the newest to the vantage.
    """

    rows: Array
    places: Array
    known: Array
    pose: Array
    ahead: Array


def look(config: ModelConfig, memory: Memory, rows: Array, vantage: Vantage,
         heads: tuple[str, ...]) -> tuple[dict[str, Glimpse], Array]:
    """The memory as it looks from n vantages, for those of the heads that it can tell something.

    Beside it, `numbers` [n, 5]: how far the car is from where the newest observation in sight was taken (forward, left,
    turn; zeros where there is none), how many steps are imagined and how fast it is; about 1 where that is much.

    Args:
      config: of the model.
      memory: of B drives.
      rows: int32 [n], which of them each vantage belongs to.
      vantage: [n].
      heads: what is decoded.
    """
    heads = tuple(head for head in memory_lib.guessed_heads(config) if head in heads)
    places = as_kind(config.first_guess, LastSeen).memory_frames
    stop = vantage.last + (vantage.steps > 0).astype(jnp.int32)
    index = stop[:, None] + jnp.arange(-places, 0, dtype=jnp.int32)[None]
    known = (index >= vantage.first[:, None]) & (index >= 0)
    index = jnp.clip(index, 0, memory.pose.shape[1] - 1)
    pose = motion_ops.relative(jnp.broadcast_to(vantage.motion.pose[:, None], (*index.shape, 3)),
                               memory.pose[rows[:, None], index])
    sight = Sight(rows, index, known, pose, jnp.maximum(vantage.steps, 1))
    views, glimpses = memory_lib.views(heads), dict[str, Glimpse]()
    if "occupancy" in views:
        glimpses["occupancy"] = _voxels(config, memory, sight)
    if "range_view" in views or "image" in views:
        glimpses["range_view"] = view = _ranges(config, memory, sight)
        if "image" in views:
            glimpses["image"] = _image(config, memory, sight, view)
    apart = jnp.where(known[:, -1:], pose[:, -1], 0.0) / jnp.array([10.0, 2.0, 0.3], jnp.float32).reshape(1, 3)
    numbers = [apart, vantage.steps.astype(jnp.float32)[:, None] / 5.0, vantage.motion.speed_mps[:, None] / 10.0]
    found = {name: glimpses[guide.view] for name in heads if (guide := head_lib.get(name).guide) is not None}
    return found, jnp.concatenate(numbers, axis=-1)


def _scans(memory: Memory, sight: Sight) -> tuple[Array, Array, Array]:
    """The scans [n, F, Hr * Wr, 4] in sight as they were, their points [..., 3] in the frame of the vantage, and which
    of these [...] are returns."""
    scans = memory.range_view[sight.rows[:, None], sight.places]
    scans = scans.reshape(*sight.places.shape, -1, 4)
    valid = (scans[..., 3] > 0.0) & jnp.expand_dims(sight.known, -1)
    return scans, motion_ops.into_frame(scans[..., :3], sight.pose), valid


def _ranges(config: ModelConfig, memory: Memory, sight: Sight) -> RangeGlimpse:
    geometry, count = config.range_view, sight.rows.shape[0]
    scans, points_m, valid = _scans(memory, sight)
    still = scans[:, -1].reshape(count, geometry.rows, geometry.columns, 4)
    on_beams = reproject.lies_on_beams(still, geometry).reshape(-1, 1, 1, 1)

    def splat(part: slice) -> Array:
        moved = reproject.splat(points_m[:, part].reshape(count, -1, 3), valid[:, part].reshape(count, -1), geometry)
        return jnp.where(on_beams, reproject.onto_beams(moved, geometry), moved)

    moved = newest = splat(slice(-1, None))
    if sight.places.shape[1] > 1:
        moved = jnp.where(newest[..., 3:] > 0.0, newest, splat(slice(None, -1)))
    returned = moved[..., 3] > 0.0
    fresh = sight.known[:, -1].reshape(-1, 1, 1)
    sky = reproject.move_sky(still, sight.pose[:, -1], geometry) & fresh & ~returned
    filled_m = reproject.fill_holes(moved[..., 3], sky, geometry)
    still_m = jnp.where(fresh, still[..., 3], RANGE_NO_RETURN_M)
    off_beam_m = moved[..., :3] - reproject.beam_points(moved[..., 3], geometry)
    return RangeGlimpse(moved_m=moved[..., 3], newest_m=newest[..., 3], filled_m=filled_m, still_m=still_m,
                        sky=sky.astype(jnp.float32), height_m=jnp.where(returned, moved[..., 2], 0.0),
                        off_beam_m=jnp.where(jnp.expand_dims(returned, -1) & ~on_beams, off_beam_m, 0.0))


def _image(config: ModelConfig, memory: Memory, sight: Sight, view: RangeGlimpse) -> ImageGlimpse:
    assert memory.image is not None and memory.intrinsics is not None and memory.camera_to_ego is not None  # see check
    images, rows = memory.image.reshape(-1, *memory.image.shape[2:]), sight.rows
    intrinsics, camera_to_ego = (_calibration(given)[rows] for given in (memory.intrinsics, memory.camera_to_ego))
    moved, inside = reproject.move_image(images, view.filled_m, sight.pose[:, -1], intrinsics, camera_to_ego,
                                         config.range_view, rows * memory.image.shape[1] + sight.places[:, -1])
    known = sight.known[:, -1].astype(jnp.float32).reshape(-1, 1, 1, 1)
    covered = jnp.where(jnp.expand_dims(inside, -1), 1.0, EDGE) * known
    colour = memory.image.astype(jnp.float32).mean(axis=(2, 3))[rows, sight.places[:, -1]].reshape(-1, 1, 1, 3)
    return ImageGlimpse(image=moved / 255.0 * covered, covered=covered, colour=colour / 255.0 * known)


def _calibration(matrices: Array) -> Array:
    """Matrices [B, k, k], with the identity for those of zeros: a stream has no camera before its first observation."""
    none = (matrices == 0.0).all(axis=(1, 2), keepdims=True)
    return jnp.where(none, jnp.eye(matrices.shape[-1], dtype=matrices.dtype)[None], matrices)


def _voxels(config: ModelConfig, memory: Memory, sight: Sight) -> VoxelGlimpse:
    if memory.evidence is None:
        evidence, hits = _evidence(config, memory, sight, config.voxels)
        glimpse = _gathered(evidence)
        if not as_kind(config.first_guess, LastSeen).follow_movers:
            return glimpse
        ahead = jnp.expand_dims(sight.ahead, -1)
        return dataclasses.replace(glimpse, onward=_onward(memory, sight, evidence, hits, ahead, config.voxels)[:, 0])
    move = lambda values, which: reproject.move_voxels(values, sight.pose[:, -1], config.voxels, _wide(config.voxels),
                                                       which)
    newest, older = jnp.split(move(memory.evidence, sight.rows), 2, axis=-1)
    glimpse = VoxelGlimpse(newest, older, None)
    if memory.onward is None:
        return glimpse
    step = jnp.minimum(sight.ahead, FORESEEN_STEPS) - 1
    onward = move(memory.onward.reshape(-1, *memory.onward.shape[2:]), sight.rows * FORESEEN_STEPS + step)
    foreseen = (sight.ahead <= FORESEEN_STEPS).reshape(-1, 1, 1, 1)
    return dataclasses.replace(glimpse, onward=jnp.where(foreseen, onward, 0.0))


def _evidence(config: ModelConfig, memory: Memory, sight: Sight, grid: VoxelGrid) -> tuple[Array, Array]:
    """Evidence of each scan in sight, [n, F, X, Y, Z] in [-1, 1], and 1 where it has a return in the voxel.

    A voxel that holds a return is occupied, as in the labels; the beam through its centre says the rest.
    """
    frames, view = memory.pose.shape[1], config.range_view
    size = (*sight.places.shape, *grid.shape)
    scans_m = memory.range_view[..., 3].reshape(-1, view.rows, view.columns)
    which = (sight.rows[:, None] * frames + sight.places).reshape(-1)
    evidence = reproject.scan_evidence(scans_m, which, sight.pose.reshape(-1, 3), grid, view).reshape(size)
    evidence = jnp.where(sight.known.reshape(*sight.known.shape, 1, 1, 1), evidence, 0.0)
    _, points_m, valid = _scans(memory, sight)
    hits = reproject.hit_voxels(points_m.reshape(-1, *points_m.shape[2:]), valid.reshape(-1, valid.shape[-1]), grid)
    hits = hits.reshape(size)
    return jnp.where(hits > 0.0, 1.0, evidence), hits


def _gathered(evidence: Array) -> VoxelGlimpse:
    """The newest scan's evidence, and that of all before it added up, [n, F, X, Y, Z] in all."""
    weights = FADE ** jnp.arange(evidence.shape[1] - 2, -1, -1, dtype=jnp.float32).reshape(1, -1, 1, 1, 1)
    return VoxelGlimpse(evidence[:, -1], jnp.clip((evidence[:, :-1] * weights).sum(axis=1), -1.0, 1.0), None)


def _onward(memory: Memory, sight: Sight, evidence: Array, hits: Array, ahead: Array, grid: VoxelGrid) -> Array:
    """1 where returns of the newest scan will be that go on as they moved: [n, S, X, Y, Z], `ahead` [n, S] steps."""
    layers = grid.layers(*_MOVING_M)
    older = evidence[:, -1 - scene_flow.LAGS:-1]
    flow = scene_flow.cell_flow(*jax.lax.stop_gradient((hits[:, -1, ..., layers], older[..., layers])))
    _, points_m, valid = _scans(memory, sight)
    points_m, valid = points_m[:, -1], valid[:, -1]
    cell = lambda axis: jnp.clip(jnp.floor((points_m[..., axis] - grid.origin_m[axis]) / grid.voxel_size_m), 0,
                                 grid.shape[axis] - 1).astype(jnp.int32)
    moves = jax.vmap(lambda values, x, y: values[x, y])(flow, cell(0), cell(1))  # in cells a step
    moves = jnp.pad(moves * grid.voxel_size_m, ((0, 0), (0, 0), (0, 1)))
    moving = valid & (points_m[..., 2] >= _MOVING_M[0]) & (moves != 0.0).any(axis=-1)
    there_m = points_m[:, None] + moves[:, None] * ahead.astype(jnp.float32)[..., None, None]
    moving = jnp.broadcast_to(moving[:, None], there_m.shape[:3])
    there = reproject.hit_voxels(there_m.reshape(-1, *there_m.shape[2:]), moving.reshape(-1, moving.shape[-1]), grid)
    return jax.lax.stop_gradient(there.reshape(*ahead.shape, *grid.shape))


def with_evidence(config: ModelConfig, memory: Memory | None, vantage: Vantage | None) -> Memory | None:
    """The memory with the evidence for voxels worked out once, for many states that are imagined from its newest
    observation: a planner's. Resampled from there it is a little blurred, and ends half a grid beyond the grid.

    What is decoded with it must be imagined, at least one step, from there: see memory.check_evidence.

    vantage: [B], of the states from which imagination starts; None where there is no memory.

    Raises:
      ValueError: if the vantage is not [B], or is concrete and not that of the newest observation.
    """
    if memory is None or vantage is None or (
            "occupancy" not in memory_lib.views(memory_lib.guessed_heads(config))):
        return memory
    drives, frames = memory.pose.shape[:2]
    if jnp.shape(vantage.last) != (drives,):
        raise ValueError(f"with_evidence: got a vantage {list(jnp.shape(vantage.last))}, expected [{drives}], a "
                         f"start in each drive of the memory.")
    elsewhere = lambda: (np.asarray(vantage.last) != frames - 1) | (np.asarray(vantage.steps) != 0)
    if not memory_lib.traced(vantage) and elsewhere().any():
        raise ValueError("with_evidence: the vantage is not that of the memory's newest observation; take it from "
                         "observed.last or from the latent of a stream.")
    guess = as_kind(config.first_guess, LastSeen)
    places, rows = guess.memory_frames, jnp.arange(memory.pose.shape[0])
    newest = memory.pose.shape[1] + jnp.arange(-places, 0, dtype=jnp.int32)
    index = jnp.broadcast_to(newest[None], (rows.shape[0], places))
    known = (index >= vantage.first[:, None]) & (index >= 0)
    index = jnp.maximum(index, 0)
    pose = motion_ops.relative(jnp.zeros((*index.shape, 3), jnp.float32), memory.pose[rows[:, None], index])
    sight, grid = Sight(rows, index, known, pose, jnp.ones_like(rows)), _wide(config.voxels)
    evidence, hits = _evidence(config, memory, sight, grid)
    gathered = _gathered(evidence)
    memory = dataclasses.replace(memory, evidence=jnp.concatenate([gathered.newest, gathered.older], axis=-1))
    if not guess.follow_movers:
        return memory
    ahead = jnp.broadcast_to(1 + jnp.arange(FORESEEN_STEPS)[None], (rows.shape[0], FORESEEN_STEPS))
    return dataclasses.replace(memory, onward=_onward(memory, sight, evidence, hits, ahead, grid))


def _wide(grid: VoxelGrid) -> VoxelGrid:
    """The grid with half its length more on each side."""
    x, y, z = grid.shape
    low_x, low_y, low_z = grid.origin_m
    return VoxelGrid((2 * x, 2 * y, z), grid.voxel_size_m,
                     (low_x - 0.5 * x * grid.voxel_size_m, low_y - 0.5 * y * grid.voxel_size_m, low_z))
