"""File p2_geometry, the part of the data tools: points, voxels, images of the simulator, bird's-eye views, GPS."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import schema
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.interop import reference_data
from muvo_jax.interop import reference_preprocess as preprocess
from muvo_jax.interop.parity import cases, golden, rounding
from muvo_jax.ops import camera, range_view, voxels

Checks = Iterator[cases.Check]
TOLERANCE, SHARE_TOLERANCE = 1e-5, 1e-4
_FIELD_OF_VIEW_RAD = np.radians(110.0)
_SENSOR_M = np.array(preprocess.CAMERA_POSITION_M)
_GRID = config_lib.VoxelGrid()
_EGO_CELLS = {"1d": (32, 96, 12), "2d": (96, 96, 12)}
_GPS, _GPS_TARGET = (49.0, 8.4, 110.0), (49.0003, 8.4004, 112.0)
_COMMANDS_YAWS = ((-1, 0.3), (2, 2.0), (6, np.nan))


def _cloud(context: cases.Context, size: str = "cloud_points") -> np.ndarray:
    return context.draw("rv_cloud", (context.size("p2", size),), "cloud")


def _to_ego(points_m: np.ndarray) -> np.ndarray:
    """From the lidar's left-handed frame."""
    return (points_m + _SENSOR_M) * np.array([1.0, -1.0, 1.0])


def range_views(context: cases.Context) -> Checks:
    rows, columns = context.shape("range/sem") or context.size("p2", "range_hw")
    geometry = config_lib.RangeViewGeometry(rows=rows, columns=columns)
    cloud = _cloud(context)
    tags = context.draw("rv_sem", (len(cloud),), "ints9").astype(np.uint8)

    def nearest_tags(cloud: np.ndarray) -> np.ndarray:
        winner = range_view.nearest_points(cloud, geometry)
        return np.where(winner >= 0, tags[winner], 0)

    again = lambda: (nearest_tags(moved) for moved in rounding.anew(cloud))
    yield cases.Check("range/sem", nearest_tags(cloud), SHARE_TOLERANCE, _known_apart, again=again)
    shape = context.shape("restore_pcd") or (1, 2, rows, columns, 4)
    depth = 60 * context.draw("restore_depth", shape[:-1], "smooth")
    geometry = config_lib.RangeViewGeometry(rows=shape[2], columns=shape[3])
    yield cases.Check("restore_pcd", reference_data.pixel_corner_points(depth, geometry), TOLERANCE)


def _known_apart(file: golden.File, entry: str, got: np.ndarray) -> float:
    return file.share_different(entry, got, file["range/label_ambiguous"])


def depth_images(context: cases.Context) -> Checks:
    size = context.size("p2", "depth2pcd_hw")
    depth, tags = context.draw("d2p_depth", size, "depth_m"), context.draw("d2p_sem", size, "ints23")
    points, pixel = camera.reference_depth_points(depth, _FIELD_OF_VIEW_RAD, (0.0, 0.0, 0.0))
    in_camera = np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1)
    yield cases.Check("depth2pcd/n", np.array(points.shape), 0.0)
    yield cases.Check("depth2pcd/points", in_camera, TOLERANCE)
    yield cases.Check("depth2pcd/sem", tags.reshape(-1, 1)[pixel], SHARE_TOLERANCE, golden.File.share_different)
    in_ego, _ = camera.reference_depth_points(depth, _FIELD_OF_VIEW_RAD, preprocess.CAMERA_POSITION_M)
    yield cases.Check("convert_coor_img", in_ego, TOLERANCE)
    wanted = context.shape("convert_coor_lidar") or context.size("p2", "converted_points_xyz")
    yield cases.Check("convert_coor_lidar", _to_ego(_cloud(context)[:wanted[0]]), TOLERANCE)
    size = context.shape("carla_decode/depth_m", "carla_decode/sem") or context.size("p2", "carla_decode_hw")
    pixels = context.draw("carla_bgra", (*size, 4), "ints256")
    depth_m = muvo_files.DEPTH_RANGE_M * muvo_files.decode_depth(pixels[..., 2::-1])
    yield cases.Check("carla_decode/depth_m", depth_m, TOLERANCE)
    yield cases.Check("carla_decode/sem", pixels[..., 3], 0.0, golden.File.share_different)
    yield cases.Check("label_map", muvo_files.is_occupied(np.arange(23)).astype(np.uint8), 0.0)


