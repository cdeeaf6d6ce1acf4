"""What was seen of late and how it looks from where a state is: the geometric memory (first_guess="last_seen").

Moving what the sensors showed by the motion of the car needs no learning, and says most of what the next frames show.
So a model with this memory keeps its last observations as they came (types.Memory, beside the states, once for all
that is imagined from them), its states know where they stand to it (types.Vantage), and its decoders see the memory as
it looks from there: `look`. What a state's own observation showed is hidden from its decoders: copying it would teach
nothing. docs/memory.md says what this brings and what it cannot do.
"""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.config import NO_SENSOR, ModelConfig
from muvo_jax.geometry import VoxelGrid
from muvo_jax.ops import motion as motion_ops
from muvo_jax.ops import reproject
from muvo_jax.types import RANGE_NO_RETURN_M, UNTIMED_FIELDS, Array, Batch, LatentState, Memory, Motion, Vantage

FADE = 0.8  # weight of evidence that is one observation older: what moved away is forgotten


@flax.struct.dataclass
class ImageGlimpse:
    """The memory of the head image from n vantages, at full size.

    Attributes:
      image: float32 [n, H, W, 3] in [0, 1], the newest image moved, and `covered` [n, H, W, 1], 1 where it was seen.
    """

    image: Array
    covered: Array


@flax.struct.dataclass
class RangeGlimpse:
    """The memory of the head range_view from n vantages, at full size.

    Attributes:
      moved_m, newest_m, still_m: float32 [n, Hr, Wr] ranges, -1 where nothing is: all scans moved, the newest moved,
        and the newest as it was.
      filled_m: float32 [n, Hr, Wr], moved_m with its small holes filled.
      sky: float32 [n, Hr, Wr], 1 where a pixel without a return came to lie.
      height_m: float32 [n, Hr, Wr], of the moved returns over the road.
    """

    moved_m: Array
    newest_m: Array
    still_m: Array
    filled_m: Array
    sky: Array
    height_m: Array


@flax.struct.dataclass
class VoxelGlimpse:
    """The memory of the head occupancy from n vantages, at full size.

    Attributes:
      newest, older: float32 [n, X, Y, Z] in [-1, 1], evidence of the newest scan and of all before it.
    """

    newest: Array
    older: Array


Glimpse = ImageGlimpse | RangeGlimpse | VoxelGlimpse


def guessed_heads(config: ModelConfig) -> tuple[str, ...]:
    """The heads whose decoders see the memory: what cannot be moved (nothing moves without ranges) is not guessed."""
    if config.first_guess != "last_seen" or config.lidar == NO_SENSOR:
        return ()
    seen = ("image",) if config.camera != NO_SENSOR else ()
    return tuple(head for head in (*seen, "range_view", "occupancy") if head in config.heads)


def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """What is remembered of an observation: field of Batch -> its shape for one frame."""
    heads = guessed_heads(config)
    fields: dict[str, tuple[int, ...]] = {}
    if heads:
        fields["range_view"] = (config.range_view.rows, config.range_view.columns, 4)
    if "image" in heads:
        fields |= {"image": (*config.image_size, 3), "intrinsics": (3, 3), "camera_to_ego": (4, 4)}
    return fields


def stream_places(config: ModelConfig) -> int:
    """Observations that a stream remembers: those that decoders look at, and the newest.

    That one is hidden from the decoders of its own state, which look at as many before it, as those of a window do.
    """
    return config.memory_frames + 1


def initial_vantage(config: ModelConfig, batch_size: int) -> Vantage:
    """Before anything was seen: no observation is remembered."""
    zeros = jnp.zeros((batch_size,), jnp.int32)
    standing = Motion(jnp.zeros((batch_size, 3), jnp.float32), jnp.zeros((batch_size,), jnp.float32))
    places = stream_places(config)
    return Vantage(standing, zeros + places, zeros + places - 1, zeros)


