"""The ego vehicle's sensors: camera (colour, depth, classes), lidar points, route map, and the occupancy target.

Camera and lidar sit at the same place, level, so that both are fans of rays for raycast.cast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import range_view as range_ops
from muvo_jax.ops import voxels as voxel_ops
from muvo_jax.town import boxes as box_lib
from muvo_jax.town import ground as ground_lib
from muvo_jax.town import labels, raycast, settings, shading

ROUTE_MAP_PX = 64
ROUTE_MAP_EGO_ROW = 48
ROUTE_MAP_M_PER_PX = 0.75
# Rays to the sky are known to be free this far.
FREE_M = 100.0


class Renderer:
    """Renders one town with one set of sensors; holds what does not change from frame to frame.

    Attributes:
      intrinsics: float32 [3, 3]; camera_to_ego: float32 [4, 4].
    """

    def __init__(self, config: settings.TownConfig, ground: ground_lib.Ground, scenery: box_lib.Boxes):
        self.config, self.ground, self.scenery = config, ground, scenery
        height, width = config.camera_height_px, config.camera_width_px
        self.intrinsics = camera_ops.intrinsics_from_fov(width, height, config.camera_fov_rad)
        self.camera_to_ego = camera_ops.level_camera_to_ego(config.lidar.position_m)
        right = (np.arange(width) + 0.5 - self.intrinsics[0, 2]) / self.intrinsics[0, 0]
        down = (np.arange(height) + 0.5 - self.intrinsics[1, 2]) / self.intrinsics[1, 1]
        # Horizontal distance per metre of depth, by column.
        self._stretch = np.hypot(1, right).astype(np.float32)
        slopes = (-down[None] / self._stretch[:, None]).astype(np.float32)
        self.camera_fan = raycast.Fan(-np.arctan(right), slopes,
                                      np.full(slopes.shape, config.camera_range_m, np.float32))
        yaw_rad, elevation_rad = range_ops.beam_angles(config.lidar)
        shape = (len(yaw_rad), len(elevation_rad))
        self.lidar_fan = raycast.Fan(
            yaw_rad, np.broadcast_to(np.tan(elevation_rad), shape).astype(np.float32),
            np.broadcast_to(config.lidar_range_m * np.cos(elevation_rad), shape).astype(np.float32))
        self._camera_rays = np.stack(np.broadcast_arrays(1.0, -right[None], -down[:, None]), -1).astype(np.float32)
        self._strides = _carving_strides(config, float(self.intrinsics[0, 0]))

    def render(self, pose: np.ndarray, moving: box_lib.Boxes, moves: np.ndarray, weather: settings.Weather,
               noise_seed: list[int]) -> dict[str, np.ndarray]:
        """Renders a moment.

        Args:
          pose: [3], x, y, yaw of the ego origin in the frame of the map.
          moving: everything beside the scenery.
          moves: bool [len(moving)], which of it is a road user on the move now (shadows are none).
          weather: the light.
          noise_seed: what rain streaks and sensor noise are drawn from.

        Returns:
          image uint8 [H, W, 3]; depth_m float32 [H, W] along the optical axis, infinite in the sky; classes uint8
          [H, W], indices into boxes.CLASSES; range_view float32 [rows, columns, 4] as in muvo_jax.types.Batch, and
          points_m float32 [N, 3], its returns (ego frame); image_moving_mask bool [H, W] and occupancy_moving_mask bool
          [X, Y, Z], see labels.moving_pixels and moving_voxels. With TownConfig.labels also point_tags uint8 [N], the
          class of each point, and birds_eye_classes and birds_eye_instances [X, Y], see labels.ground_plan.
        """
        x, y, yaw_rad = (float(value) for value in pose)
        cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
        mount = self.config.lidar.position_m
        origin_m = np.array([x + cosine * mount[0] - sine * mount[1], y + sine * mount[0] + cosine * mount[1],
                             mount[2]])
        reach_m = max(self.config.camera_range_m, self.config.lidar_range_m) + 10
        near = np.abs(self.scenery.centre_m - origin_m[None, :2].astype(np.float32)).max(1) < reach_m
        boxes = box_lib.join([self.scenery.take(near), moving])
        hits = raycast.cast(self.camera_fan, origin_m, yaw_rad, boxes)
        image, classes = shading.shade(self.camera_fan, hits, origin_m, yaw_rad, boxes, self.ground, weather,
                                       float(self.intrinsics[0, 0]), np.random.default_rng([*noise_seed, 11]))
        scan = raycast.cast(self.lidar_fan, origin_m, yaw_rad, boxes)
        view = self._range_view(scan)
        seen = {"image": image, "depth_m": np.ascontiguousarray((hits.distance_m / self._stretch[:, None]).T),
                "classes": classes, "range_view": view, "points_m": range_ops.to_points(view),
                "image_moving_mask": labels.moving_pixels(hits, len(boxes) - len(moving), moves),
                "occupancy_moving_mask": labels.moving_voxels(pose, moving.take(moves), self.config.voxels)}
        if self.config.labels:
            tags = labels.ray_classes(self.lidar_fan, scan, origin_m, yaw_rad, boxes, self.ground)
            seen["point_tags"] = tags[view[..., 3] > 0.0]
            seen["birds_eye_classes"], seen["birds_eye_instances"] = labels.ground_plan(pose, boxes, self.ground,
                                                                                        self.config.voxels)
        return seen

    def occupancy(self, seen: Mapping[str, Any]) -> np.ndarray:
        """The occupancy target from fused depth map and lidar points, uint8 [X, Y, Z] with 0, 1 and 255 (unknown).

        All points occupy; the rays that carve are thinned to just under a voxel apart at the border of the grid.
        """
        config, (camera_stride, row_stride, column_stride) = self.config, self._strides
        mount_m = np.asarray(config.lidar.position_m, np.float32)
        depth_m = seen["depth_m"]
        points_m = camera_ops.depth_to_points(depth_m, self.intrinsics, self.camera_to_ego)
        thin = (slice(None, None, camera_stride),) * 2
        rays = self._camera_rays[thin] * np.minimum(depth_m[thin], FREE_M)[..., None] + mount_m
        scan = seen["range_view"][::row_stride, ::column_stride]
        beams = range_ops.beam_directions(config.lidar)[::row_stride, ::column_stride]
        free = beams[scan[..., 3] < 0] * np.float32(config.lidar_range_m) + mount_m
        ends_m = np.concatenate([rays.reshape(-1, 3), range_ops.to_points(scan), free])
        empty = voxel_ops.carve(mount_m, ends_m, config.voxels)
        occupied = voxel_ops.voxelize(np.concatenate([points_m, seen["points_m"]]), config.voxels)
        return np.where(occupied > 0, np.uint8(voxel_ops.OCCUPIED),
                        np.where(empty, np.uint8(voxel_ops.EMPTY), np.uint8(voxel_ops.UNKNOWN)))

    def _range_view(self, scan: raycast.Hits) -> np.ndarray:
        """The range view that range_view.project would make of the lidar's points: beams are pixel centres."""
        distance_m = scan.distance_m.T
        hit = np.isfinite(distance_m)
        distance_m = np.where(hit, distance_m, 0)
        mount_m = np.asarray(self.config.lidar.position_m, np.float32)
        view = np.empty((*distance_m.shape, 4), np.float32)
        for axis, direction in enumerate((np.cos(self.lidar_fan.azimuths_rad)[None],
                                          np.sin(self.lidar_fan.azimuths_rad)[None], self.lidar_fan.slopes.T)):
            view[..., axis] = np.where(hit, distance_m * direction.astype(np.float32) + mount_m[axis], 0)
        view[..., 3] = np.where(hit, distance_m * np.hypot(1, self.lidar_fan.slopes.T), range_ops.NO_RETURN_M)
        return view


