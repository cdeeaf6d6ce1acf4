"""Pack p2_geometry: positions of tokens, cameras, the range view, and the preprocessing of the network's inputs."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import packs, reference_preprocess
from muvo_jax.interop.parity import cases, recordings
from muvo_jax.nn import attention
from muvo_jax.ops import range_view

Checks = Iterator[cases.Check]
TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4
_RAW_SIZE = (600, 960)


def positions(context: cases.Context) -> Checks:
    """Sine embeddings; the name says channels of an axis and the grid, as in pos2d/a_192_10x26."""
    for entry in context.pack.names:
        match = re.fullmatch(r"pos[23]d/(?:[a-z]_)?(\d+)_(\d+(?:x\d+)+)", entry)
        if match:
            grid = tuple(int(side) for side in match[2].split("x"))
            table = attention.sine_positions(grid, int(match[1]) * len(grid))
            yield cases.Check(entry, table.T.reshape(1, -1, *grid), TOLERANCE)


def cameras(context: cases.Context) -> Checks:
    matrix = reference_preprocess.intrinsics(_RAW_SIZE)
    for entry, value in (("intrinsics", matrix), ("extrinsics", reference_preprocess.camera_to_ego()),
                         ("intrinsics_cropped", reference_preprocess.cropped_intrinsics(matrix)),
                         ("bev_intrinsics_48", reference_preprocess.bev_intrinsics())):
        yield cases.Check(f"camera/{entry}", value, TOLERANCE)


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


GROUPS: tuple[cases.Group, ...] = (positions, cameras, projection, network_inputs, *recordings.GROUPS)
LEFT_OUT = {r".*label_ambiguous": "marks what the pages say not to compare",
            r"pre_antialias/.*": "stored for information only", r"frustum/.*_out_f32": "stored for information only"}