def intended(config: ModelConfig, vantage: Vantage, action: Array) -> Motion:
    """What an action [..., 2] does to the car in one step of the model, in the ego frame before it."""
    kinematics = config.kinematics
    assert kinematics is not None  # callers ask where the car moves as the head ego_motion says
    standing = motion_ops.at_rest_of_frame(vantage.motion.speed_mps)
    return motion_ops.drive(standing, action, kinematics.contract, kinematics.periods)


def moved_on(vantage: Vantage, step: Motion) -> Vantage:
    """After one imagined step, given in the ego frame before it."""
    motion = motion_ops.moved(vantage.motion, jnp.concatenate([step.pose, jnp.expand_dims(step.speed_mps, -1)], -1))
    return dataclasses.replace(vantage, motion=motion, steps=vantage.steps + 1)


def measured(config: ModelConfig, batch: Batch) -> Motion | None:
    """The speed [B, T] and what the car does from each frame to the next, as far as it was measured.

    It is what the contract's bicycle makes of measured speeds and actions; without kinematics what the recording says
    (Batch.ego_motion), and None where it does not say: then the head ego_motion must.
    """
    if config.kinematics is not None:
        standing = motion_ops.at_rest_of_frame(jnp.asarray(batch.speed_mps))
        kinematics = config.kinematics
        steps = motion_ops.drive(standing, jnp.asarray(batch.action), kinematics.contract, kinematics.periods)
        return Motion(steps.pose, standing.speed_mps)
    return None if batch.ego_motion is None else from_arrivals(jnp.asarray(batch.ego_motion))


def from_arrivals(ego_motion: Array) -> Motion:
    """Batch.ego_motion [B, T, 4], which says how the car came to each frame, as the motion from each frame on."""
    onward = jnp.concatenate([ego_motion[:, 1:, :3], jnp.zeros_like(ego_motion[:, :1, :3])], axis=1)
    return Motion(onward, ego_motion[..., 3])


def of_window(config: ModelConfig, batch: Batch, states: LatentState,
              measured: Motion) -> tuple[LatentState, Memory | None]:
    """The states [B, T] of an observed window with their vantages, and the memory that they look at."""
    is_first, frames = jnp.asarray(batch.is_first), batch.frames
    steps, speed_mps = measured.pose, measured.speed_mps

    def walk(pose, step):
        following = motion_ops.moved(Motion(pose, pose[..., 0]), jnp.concatenate([step, step[..., :1]], -1)).pose
        return following, pose

    _, poses = jax.lax.scan(walk, jnp.zeros_like(steps[:, 0]), jnp.swapaxes(steps, 0, 1))
    poses = jnp.swapaxes(poses, 0, 1)
    poses = motion_ops.relative(poses, jnp.broadcast_to(poses[:, -1:], poses.shape))
    index = jnp.broadcast_to(jnp.arange(frames, dtype=jnp.int32)[None], is_first.shape)
    first = jax.lax.cummax(jnp.where(is_first, index, 0), axis=1)
    vantage = Vantage(Motion(poses, speed_mps), first, index, jnp.zeros_like(index))
    states = dataclasses.replace(states, vantage=vantage)
    return states, _remembered(config, batch, poses)


def _remembered(config: ModelConfig, batch: Batch, poses: Array) -> Memory | None:
    heads = guessed_heads(config)
    if not heads:
        return None
    with_image = "image" in heads
    pick = lambda name: jnp.asarray(getattr(batch, name)) if with_image else None
    return Memory(poses, jnp.asarray(batch.range_view), pick("image"), pick("intrinsics"), pick("camera_to_ego"))


def empty(config: ModelConfig, batch_size: int) -> Memory | None:
    """The memory of a stream before its first observation."""
    heads = guessed_heads(config)
    if not heads:
        return None
    lead, view = (batch_size, stream_places(config)), config.range_view
    memory = Memory(jnp.zeros((*lead, 3), jnp.float32),
                    jnp.full((*lead, view.rows, view.columns, 4), -1.0, jnp.float32))
    if "image" not in heads:
        return memory
    return dataclasses.replace(memory, image=jnp.zeros((*lead, *config.image_size, 3), jnp.uint8),
                               intrinsics=jnp.zeros((batch_size, 3, 3), jnp.float32),
                               camera_to_ego=jnp.zeros((batch_size, 4, 4), jnp.float32))


