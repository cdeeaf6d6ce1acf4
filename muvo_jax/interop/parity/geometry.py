"""Pack p2_geometry: positions of tokens, cameras, the range view, and the preprocessing of the network's inputs."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import packs, reference_preprocess
from muvo_jax.interop.parity import cases, pooling, recordings
from muvo_jax.nn import attention
from muvo_jax.ops import range_view

Checks = Iterator[cases.Check]
TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4
_RAW_SIZE, _BIRDVIEW_CELLS = (600, 960), 192


def positions(context: cases.Context) -> Checks:
    """Sine embeddings; the name says channels of an axis and the grid, as in pos2d/a_192_10x26."""
    for entry in context.pack.names:
        match = re.fullmatch(r"pos[23]d/(?:[a-z]_)?(\d+)_(\d+(?:x\d+)+)", entry)
        if match:
            grid = tuple(int(side) for side in match[2].split("x"))
            table = attention.sine_positions(grid, int(match[1]) * len(grid))
            yield cases.Check(entry, table.T.reshape(1, -1, *grid), TOLERANCE)
    yield cases.Check("pos2d/unnormalised_16_5x7", _counted_positions((5, 7), 16)[None], TOLERANCE)


def _counted_positions(grid: tuple[int, int], channels: int) -> np.ndarray:
    """Sine embedding [2 * channels, *grid] of rows and columns counted from 1; our models use shares of the grid."""
    periods = 10000.0 ** (2 * (np.arange(channels) // 2) / channels)
    counted = np.asarray(np.indices(grid)) + 1
    phase = counted[:, None] / periods[None, :, None, None]
    odd = (np.arange(channels) % 2 == 1)[None, :, None, None]
    return np.where(odd, np.cos(phase), np.sin(phase)).reshape(-1, *grid)


def cameras(context: cases.Context) -> Checks:
    matrix = reference_preprocess.intrinsics(_RAW_SIZE)
    for entry, value in (("intrinsics", matrix), ("extrinsics", reference_preprocess.camera_to_ego()),
                         ("intrinsics_cropped", reference_preprocess.cropped_intrinsics(matrix)),
                         ("bev_intrinsics_48", reference_preprocess.bev_intrinsics())):
        yield cases.Check(f"camera/{entry}", value, TOLERANCE)
    mask = reference_preprocess.out_of_view(_RAW_SIZE, _BIRDVIEW_CELLS)
    yield cases.Check("camera/out_of_view_mask", mask, SHARE_TOLERANCE, packs.Pack.share_different)


def projection(context: cases.Context) -> Checks:
    """The nearest return of each pixel; a point on the edge of a pixel may fall on either side of it."""
    rows, columns = context.settings.size("p2", "range_hw")
    cloud = context.draw("rv_cloud", (context.settings.size("p2", "cloud_points"),), "cloud")
    view = range_view.project(cloud, config_lib.RangeViewGeometry(rows=rows, columns=columns))
    yield cases.Check("range/depth", view[..., 3], SHARE_TOLERANCE, _share_apart)
    yield cases.Check("range/xyz", view[..., :3], SHARE_TOLERANCE, _share_apart)


def _share_apart(pack: packs.Pack, entry: str, got: np.ndarray) -> float:
    """Share of the stored values that are off by more than the tolerance of floats."""
    want, have = pack.stored(entry, got)
    return float((np.abs(want - have) > TOLERANCE * np.abs(want).max()).mean())


def network_inputs(context: cases.Context) -> Checks:
    raw = {"image": context.draw("pre_image", (1, 2, 3, *_RAW_SIZE), "image_u8"),
           "route_map": context.draw("pre_route", (1, 2, 3, 192, 192), "route_u8"),
           "range_view_pcd_xyzd": context.draw("pre_rv", (1, 2, 4, 64, 1024), "range_view"),
           "voxel": context.draw("pre_vox", (1, 2, 1, 192, 192, 64), "voxel2"),
           "intrinsics": np.broadcast_to(reference_preprocess.intrinsics(_RAW_SIZE), (1, 2, 3, 3))}
    for name, value in reference_preprocess.network_inputs(raw).items():
        yield cases.Check(f"pre/{name}", value, TOLERANCE)


def optional_labels(context: cases.Context) -> Checks:
    """Labels of heads that the released models lack; birdviews also without what the camera cannot see."""
    cells = (1, 2, 1, _BIRDVIEW_CELLS, _BIRDVIEW_CELLS)
    image = (1, 2, 1, *_RAW_SIZE)
    birdview = context.draw("pre_bev", cells, "labels8")
    labels = reference_preprocess.optional_labels({
        "birdview": birdview, "instance": context.draw("pre_inst", cells, "instance4"),
        "depth": context.draw("pre_depth", image, "smooth"),
        "image_instance_mask": context.draw("pre_imask", image, "mask").astype(np.uint8),
        "semantic_image": context.draw("pre_sem", image, "labels9"),
        "range_view_pcd_seg": context.draw("pre_rvs", (1, 2, 1, 64, 1024), "labels9")})
    for name, value in labels.items():
        yield cases.Check(f"pre/{name}", value, TOLERANCE)
    visible = np.where(reference_preprocess.out_of_view(_RAW_SIZE, _BIRDVIEW_CELLS), 0, birdview)
    for scale, value in reference_preprocess.birdview_labels(visible).items():
        yield cases.Check(f"pre_maskview/birdview_label_{scale}", value, TOLERANCE)
    small = reference_preprocess.centres_and_offsets(context.draw("inst_small", (1, 2, 1, 20, 24), "instance4"), 4.0)
    for name, value in zip(("center", "offset"), small, strict=True):
        yield cases.Check(f"instance/{name}", value, TOLERANCE)


def halved_batch(context: cases.Context) -> Checks:
    image = context.draw("rb_image", (1, 2, 3, 64, 96), "smooth")
    yield cases.Check("resize_batch_half/image", reference_preprocess.halved_antialiased(image), TOLERANCE)
    matrix = np.broadcast_to(reference_preprocess.intrinsics(_RAW_SIZE), (1, 2, 3, 3))
    halved = matrix * np.array([0.5, 0.5, 1.0], np.float32)[:, None]
    yield cases.Check("resize_batch_half/intrinsics", halved, TOLERANCE)


GROUPS: tuple[cases.Group, ...] = (positions, cameras, projection, network_inputs, optional_labels, halved_batch,
                                   *recordings.GROUPS, *pooling.GROUPS)
LEFT_OUT = {r".*label_ambiguous": "marks what the pages say not to compare",
            r"pre_antialias/.*": "stored for information only", r"frustum/.*_out_f32": "stored for information only"}
