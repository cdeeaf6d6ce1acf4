"""File p2_geometry: positions of tokens, cameras, the range view, and the preprocessing of the network's inputs."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import reference_preprocess
from muvo_jax.interop.parity import cases, golden, pooling, recordings, rounding
from muvo_jax.nn import attention
from muvo_jax.ops import range_view

Checks = Iterator[cases.Check]
TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4


def positions(context: cases.Context) -> Checks:
    """Sine embeddings; the name says channels of an axis and the grid, as in pos2d/a_192_10x26."""
    for entry in context.file.names:
        match = re.fullmatch(r"pos[23]d/(?:[a-z]_)?(\d+)_(\d+(?:x\d+)+)", entry)
        if match:
            grid = tuple(int(side) for side in match[2].split("x"))
            table = attention.sine_positions(grid, int(match[1]) * len(grid))
            yield cases.Check(entry, table.T.reshape(1, -1, *grid), TOLERANCE)
        match = re.fullmatch(r"pos2d/unnormalised_(\d+)_(\d+)x(\d+)", entry)
        if match:
            channels, *sides = (int(number) for number in match.groups())
            yield cases.Check(entry, _counted_positions(tuple(sides), channels)[None], TOLERANCE)


def _counted_positions(grid: tuple[int, ...], channels: int) -> np.ndarray:
    """Sine embedding [2 * channels, *grid] of rows and columns counted from 1; our models use shares of the grid."""
    periods = 10000.0 ** (2 * (np.arange(channels) // 2) / channels)
    counted = np.asarray(np.indices(grid)) + 1
    phase = counted[:, None] / periods[None, :, None, None]
    odd = (np.arange(channels) % 2 == 1)[None, :, None, None]
    return np.where(odd, np.cos(phase), np.sin(phase)).reshape(-1, *grid)


def cameras(context: cases.Context) -> Checks:
    size = context.size("p2", "image_hw")
    matrix = reference_preprocess.intrinsics(size)
    for entry, value in (("intrinsics", matrix), ("extrinsics", reference_preprocess.camera_to_ego()),
                         ("intrinsics_cropped", reference_preprocess.cropped_intrinsics(matrix)),
                         ("bev_intrinsics_48", reference_preprocess.bev_intrinsics())):
        yield cases.Check(f"camera/{entry}", value, TOLERANCE)
    cells = (context.shape("camera/out_of_view_mask") or context.size("p2", "birdview_hw"))[0]
    mask = reference_preprocess.out_of_view(size, cells)
    yield cases.Check("camera/out_of_view_mask", mask, SHARE_TOLERANCE, golden.File.share_different)


def projection(context: cases.Context) -> Checks:
    """The nearest return of each pixel; a point on the edge of a pixel may fall on either side of it.

    The reference's points are float64, ours float32.
    """
    rows, columns = context.shape("range/depth") or context.size("p2", "range_hw")
    cloud = context.draw("rv_cloud", (context.size("p2", "cloud_points"),), "cloud")
    geometry = config_lib.RangeViewGeometry(rows=rows, columns=columns)
    view = range_view.project(cloud, geometry)
    for entry, part in (("range/depth", 3), ("range/xyz", slice(3))):
        again = lambda part=part: (range_view.project(moved, geometry)[..., part] for moved in rounding.anew(cloud))
        yield cases.Check(entry, view[..., part], SHARE_TOLERANCE, _share_apart, again=again)


def _share_apart(file: golden.File, entry: str, got: np.ndarray) -> float:
    """Share of the stored values that are off by more than the tolerance of floats."""
    want, have = file.stored(entry, got)
    return float((np.abs(want - have) > TOLERANCE * np.abs(want).max()).mean())


def network_inputs(context: cases.Context) -> Checks:
    size = context.size("p2", "image_hw")
    range_shape = _full_shape(context, "range_view", "range_hw")
    image_frames = _frames(context, "pre/image", "pre/rgb_label_1")
    raw = {"image": context.draw("pre_image", (*image_frames, 3, *size), "image_u8"),
           "route_map": context.draw("pre_route", (*_frames(context, "pre/route_map"), 3,
                                                   *context.size("p2", "route_hw")), "route_u8"),
           "range_view_pcd_xyzd": context.draw("pre_rv", (*range_shape[:2], 4, *range_shape[3:]), "range_view"),
           "voxel": context.draw("pre_vox", _full_shape(context, "voxel", "voxel_xyz"), "voxel2"),
           "intrinsics": np.broadcast_to(reference_preprocess.intrinsics(size), (*image_frames, 3, 3))}
    for name, value in reference_preprocess.network_inputs(raw).items():
        yield cases.Check(f"pre/{name}", value, TOLERANCE)


def optional_labels(context: cases.Context) -> Checks:
    """Labels of heads that the released models lack; birdviews also without what the camera cannot see."""
    size = context.size("p2", "image_hw")
    image = lambda name: (*_frames(context, f"pre/{name}_1", f"pre/{name}"), 1, *size)
    birdview = context.draw("pre_bev", _full_shape(context, "birdview", "birdview_hw"), "labels8")
    labels = reference_preprocess.optional_labels({
        "birdview": birdview,
        "instance": context.draw("pre_inst", _full_shape(context, "instance", "birdview_hw"), "instance4"),
        "depth": context.draw("pre_depth", image("depth_label"), "smooth"),
        "image_instance_mask": context.draw("pre_imask", image("image_instance_mask"), "mask").astype(np.uint8),
        "semantic_image": context.draw("pre_sem", image("semantic_image_label"), "labels9"),
        "range_view_pcd_seg": context.draw("pre_rvs", _full_shape(context, "range_view_seg", "range_hw"), "labels9")})
    for name, value in labels.items():
        yield cases.Check(f"pre/{name}", value, TOLERANCE)
    visible = np.where(reference_preprocess.out_of_view(size, birdview.shape[-1]), 0, birdview)
    for scale, value in reference_preprocess.birdview_labels(visible).items():
        yield cases.Check(f"pre_maskview/birdview_label_{scale}", value, TOLERANCE)
    shape = context.shape("instance/center") or (1, 2, 1, *context.size("p2", "instance_hw"))
    small = reference_preprocess.centres_and_offsets(context.draw("inst_small", shape, "instance4"), 4.0)
    for name, value in zip(("center", "offset"), small, strict=True):
        yield cases.Check(f"instance/{name}", value, TOLERANCE)


def _frames(context: cases.Context, *entries: str) -> tuple[int, ...]:
    """Batch and frames of an input, from what became of it."""
    return (context.shape(*entries) or (1, 2))[:2]


def _full_shape(context: cases.Context, name: str, size: str) -> tuple[int, ...]:
    """The shape of a label [B, S, 1, ...] at scale 1, from its array or else with the size of this name."""
    return context.shape(f"pre/{name}_label_1") or (1, 2, 1, *context.size("p2", size))


def halved_batch(context: cases.Context) -> Checks:
    shape = context.shape("resize_batch_half/image")
    *lead, rows, columns = shape or (1, 2, 3, *(side // 2 for side in context.size("p2", "halved_hw")))
    image = context.draw("rb_image", (*lead, 2 * rows, 2 * columns), "smooth")
    yield cases.Check("resize_batch_half/image", reference_preprocess.halved_antialiased(image), TOLERANCE)
    matrix = np.broadcast_to(reference_preprocess.intrinsics(context.size("p2", "image_hw")), (*lead[:2], 3, 3))
    halved = matrix * np.array([0.5, 0.5, 1.0], np.float32)[:, None]
    yield cases.Check("resize_batch_half/intrinsics", halved, TOLERANCE)


GROUPS: tuple[cases.Group, ...] = (positions, cameras, projection, network_inputs, optional_labels, halved_batch,
                                   *recordings.GROUPS, *pooling.GROUPS)
LEFT_OUT = {r".*label_ambiguous": "marks what the pages say not to compare",
            r"pre_antialias/.*": "stored for information only", r"frustum/.*_out_f32": "stored for information only"}