def remember(memory: Memory, batch: Batch, step: Array) -> Memory:
    """With one more observation (a batch of one frame), the oldest one forgotten.

    step: float32 [B, 3], where the car stands in the ego frame of the observation before.
    """
    append = lambda old, new: jnp.concatenate([old[:, 1:], jnp.asarray(new).astype(old.dtype)], axis=1)
    poses = motion_ops.relative(memory.pose, jnp.broadcast_to(step[:, None], memory.pose.shape))
    memory = dataclasses.replace(memory, pose=append(poses, jnp.zeros_like(step)[:, None]),
                                 range_view=append(memory.range_view, batch.range_view))
    if memory.image is None:
        return memory
    return dataclasses.replace(
        memory, image=append(memory.image, batch.image), intrinsics=jnp.asarray(batch.intrinsics),
        camera_to_ego=jnp.asarray(batch.camera_to_ego))


def check(config: ModelConfig, states: LatentState | Array, memory: Memory | None, rows: Array | None,
          lead: tuple[int, ...]) -> tuple[Vantage, Array]:
    """The flat vantage and rows of states [*lead, ...] that are decoded with a memory.

    Raises:
      ValueError: if there is no vantage or no memory, the memory is of other sizes, or neither `rows` nor the states'
        first axis says which of its drives a state belongs to.
    """
    heads = ", ".join(guessed_heads(config))
    if not isinstance(states, LatentState) or states.vantage is None or memory is None:
        came = "features" if not isinstance(states, LatentState) else (
            "states without a vantage" if states.vantage is None else "states")
        raise ValueError(f"decode: got {came}{' and no memory' if memory is None else ''}, but the heads {heads} of "
                         f"this model (first_guess='last_seen') look at what was seen of late. Pass states of "
                         f"`observe` or `imagine` and memory=observed.memory (live.memory of a stream).")
    drives, frames = memory.pose.shape[:2]
    for name, shape in inputs(config).items():
        value = getattr(memory, name)
        expected = (drives, *(() if name in UNTIMED_FIELDS else (frames,)), *shape)
        if value is None or value.shape != expected:
            raise ValueError(f"decode: memory.{name} is {None if value is None else list(value.shape)}, expected "
                             f"{list(expected)} beside memory.pose {list(memory.pose.shape)}; this memory belongs to "
                             f"another model or is of two.")
    check_evidence(states, memory)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(lead):]), states.vantage)
    count = flat.last.shape[0]
    if rows is not None:
        rows = jnp.asarray(rows, jnp.int32)
        if rows.shape != lead:
            raise ValueError(f"decode: got rows {list(rows.shape)}, expected {list(lead)}, a drive for each state.")
        return flat, rows.reshape(-1)
    if (lead[0] if lead else 1) != drives:
        raise ValueError(f"decode: got states [{', '.join(map(str, (*lead, '...')))}] and a memory of {drives} drives; "
                         f"the first axis of the states must count the drives. Pass rows= otherwise.")
    return flat, jnp.repeat(jnp.arange(drives, dtype=jnp.int32), count // drives)


def check_evidence(states: LatentState, memory: Memory | None) -> None:
    """Raises ValueError where concrete states are none that a memory `with_evidence` was made for; traced ones pass."""
    vantage = states.vantage
    if memory is None or memory.evidence is None or vantage is None or _traced(vantage):
        return
    newest, steps, last = memory.pose.shape[1] - 1, np.asarray(vantage.steps), np.asarray(vantage.last)
    if (steps < 1).any() or (last != newest).any():
        raise ValueError(f"decode: the memory's evidence holds for states imagined from its newest observation, number "
                         f"{newest}; got states {np.unique(steps).tolist()} steps (0: not imagined) from observations "
                         f"{np.unique(last).tolist()}. Decode these with the memory as it was before with_evidence.")


def _traced(vantage: Vantage) -> bool:
    return isinstance(vantage.steps, jax.core.Tracer) or isinstance(vantage.last, jax.core.Tracer)


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
    heads = tuple(head for head in guessed_heads(config) if head in heads)
    places = config.memory_frames
    stop = vantage.last + (vantage.steps > 0)
    index = stop[:, None] + jnp.arange(-places, 0, dtype=jnp.int32)[None]
    known = (index >= vantage.first[:, None]) & (index >= 0)
    index = jnp.clip(index, 0, memory.pose.shape[1] - 1)
    pose = motion_ops.relative(jnp.broadcast_to(vantage.motion.pose[:, None], (*index.shape, 3)),
                               memory.pose[rows[:, None], index])
    glimpses: dict[str, Glimpse] = {}
    if "occupancy" in heads:
        glimpses["occupancy"] = _evidence(config, memory, rows, index, known, pose)
    if "range_view" in heads or "image" in heads:
        glimpses["range_view"] = view = _ranges(config, memory, rows, index, known, pose)
        if "image" in heads:
            glimpses["image"] = _image(config, memory, rows, index[:, -1], known[:, -1], pose[:, -1], view)
    apart = jnp.where(known[:, -1:], pose[:, -1], 0.0) / jnp.array([10.0, 2.0, 0.3], jnp.float32).reshape(1, 3)
    numbers = [apart, vantage.steps.astype(jnp.float32)[:, None] / 5.0, vantage.motion.speed_mps[:, None] / 10.0]
    return {head: glimpses[head] for head in heads}, jnp.concatenate(numbers, axis=-1)


def _ranges(config: ModelConfig, memory: Memory, rows: Array, index: Array, known: Array, pose: Array) -> RangeGlimpse:
    geometry = config.range_view
    scans = memory.range_view[rows[:, None], index]
    scans = scans.reshape(*index.shape, -1, 4)
    points_m = motion_ops.into_frame(scans[..., :3], pose)
    valid = (scans[..., 3] > 0.0) & jnp.expand_dims(known, -1)
    splat = lambda part: reproject.onto_beams(reproject.splat(
        points_m[:, part].reshape(rows.shape[0], -1, 3), valid[:, part].reshape(rows.shape[0], -1), geometry), geometry)
    moved = newest = splat(slice(-1, None))
    if index.shape[1] > 1:
        moved = jnp.where(newest[..., 3:] > 0.0, newest, splat(slice(None, -1)))
    still = scans[:, -1].reshape(*newest.shape)
    fresh = known[:, -1].reshape(-1, 1, 1)
    sky = reproject.move_sky(still, pose[:, -1], geometry) & fresh & (moved[..., 3] <= 0.0)
    filled_m = reproject.fill_holes(moved[..., 3], sky, geometry)
    still_m = jnp.where(fresh, still[..., 3], RANGE_NO_RETURN_M)
    height_m = jnp.where(moved[..., 3] > 0.0, moved[..., 2], 0.0)
    return RangeGlimpse(moved_m=moved[..., 3], newest_m=newest[..., 3], filled_m=filled_m, still_m=still_m,
                        sky=sky.astype(jnp.float32), height_m=height_m)


def _image(config: ModelConfig, memory: Memory, rows: Array, index: Array, known: Array, pose: Array,
           view: RangeGlimpse) -> ImageGlimpse:
    assert memory.image is not None and memory.intrinsics is not None and memory.camera_to_ego is not None  # see check
    images = memory.image.reshape(-1, *memory.image.shape[2:])
    moved, inside = reproject.move_image(images, view.filled_m, pose, memory.intrinsics[rows],
                                         memory.camera_to_ego[rows], config.range_view,
                                         rows * memory.image.shape[1] + index)
    covered = jnp.expand_dims((inside & known.reshape(-1, 1, 1)).astype(jnp.float32), -1)
    return ImageGlimpse(image=moved / 255.0 * covered, covered=covered)


def _evidence(config: ModelConfig, memory: Memory, rows: Array, index: Array, known: Array,
              pose: Array) -> VoxelGlimpse:
    if memory.evidence is not None:
        both = reproject.move_voxels(memory.evidence, pose[:, -1], config.voxels, _wide(config.voxels), rows)
        return VoxelGlimpse(*jnp.split(both, 2, axis=-1))
    return VoxelGlimpse(*_scans_evidence(config, memory, rows, index, known, pose, config.voxels))


def _scans_evidence(config: ModelConfig, memory: Memory, rows: Array, index: Array, known: Array, pose: Array,
                    grid: VoxelGrid) -> tuple[Array, Array]:
    """Evidence of the newest scan and of all before it, [n, X, Y, Z] each in [-1, 1].

    A voxel that holds a return is occupied, as in the labels; the beam through its centre says the rest.
    """
    frames, places, view = memory.pose.shape[1], index.shape[1], config.range_view
    flat_pose = pose.reshape(-1, 3)
    scans_m = memory.range_view[..., 3].reshape(-1, view.rows, view.columns)
    evidence = reproject.scan_evidence(scans_m, (rows[:, None] * frames + index).reshape(-1), flat_pose, grid, view)
    scans = memory.range_view[rows[:, None], index].reshape(flat_pose.shape[0], -1, 4)
    hits = reproject.hit_voxels(motion_ops.into_frame(scans[..., :3], flat_pose), scans[..., 3] > 0.0, grid)
    evidence = jnp.where(hits > 0.0, 1.0, evidence).reshape(rows.shape[0], places, *grid.shape)
    evidence = jnp.where(known.reshape(*known.shape, 1, 1, 1), evidence, 0.0)
    weights = FADE ** jnp.arange(places - 2, -1, -1, dtype=jnp.float32).reshape(1, -1, 1, 1, 1)
    return evidence[:, -1], jnp.clip((evidence[:, :-1] * weights).sum(axis=1), -1.0, 1.0)


def with_evidence(config: ModelConfig, memory: Memory | None, vantage: Vantage | None) -> Memory | None:
    """The memory with the evidence for voxels worked out once, for many states that are imagined from its newest
    observation: a planner's. Resampled from there it is a little blurred, and ends half a grid beyond the grid.

    What is decoded with it must be imagined, at least one step, from there: see check_evidence.

    vantage: [B], of the states from which imagination starts; None where there is no memory.

    Raises:
      ValueError: if the vantage is not [B], or is concrete and not that of the newest observation.
    """
    if memory is None or vantage is None or "occupancy" not in config.heads:
        return memory
    drives, frames = memory.pose.shape[:2]
    if jnp.shape(vantage.last) != (drives,):
        raise ValueError(f"with_evidence: got a vantage {list(jnp.shape(vantage.last))}, expected [{drives}], a "
                         f"start in each drive of the memory.")
    if not _traced(vantage) and ((np.asarray(vantage.last) != frames - 1) | (np.asarray(vantage.steps) != 0)).any():
        raise ValueError("with_evidence: the vantage is not that of the memory's newest observation; take it from "
                         "observed.last or from the latent of a stream.")
    places, rows = config.memory_frames, jnp.arange(memory.pose.shape[0])
    newest = memory.pose.shape[1] + jnp.arange(-places, 0, dtype=jnp.int32)
    index = jnp.broadcast_to(newest[None], (rows.shape[0], places))
    known = (index >= vantage.first[:, None]) & (index >= 0)
    index = jnp.maximum(index, 0)
    pose = motion_ops.relative(jnp.zeros((*index.shape, 3)), memory.pose[rows[:, None], index])
    evidence = _scans_evidence(config, memory, rows, index, known, pose, _wide(config.voxels))
    return dataclasses.replace(memory, evidence=jnp.concatenate(evidence, axis=-1))


def _wide(grid: VoxelGrid) -> VoxelGrid:
    """The grid with half its length more on each side."""
    x, y, z = grid.shape
    low_x, low_y, low_z = grid.origin_m
    return VoxelGrid((2 * x, 2 * y, z), grid.voxel_size_m,
                     (low_x - 0.5 * x * grid.voxel_size_m, low_y - 0.5 * y * grid.voxel_size_m, low_z))
