"""What was seen of late, and where a state stands to it: the geometric memory (config.LastSeen).

Moving what the sensors showed by the motion of the car needs no learning, and says most of what the next frames show.
So a model with this memory keeps its last observations as they came (types.Memory, beside the states, once for all
that is imagined from them), its states know where they stand to it (types.Vantage), and its decoders see the memory as
it looks from there (glimpse.py). docs/memory.md says what this brings and what it cannot do.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import head as head_lib
from muvo_jax.config import KNOWN_HEADS, LastSeen, ModelConfig
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import UNTIMED_FIELDS, Array, ArrayLike, Batch, LatentState, Memory, Motion, Vantage


def guessed_heads(config: ModelConfig) -> tuple[str, ...]:
    """The heads whose decoders see the memory: what cannot be moved (nothing moves without ranges) is not guessed."""
    if not isinstance(config.first_guess, LastSeen) or config.lidar is None:
        return ()
    guides = {name: head_lib.get(name).guide for name in KNOWN_HEADS if name in config.heads}
    return tuple(name for name, guide in guides.items() if guide is not None
                 and (guide.view != "image" or config.camera is not None))


def views(heads: tuple[str, ...]) -> frozenset[str]:
    """Whose memory the decoders of these guessed heads look at; see head.Guide."""
    return frozenset(guide.view for name in heads if (guide := head_lib.get(name).guide) is not None)


def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """What is remembered of an observation: field of Batch -> its shape for one frame."""
    heads = guessed_heads(config)
    fields: dict[str, tuple[int, ...]] = {}
    if heads:
        fields["range_view"] = (config.range_view.rows, config.range_view.columns, 4)
    if "image" in views(heads):
        fields |= {"image": (*config.image_size, 3), "intrinsics": (3, 3), "camera_to_ego": (4, 4)}
    return fields


def stream_places(config: ModelConfig) -> int:
    """Observations that a stream remembers: those that decoders look at, and the newest.

    That one is hidden from the decoders of its own state, which look at as many before it, as those of a window do.
    """
    guess = config.first_guess
    return (guess.memory_frames if isinstance(guess, LastSeen) else 0) + 1


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
    return None if batch.ego_motion is None else from_arrivals(jnp.asarray(batch.ego_motion), batch.is_first)


def from_arrivals(ego_motion: Array, is_first: ArrayLike) -> Motion:
    """Batch.ego_motion [B, T, 4], which says how the car came to each frame, as the motion from each frame on.

    How it came to a frame that `is_first` [B, T] is not known, and counts as no motion: nobody looks across that cut.
    """
    arrivals = jnp.where(jnp.expand_dims(is_first, -1), 0.0, ego_motion[..., :3])
    onward = jnp.concatenate([arrivals[:, 1:], jnp.zeros_like(arrivals[:, :1])], axis=1)
    return Motion(onward, ego_motion[..., 3])


def of_window(config: ModelConfig, batch: Batch, states: LatentState,
              measured: Motion) -> tuple[LatentState, Memory | None]:
    """The states [B, T] of an observed window with their vantages, and the memory that they look at."""
    is_first, frames = jnp.asarray(batch.is_first), batch.frames
    steps, speed_mps = measured.pose, measured.speed_mps

    def walk(pose, step):
        return motion_ops.placed(pose, step), pose

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
    with_image = "image" in views(heads)
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
    if "image" not in views(heads):
        return memory
    return dataclasses.replace(memory, image=jnp.zeros((*lead, *config.image_size, 3), jnp.uint8),
                               intrinsics=jnp.zeros((batch_size, 3, 3), jnp.float32),
                               camera_to_ego=jnp.zeros((batch_size, 4, 4), jnp.float32))


def remember(memory: Memory, batch: Batch, step: Array) -> Memory:
    """With one more observation (a batch of one frame), the oldest one forgotten.

    step: float32 [B, 3], where the car stands in the ego frame of the observation before; nowhere at the first one.
    """
    step = jnp.where(batch.is_first, 0.0, step)
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
    drives = memory.pose.shape[0]
    check_sizes("decode", config, memory)
    check_evidence(states, memory)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(lead):]), states.vantage)
    count = flat.last.shape[0]
    if rows is not None:
        check_indices("decode", "rows", rows, drives, "which drive of the memory a state belongs to")
        rows = jnp.asarray(rows, jnp.int32)
        if rows.shape != lead:
            raise ValueError(f"decode: got rows {list(rows.shape)}, expected {list(lead)}, a drive for each state.")
        return flat, rows.reshape(-1)
    if (lead[0] if lead else 1) != drives:
        raise ValueError(f"decode: got states [{', '.join(map(str, (*lead, '...')))}] and a memory of {drives} drives; "
                         f"the first axis of the states must count the drives. Pass rows= otherwise.")
    return flat, jnp.repeat(jnp.arange(drives, dtype=jnp.int32), count // drives)


def check_indices(where: str, name: str, given, count: int, what: str) -> None:
    """Raises ValueError where concrete indices are no whole numbers from 0 to count - 1; traced values pass."""
    if isinstance(given, jax.core.Tracer):
        return
    values = np.asarray(given)
    if not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{where}: {name} is {values.dtype}{list(values.shape)}, expected whole numbers, {what}.")
    wrong = values[(values < 0) | (values >= count)]
    if wrong.size:
        raise ValueError(f"{where}: {name} {list(values.shape)} holds {wrong[0]}; expected 0 to {count - 1}, {what}.")


def check_sizes(where: str, config: ModelConfig, memory: Memory) -> None:
    """Raises ValueError where a memory is not of the sizes that a model remembers."""
    drives, frames = memory.pose.shape[:2]
    for name, shape in inputs(config).items():
        value = getattr(memory, name)
        expected = (drives, *(() if name in UNTIMED_FIELDS else (frames,)), *shape)
        if value is None or value.shape != expected:
            raise ValueError(f"{where}: memory.{name} is {None if value is None else list(value.shape)}, expected "
                             f"{list(expected)} beside memory.pose {list(memory.pose.shape)}; this memory belongs to "
                             f"another model or recording, or is of two.")


def check_evidence(states: LatentState, memory: Memory | None) -> None:
    """Raises ValueError where concrete states are none that a memory `with_evidence` was made for; traced ones pass."""
    vantage = states.vantage
    if memory is None or memory.evidence is None or vantage is None or traced(vantage):
        return
    newest, steps, last = memory.pose.shape[1] - 1, np.asarray(vantage.steps), np.asarray(vantage.last)
    if (steps < 1).any() or (last != newest).any():
        raise ValueError(f"decode: the memory's evidence holds for states imagined from its newest observation, number "
                         f"{newest}; got states {np.unique(steps).tolist()} steps (0: not imagined) from observations "
                         f"{np.unique(last).tolist()}. Decode these with the memory as it was before with_evidence.")


def traced(vantage: Vantage) -> bool:
    """Whether the numbers of a vantage cannot be looked at."""
    return isinstance(vantage.steps, jax.core.Tracer) or isinstance(vantage.last, jax.core.Tracer)
