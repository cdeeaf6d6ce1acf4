"""The raw batch of golden files p4 and p5 (what the authors' dataset gives), and the same as our model reads it.

Sizes are those of the arrays that a file stores of it, or else those of p4 in pack.json.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from muvo_jax.interop import reference_preprocess as preprocess
from muvo_jax.interop.parity import cases
from muvo_jax.types import Batch


def draw_raw(context: cases.Context, frames: int, later: int) -> dict[str, np.ndarray]:
    """Arrays [1, frames, ...] in torch's layout; the actions have `later` more, to imagine with."""
    draw, image_size = context.draw, context.size("p4", "image_hw")
    intrinsics = np.broadcast_to(preprocess.intrinsics(image_size), (1, frames, 3, 3)).astype(np.float32)
    return {
        "image": draw("full_image", (1, frames, 3, *image_size), "image_u8"),
        "route_map": draw("full_route", (1, frames, 3, *context.size("p4", "route_hw")), "route_u8"),
        "speed": draw("full_speed", (1, frames, 1), "speed"),
        "range_view_pcd_xyzd": draw("full_rv", (1, frames, 4, *range_size(context)), "range_view"),
        "voxel": draw("full_voxel", (1, frames, 1, *voxel_shape(context)), "voxel2"),
        "action": np.concatenate([draw("full_throttle", (1, frames + later, 1), "pm1"),
                                  draw("full_steer", (1, frames + later, 1), "pm1")], axis=-1),
        "intrinsics": intrinsics,
    }


def range_size(context: cases.Context) -> tuple[int, ...]:
    """Rows and columns of the range view."""
    return (context.shape("in/range_view_pcd_xyzd") or context.size("p4", "range_hw"))[-2:]


def voxel_shape(context: cases.Context) -> tuple[int, ...]:
    """Sides of the voxel grid."""
    smallest = context.shape("in/voxel_label_4")
    return tuple(4 * side for side in smallest[-3:]) if smallest else context.size("p4", "voxel_xyz")


def points(context: cases.Context, frames: int) -> dict[str, np.ndarray]:
    """The scans as points, for the PP variants: fields of our batch. Each frame counts fewer points than the last."""
    most = context.size("p4", "points")
    clouds = [context.draw(f"full_cloud_{frame}", (most,), "cloud") for frame in range(frames)]
    count = most - context.size("p4", "fewer_points") * np.arange(frames, dtype=np.int32)
    return {"points": np.stack(clouds)[None].astype(np.float32), "point_count": count[None]}


def navigation(context: cases.Context, frames: int) -> dict[str, np.ndarray]:
    """What the route asks for, for the variants with measurements: fields of our batch."""
    commands = {field: context.draw(name, (1, frames), "ints6").astype(np.int32)
                for field, name in (("command", "full_cmd"), ("next_command", "full_cmd_next"))}
    targets = {field: context.draw(name, (1, frames, 2), "pm1")
               for field, name in (("target_m", "full_gps"), ("next_target_m", "full_gps_next"))}
    return commands | targets


def model_batch(raw: dict[str, np.ndarray], **more: Any) -> Batch:
    """The batch of our model: channels last, cropped, not normalised (the model does that).

    Args:
      raw: from `draw_raw`.
      more: further fields of the batch.
    """
    frames = raw["image"].shape[1]
    image = np.moveaxis(preprocess.crop(raw["image"]), 2, -1)
    cropped = preprocess.cropped_intrinsics(raw["intrinsics"])[:, 0]
    return Batch(
        action=raw["action"][:, :frames], is_first=np.arange(frames)[None] == 0, image=np.ascontiguousarray(image),
        range_view=np.ascontiguousarray(np.moveaxis(raw["range_view_pcd_xyzd"], 2, -1)),
        occupancy=raw["voxel"][:, :, 0], route_map=preprocess.nearest(raw["route_map"], (64, 64))[:, :, 0],
        speed_mps=raw["speed"][..., 0], intrinsics=cropped,
        camera_to_ego=preprocess.camera_to_ego()[None].astype(np.float32), **more)
