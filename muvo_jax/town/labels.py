"""What is known of a moment in the town beside what the sensors show.

Which pixels and voxels moving road users cover is in every recording, as camera depth and classes are: scores are told
apart by it. What optional heads learn, the class of every lidar point and the ground plan from above, is recorded only
where a head asks for it (TownConfig.labels).
"""

from __future__ import annotations

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.town import boxes as box_lib
from muvo_jax.town import ground as ground_lib
from muvo_jax.town import raycast

# Of config.BIRDS_EYE_CLASSES; the town has no traffic lights.
_ROAD, _MARKING, _VEHICLE, _PEDESTRIAN = 1, 2, 3, 4


def ray_classes(fan: raycast.Fan, hits: raycast.Hits, origin_m: np.ndarray, yaw_rad: float, boxes: box_lib.Boxes,
                ground: ground_lib.Ground) -> np.ndarray:
    """uint8 [rows, columns], index into boxes.CLASSES of what each ray met."""
    found = hits.box
    classes = np.full(found.shape, box_lib.SKY, np.uint8)
    on_ground = found == raycast.GROUND
    azimuth_rad = np.broadcast_to((fan.azimuths_rad + yaw_rad)[:, None], found.shape)[on_ground]
    direction = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1).astype(np.float32)
    places_m = origin_m[None, :2].astype(np.float32) + direction * hits.distance_m[on_ground][:, None]
    classes[on_ground] = ground_lib.look_up(ground, places_m, np.full(len(places_m), ground_lib.CELL_M, np.float32))[1]
    solid = found >= 0
    classes[solid] = box_lib.CLASS_OF_MATERIAL[boxes.material[found[solid]]]
    return np.ascontiguousarray(classes.T)


def ground_plan(pose: np.ndarray, boxes: box_lib.Boxes, ground: ground_lib.Ground,
                grid: config_lib.VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Classes (uint8) and instances (int32, from 1; 0 none) at the middle of each cell [X, Y] of the ego's ground plan.

    Vehicles and pedestrians lie on top of markings, these on top of roads; all else is class 0.
    """
    ahead_m, left_m = ((np.arange(grid.shape[axis]) + 0.5) * grid.voxel_size_m + grid.origin_m[axis]
                       for axis in range(2))
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    places_m = np.stack([pose[0] + cosine * ahead_m[:, None] - sine * left_m[None],
                         pose[1] + sine * ahead_m[:, None] + cosine * left_m[None]], axis=-1).astype(np.float32)
    flat_m = places_m.reshape(-1, 2)
    beneath = ground_lib.look_up(ground, flat_m, np.full(len(flat_m), ground_lib.CELL_M, np.float32))[1]
    classes = np.zeros(len(flat_m), np.uint8)
    classes[beneath == box_lib.ROAD], classes[beneath == box_lib.MARKING] = _ROAD, _MARKING
    instances = np.zeros(len(flat_m), np.int32)
    reach_m = float(np.abs(places_m - np.asarray(pose[:2], np.float32)[None, None]).max()) + 5.0
    near = np.abs(boxes.centre_m - np.asarray(pose[:2], np.float32)[None]).max(axis=1) < reach_m
    count = 0
    for kind, material in ((_VEHICLE, box_lib.CAR_BODY), (_PEDESTRIAN, box_lib.PERSON)):
        for index in np.flatnonzero(near & (boxes.material == material)):
            away_m, forward, half_m = flat_m - boxes.centre_m[index][None], boxes.heading[index], boxes.half_m[index]
            along_m, across_m = away_m @ forward, away_m @ np.array([-forward[1], forward[0]], np.float32)
            inside = (np.abs(along_m) <= half_m[0]) & (np.abs(across_m) <= half_m[1])
            if inside.any():
                count += 1
                classes[inside], instances[inside] = kind, count
    return classes.reshape(grid.shape[:2]), instances.reshape(grid.shape[:2])


def moving_pixels(hits: raycast.Hits, first: int, moves: np.ndarray) -> np.ndarray:
    """bool [rows, columns], whether a ray met a road user on the move.

    Args:
      hits: of the camera.
      first: number of the box that `moves` [M] begins with.
    """
    known = np.append(moves, False)  # the last place is for rays that met anything else
    index = hits.box - first
    return np.ascontiguousarray(known[np.where(index >= 0, index, len(moves))].T)


def moving_voxels(pose: np.ndarray, movers: box_lib.Boxes, grid: config_lib.VoxelGrid) -> np.ndarray:
    """bool [X, Y, Z], the voxels of the ego's grid whose middle is in one of the boxes or within a voxel of it.

    The voxel around them belongs to it, lest filling the neighbourhood of a road user cost nothing.
    """
    mask = np.zeros(grid.shape, bool)
    side_m = grid.voxel_size_m
    ahead_m, left_m, up_m = ((np.arange(grid.shape[axis]) + 0.5) * side_m + grid.origin_m[axis] for axis in range(3))
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cosine, -sine], [sine, cosine]])
    centre_m = (movers.centre_m - pose[None, :2]) @ turn
    heading = movers.heading @ turn
    reach_m = np.hypot(*grid.shape[:2]) * side_m
    for index in np.flatnonzero(np.hypot(centre_m[:, 0], centre_m[:, 1]) < reach_m):
        ahead, left = ahead_m[:, None] - centre_m[index, 0], left_m[None] - centre_m[index, 1]
        along_m = np.abs(ahead * heading[index, 0] + left * heading[index, 1])
        across_m = np.abs(left * heading[index, 0] - ahead * heading[index, 1])
        covered = (along_m <= movers.half_m[index, 0] + side_m) & (across_m <= movers.half_m[index, 1] + side_m)
        height = (up_m >= movers.z_m[index, 0] - side_m) & (up_m <= movers.z_m[index, 1] + side_m)
        mask |= covered[..., None] & height
    return mask