def draw_route(route_m: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Draws route points (frame of the map) from above, uint8 [64, 64]: 255 on the route, the ego vehicle in row 48,
    looking up, 0.75 m a pixel."""
    picture = np.zeros((ROUTE_MAP_PX, ROUTE_MAP_PX), np.uint8)
    dense = np.concatenate([route_m, 0.5 * (route_m[1:] + route_m[:-1])])
    offset = dense - pose[None, :2]
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    ahead, left = offset[:, 0] * cosine + offset[:, 1] * sine, offset[:, 1] * cosine - offset[:, 0] * sine
    row = np.floor(ROUTE_MAP_EGO_ROW - ahead / ROUTE_MAP_M_PER_PX).astype(int)
    column = np.floor(ROUTE_MAP_PX / 2 - left / ROUTE_MAP_M_PER_PX).astype(int)
    for row_shift in (-1, 0, 1):
        for column_shift in (-1, 0, 1):
            rows, columns = row + row_shift, column + column_shift
            inside = (rows >= 0) & (rows < ROUTE_MAP_PX) & (columns >= 0) & (columns < ROUTE_MAP_PX)
            picture[rows[inside], columns[inside]] = 255
    return picture


def _carving_strides(config: settings.TownConfig, focal_px: float) -> tuple[int, int, int]:
    """Steps in camera pixels, lidar rows and lidar columns that keep carving rays within a voxel of each other."""
    border_m = 0.5 * max(config.voxels.shape[0], config.voxels.shape[1]) * config.voxels.voxel_size_m
    spacing_rad = 0.9 * config.voxels.voxel_size_m / border_m
    row_rad = (config.lidar.elevation_max_rad - config.lidar.elevation_min_rad) / config.lidar.rows
    column_rad = 2 * np.pi / config.lidar.columns
    camera, row, column = (max(1, int(spacing_rad / step_rad)) for step_rad in (1 / focal_px, row_rad, column_rad))
    return camera, row, column