def fused_voxels(context: cases.Context) -> Checks:
    size = context.size("p2", "voxel_depth_hw")
    depth, depth_tags = context.draw("vf_depth", size, "depth_m"), context.draw("vf_sem", size, "labels23")
    lidar = _cloud(context) * np.array([1.0, -1.0, 1.0]) - _SENSOR_M
    lidar_tags = context.draw("vf_lsem", (len(lidar),), "ints23")
    points, pixel = camera.reference_depth_points(depth, _FIELD_OF_VIEW_RAD, preprocess.CAMERA_POSITION_M)
    points = np.concatenate([points, _to_ego(lidar)])
    tags = np.concatenate([depth_tags.reshape(-1)[pixel], lidar_tags]).astype(np.uint8)
    keep = ~muvo_files.in_ego_box(points)
    points, tags = points[keep], tags[keep]
    yield cases.Check("merge/n", np.array(points.shape), 0.0)
    yield cases.Check("merge/points", points, TOLERANCE)
    yield cases.Check("merge/sem", tags[:, None], SHARE_TOLERANCE, golden.File.share_different)
    table = voxels.voxel_table(points, tags, _GRID, winning_tag=muvo_files.ROAD_LINE)
    yield cases.Check("voxel_filter/coords", table, SHARE_TOLERANCE, _voxels_apart)
    yield cases.Check("voxel_filter/sem", table, SHARE_TOLERANCE, _voxel_tags_apart)


def _numbers(coordinates: np.ndarray) -> np.ndarray:
    return np.ravel_multi_index(tuple(coordinates.astype(np.int64).T), _GRID.shape)


def _voxels_apart(file: golden.File, entry: str, table: np.ndarray) -> float:
    """Share of the voxels that only one of the two sides has."""
    want = _numbers(file[entry])
    return len(np.setxor1d(want, _numbers(table[:, :3]))) / len(want)


def _voxel_tags_apart(file: golden.File, entry: str, table: np.ndarray) -> float:
    """Share of the voxels of both sides that have another tag, where the nearest point is no matter of taste."""
    _, ours, theirs = np.intersect1d(_numbers(table[:, :3]), _numbers(file["voxel_filter/coords"]),
                                     assume_unique=True, return_indices=True)
    known = ~file["voxel_filter/label_ambiguous"][theirs]
    return float((table[ours, 3] != file[entry][theirs])[known].mean())


def point_histograms(context: cases.Context) -> Checks:
    cloud = _cloud(context, "histogram_points")
    for tag, ego_cell in _EGO_CELLS.items():
        for name, value in reference_data.histograms(cloud, ego_cell).items():
            yield cases.Check(f"hist_{tag}/{name}", value, TOLERANCE)
            yield cases.Check(f"hist_{tag}/{name}_rowsum", value.sum(axis=2), TOLERANCE)


def birdviews(context: cases.Context) -> Checks:
    draw = context.draw
    numbers = draw("bev_int", context.shape("bev/bin_to_int") or (500,), "ints256")
    bits = reference_data.to_bits(numbers, 8)
    yield cases.Check("bev/int_to_bin", bits, 0.0)
    yield cases.Check("bev/bin_to_int", reference_data.from_bits(bits), 0.0)
    masks = draw("bev_bin", (8, *(context.shape("bev/labels") or (24, 24))), "uniform") < 0.3
    masks[0] = True
    yield cases.Check("bev/labels", reference_data.birdview_classes(masks), 0.0)
    frames, *cells = context.shape("bev/labels_time") or (3, 12, 12)
    masks = draw("bev_bint", (frames, 8, *cells), "uniform") < 0.3
    yield cases.Check("bev/labels_time", reference_data.birdview_classes(masks, axis=1), 0.0)
    frames, *cells = context.shape("bev/route") or (2, 20, 20)
    raw = np.uint8(255) * draw("bev_raw", (frames, 15, *cells), "mask").astype(np.uint8)
    lights = np.array([0, *reference_data.LIGHT_VALUES], np.uint8)
    raw[:, reference_data.LIGHT_CHANNEL] = lights[draw("bev_light", (frames, *cells), "labels4")]
    processed, route = reference_data.birdview_masks(raw)
    yield cases.Check("bev/processed", processed, 0.0)
    yield cases.Check("bev/route", route, 0.0)
    tags = draw("bev_semimg", context.shape("bev/instance_mask") or (1, 30, 40), "labels23")
    mask = schema.instance_mask(muvo_files.known_classes(tags), muvo_files.CLASSES)
    yield cases.Check("bev/instance_mask", mask, 0.0)


def measurements(context: cases.Context) -> Checks:
    here, there = (np.array(place) + context.settings.gps_offset for place in (_GPS, _GPS_TARGET))
    commands = [reference_data.command_index(command) for command, _ in _COMMANDS_YAWS]
    yield cases.Check("gps/command", np.array(commands), 0.0)
    vectors = np.stack([reference_data.gps_vector(here, there, yaw) for _, yaw in _COMMANDS_YAWS])
    yield cases.Check("gps/vector", vectors, TOLERANCE)


GROUPS: tuple[cases.Group, ...] = (range_views, depth_images, fused_voxels, point_histograms, birdviews, measurements)
