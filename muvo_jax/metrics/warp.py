"""What geometry alone predicts: observed frames, as they look from where the car will be. Nothing is learned.

Range views are re-projected with the nearest point winning, images looked up through the ranges that are seen from
there, voxels resampled. `warp_last` moves the last observed frame; `warp_fused` has the evidence of all of them.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.metrics import baselines
from muvo_jax.ops import motion, reproject

FADING = 0.8  # what the evidence of a frame counts a step later


def motion_source(batch: types.Batch, config: config_lib.Config) -> str | None:
    """Where the motion comes from: "actions", through the contract's bicycle from the measured speed; else "recorded",
    the ego_motion of the batch; None where neither is known."""
    if config.contract.kinematics == "bicycle" and batch.speed_mps is not None:
        return "actions"
    return None if batch.ego_motion is None else "recorded"


def warp(batch: types.Batch, context: int, horizon: int, config: config_lib.Config, *,
         fused: bool = False) -> baselines.Frames:
    """Frames of the steps behind the context, moved there from it.

    Args:
      batch: windows of context + horizon frames; of the later ones only actions (or ego_motion) are used.
      context, horizon: frames that were observed, and frames to predict.
      config: whose contract, stride and sensors they are.
      fused: from all observed frames instead of the last one: a pixel that the last one does not cover takes the
        newest that does; a voxel's evidence (1 occupied, -1 empty, 0 unknown) adds up, fading. Alone the last frame's
        unknown voxels are empty, as copy-last has them.

    Returns:
      {"image": float32 [B, horizon, H, W, 3] in [0, 1], "range_view": float32 [...] in metres, "occupancy": bool
      [...]}, without the modalities that the batch lacks, and without the image where there is no range view to look it
      up through. A voxel that no evidence says is occupied is empty.

    Raises:
      ValueError: where the motion is unknown (motion_source).
    """
    source = motion_source(batch, config)
    if source is None:
        raise ValueError(f"warp: contract.kinematics is {config.contract.kinematics!r} and the batch has "
                         f"{'no ego_motion' if batch.speed_mps is not None else 'no speed_mps and no ego_motion'}: the "
                         f"motion is unknown. Record speeds, or poses.")
    model = config.model
    return jax.device_get(_warp(batch, context, horizon, source, fused, model.range_view, model.voxels, config.contract,
                                config.data.stride))


def path(batch: types.Batch, context: int, config: config_lib.Config) -> np.ndarray | None:
    """Where `warp` takes the car of the first window to be: float32 [T, 3], forward and left (m) and turn to the
    left (rad) in the frame of the first observation; None where the motion is unknown."""
    source = motion_source(batch, config)
    if source is None:
        return None
    return np.asarray(_poses(batch[:1], context, source, config.contract, config.data.stride)[0])


@functools.partial(jax.jit, static_argnums=range(1, 9))
def _warp(batch, context, horizon, source, fused, geometry, grid, contract, stride):
    poses = _poses(batch, context, source, contract, stride)
    count = batch.batch_size
    merge = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])
    repeat = lambda leaf: jnp.repeat(leaf, horizon, axis=0)
    frames: dict[str, jax.Array] = {}
    missing: dict[str, jax.Array] = {}
    for frame in range(context - 1, -1 if fused else context - 2, -1):  # the newest first
        pose = merge(motion.relative(poses[:, context:context + horizon], poses[:, frame:frame + 1]))
        found: dict[str, tuple[jax.Array, jax.Array]] = {}  # values and where they are known
        if batch.range_view is not None:
            seen = repeat(jnp.asarray(batch.range_view)[:, frame])
            moved = reproject.move_range_view(seen, pose, geometry)
            found["range_view"] = moved, moved[..., 3] > 0.0
            if batch.image is not None and batch.intrinsics is not None:
                range_m = reproject.fill_holes(moved[..., 3], reproject.move_sky(seen, pose, geometry), geometry)
                found["image"] = reproject.move_image(
                    repeat(batch.image[:, frame]).astype(jnp.float32) / 255.0, range_m, pose,
                    repeat(jnp.asarray(batch.intrinsics)), repeat(jnp.asarray(batch.camera_to_ego)), geometry)
        for name, (values, known) in found.items():
            frames[name] = jnp.where(missing[name][..., None] & known[..., None], values, frames[name]) if (
                name in frames) else values
            missing[name] = missing[name] & ~known if name in missing else ~known
        if batch.occupancy is not None:
            evidence = _evidence(jnp.asarray(batch.occupancy)[:, frame], 0.0 if fused else -1.0)
            evidence = reproject.move_voxels(repeat(evidence), pose, grid)
            frames["occupancy"] = frames.get("occupancy", 0.0) + FADING ** (context - 1 - frame) * evidence
    if "occupancy" in frames:
        frames["occupancy"] = frames["occupancy"] > 0.0
    return {name: value.reshape(count, horizon, *value.shape[1:]) for name, value in frames.items()}


def _evidence(occupancy: jax.Array, unknown: float) -> jax.Array:
    return jnp.where(occupancy == types.OCCUPANCY_UNKNOWN, unknown,
                     2.0 * (occupancy == types.OCCUPANCY_OCCUPIED) - 1.0).astype(jnp.float32)


def _poses(batch: types.Batch, context: int, source: str, contract: config_lib.ActionContract,
           stride: int) -> jax.Array:
    return _recorded_poses(batch) if source == "recorded" else _driven_poses(batch, context, contract, stride)


def _driven_poses(batch: types.Batch, context: int, contract: config_lib.ActionContract, stride: int) -> jax.Array:
    """Poses [B, T, 3] in the frame of the first one: observed steps start at their measured speed, later ones go on
    from the last of these."""
    speed_mps, action = jnp.asarray(batch.speed_mps), jnp.asarray(batch.action)
    state = motion.at_rest_of_frame(speed_mps[:, 0])
    poses = [state.pose]
    for frame in range(batch.frames - 1):
        if frame < context:
            state = types.Motion(state.pose, speed_mps[:, frame])
        state = motion.drive(state, action[:, frame], contract, stride)
        poses.append(state.pose)
    return jnp.stack(poses, axis=1)


def _recorded_poses(batch: types.Batch) -> jax.Array:
    """Poses [B, T, 3] in the frame of the first one, as ego_motion says."""
    ego_motion = jnp.asarray(batch.ego_motion)
    state = motion.at_rest_of_frame(ego_motion[:, 0, 3])
    poses = [state.pose]
    for frame in range(1, batch.frames):
        state = motion.moved(state, ego_motion[:, frame])
        poses.append(state.pose)
    return jnp.stack(poses, axis=1)
