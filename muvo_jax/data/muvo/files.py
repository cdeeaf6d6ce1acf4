"""The single files of a recording in the MUVO / MILE CARLA layout: what is in them and how to read them.

    image/image_000000012.png                      RGB, 8 bit
    depth_semantic/depth_semantic_000000012.png    R, G, B: depth, most significant byte first; A: semantic tag
    birdview/birdview_000000012.png                16 bit grey, a bit field of BIRDVIEW_BITS
    routemap/routemap_000000012.png                8 bit grey, 255 on the route
    points_semantic/points_semantic_000000012.npy  pickled dict: points_xyz float32 [N, 3] in the lidar's left-handed
                                                   frame (x forward, y right, z up), ObjTag unsigned [N]
    voxel/voxel_000000012.npy                      uint16 [M, 4]: ix, iy, iz, tag of the occupied voxels

Facts from the authors' repository (github.com/fzi-forschungszentrum-informatik/muvo, main).
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from muvo_jax import config as config_lib
from muvo_jax.data import files, pictures, schema
from muvo_jax.data.muvo import safe_pickle

KINDS = {"image": ".png", "depth_semantic": ".png", "birdview": ".png", "routemap": ".png", "points_semantic": ".npy",
         "voxel": ".npy"}
DEPTH_RANGE_M = 1000.0
_DEPTH_STEPS = 256 ** 3 - 1
BIRDVIEW_BITS = ("background", "road", "lane_marking", "vehicle", "pedestrian", "light_green", "light_yellow",
                 "light_red")
# What the lidar sees of its own car: |x| and |y| below the first two, z between 0 and the third (m, ego frame).
EGO_BOX_M = (2.451, 1.064, 1.511)
UNLABELLED, PEDESTRIAN, ROAD_LINE, VEHICLE, SKY = 0, 4, 6, 10, 13  # CARLA up to 0.9.13
UNKNOWN_TAG = 255
# What the layout's tags mean, in their order.
CLASSES = ("none", "building", "fence", "other", "pedestrian", "pole", "road line", "road", "sidewalk", "vegetation",
           "vehicle", "wall", "traffic sign", "sky", "ground", "bridge", "rail", "guard rail", "traffic light",
           "static", "dynamic", "water", "terrain")
BIRDVIEW_PX, BIRDVIEW_CELL_M = 192, 0.2
BIRDVIEW_BEHIND_PX = 32  # rows below the ego, which looks up and stands in the middle column
# What CARLA's tags from 0.9.14 on (the index) are in the layout's tags, those of 0.9.13; the rest is unlabelled.
LAYOUT_TAGS = np.zeros(256, np.uint8)
LAYOUT_TAGS[:29] = (0, 7, 8, 1, 11, 2, 5, 18, 12, 9, 22, 13, 4, 4, 10, 10, 10, 10, 10, 10, 19, 20, 3, 21, 6, 14, 15, 16,
                    17)


class Points(NamedTuple):
    """points_m float32 [N, 3], ego frame; tags uint8 [N], or None where the recording has none."""

    points_m: np.ndarray
    tags: np.ndarray | None


def file_name(kind: str, number: int) -> str:
    """Path of a frame's file, relative to the run."""
    return f"{kind}/{kind}_{number:09d}{KINDS[kind]}"


def is_occupied(tags: np.ndarray) -> np.ndarray:
    """Class 1 of the authors' label map: everything but unlabelled and sky. Tags above 22 (CARLA 0.9.14) count too."""
    return (tags != UNLABELLED) & (tags != SKY) & (tags != UNKNOWN_TAG)


def read_depth_semantic(path: pathlib.Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Returns the depth along the optical axis, float64 [H, W] in [0, 1] (1 is 1000 m: sky), and tags, uint8 [H, W].

    Args:
      size: (H, W) of the camera's images; any where it is not known.

    Raises:
      DataError: where the file is missing, damaged, has no four channels or another size.
    """
    pixels = _read(path, (None, None, 4))
    if size is not None and pixels.shape[:2] != size:
        raise schema.DataError(f"{path}: {pixels.shape[1]}x{pixels.shape[0]} pixels, but the camera's images have "
                               f"{size[1]}x{size[0]}; depth and classes must be those of the image. Record them with "
                               f"one size and field of view.")
    return decode_depth(pixels[..., :3]), pixels[..., 3]


def decode_depth(pixels: np.ndarray) -> np.ndarray:
    """uint8 [..., 3], most significant byte first, to float64 [...] in [0, 1]."""
    red, green, blue = (pixels[..., channel].astype(np.float64) for channel in range(3))
    return (red * 65536 + green * 256 + blue) / _DEPTH_STEPS


def encode_depth(depth_m: np.ndarray) -> np.ndarray:
    """Metres (beyond 1000 m or infinite: sky) to uint8 [..., 3], the inverse of `decode_depth`."""
    share = np.clip(np.where(np.isfinite(depth_m), depth_m, DEPTH_RANGE_M) / DEPTH_RANGE_M, 0.0, 1.0)
    steps = np.rint(share * _DEPTH_STEPS).astype(np.int64)
    return np.stack([steps >> 16, steps >> 8 & 255, steps & 255], axis=-1).astype(np.uint8)


def read_birdview(path: pathlib.Path) -> np.ndarray:
    """Returns the bit field, uint16 [BIRDVIEW_PX, BIRDVIEW_PX]; bit k is BIRDVIEW_BITS[k].

    Raises:
      DataError: where the file is missing, damaged, no grey image of whole numbers and this size, or has other bits.
    """
    pixels = _read(path, (BIRDVIEW_PX, BIRDVIEW_PX))
    if pixels.min() < 0 or pixels.max() >= 1 << len(BIRDVIEW_BITS):
        raise schema.DataError(f"{path}: its numbers reach from {pixels.min()} to {pixels.max()}, expected a field of "
                               f"{len(BIRDVIEW_BITS)} bits, one for each of {', '.join(BIRDVIEW_BITS)}. Write it as "
                               f"the authors' DataWriter does.")
    return pixels.astype(np.uint16)  # Pillow says int32 or uint16, depending on its version


def read_labels(paths: Mapping[str, pathlib.Path], grid: config_lib.VoxelGrid,
                translate: Callable[[np.ndarray, pathlib.Path], np.ndarray] | None = None,
                image_size: tuple[int, int] | None = None) -> schema.RawFrame:
    """The labels whose files are given: depth_m, image_classes, image_instance_mask and those of the bird's eye.

    The bird's-eye picture is looked up at the middle of each cell of the grid's ground plan: class 255 outside of it.

    Args:
      paths: of the files, by label.
      grid: its ground plan.
      translate: (tags, file) -> the layout's tags; by default they are the layout's.
      image_size: (H, W) of the camera's images, where there are any.

    Raises:
      DataError: where a file is missing, damaged or of another size.
    """
    frame: schema.RawFrame = {}
    camera = [paths[key] for key in ("depth_m", "image_classes", "image_instance_mask") if key in paths]
    if camera:  # one file
        share, tags = read_depth_semantic(camera[0], image_size)
        frame["depth_m"] = np.where(share < 1.0, share * DEPTH_RANGE_M, np.inf).astype(np.float32)
        frame["image_classes"] = known_classes(translate(tags, camera[0]) if translate else tags)
        frame["image_instance_mask"] = schema.instance_mask(frame["image_classes"], CLASSES)
    if "birds_eye_classes" in paths:
        bits = read_birdview(paths["birds_eye_classes"]).astype(np.uint32)
        # The highest bit that is set; 0 where none is.
        highest = np.frexp(np.maximum(bits, 1).astype(np.float64))[1].astype(np.uint8) - np.uint8(1)
        instances, _ = scipy.ndimage.label((bits >> 3 & 3) > 0)
        ahead_m, left_m = ((np.arange(grid.shape[axis]) + 0.5) * grid.voxel_size_m + grid.origin_m[axis]
                           for axis in range(2))
        row = np.floor(bits.shape[0] - BIRDVIEW_BEHIND_PX - ahead_m / BIRDVIEW_CELL_M).astype(np.intp)
        column = np.floor(bits.shape[1] / 2 - left_m / BIRDVIEW_CELL_M).astype(np.intp)
        inside = ((row >= 0) & (row < bits.shape[0]))[:, None] & ((column >= 0) & (column < bits.shape[1]))[None]
        place = (np.clip(row, 0, bits.shape[0] - 1)[:, None], np.clip(column, 0, bits.shape[1] - 1)[None])
        frame["birds_eye_classes"] = np.where(inside, highest[place], np.uint8(UNKNOWN_TAG))
        frame["birds_eye_instances"] = np.where(inside, instances[place], 0).astype(np.int32)
    return frame


def known_classes(tags: np.ndarray) -> np.ndarray:
    """Tags as indices into CLASSES, uint8; 255 for those that the layout does not know (CARLA 0.9.14)."""
    return np.where(tags < len(CLASSES), tags, UNKNOWN_TAG).astype(np.uint8)


def point_tags(scan: Points, path: pathlib.Path) -> np.ndarray:
    """uint8 [N], the tag of each point; raises DataError where the recording does not say."""
    if scan.tags is None:
        raise schema.DataError(f"{path}: its points have no tags (ObjTag), which the head semantic_range_view learns "
                               f"from. Leave the head out, or record a semantic lidar.")
    return scan.tags


def read_route_map(path: pathlib.Path) -> np.ndarray:
    """Returns the route from above as it is stored, uint8 [rows, columns], 255 on the route; raises DataError."""
    return pictures.read(path, "L")


def read_points(path: pathlib.Path, lidar_position_m: tuple[float, float, float]) -> Points:
    """Reads a scan into the ego frame (left-handed to right-handed), without what lies in the recording car's own box.

    Args:
      lidar_position_m: of the lidar in the ego frame.

    Raises:
      Refused: where the pickled dict asks for more than arrays.
      DataError: where the file is missing, damaged or holds no points, or tags beyond 255.
    """
    content = safe_pickle.load_npy(path)
    points_m = content.get("points_xyz") if isinstance(content, dict) else None
    if not isinstance(points_m, np.ndarray) or points_m.dtype.kind != "f" or points_m.shape[1:] != (3,):
        raise schema.DataError(f"{path}: expected a dict with points_xyz, floats [N, 3]; found "
                               f"{sorted(content) if isinstance(content, dict) else type(content).__name__}.")
    tags = content.get("ObjTag")
    if tags is not None and not (isinstance(tags, np.ndarray) and tags.dtype.kind == "u" and
                                 tags.shape == points_m.shape[:1]):
        raise schema.DataError(f"{path}: ObjTag is no array of {len(points_m)} unsigned numbers.")
    if tags is not None and tags.size and tags.max() > UNKNOWN_TAG:
        raise schema.DataError(f"{path}: ObjTag has {tags.max()}, expected CARLA's semantic tags, 0 to {UNKNOWN_TAG}. "
                               f"Write the tag of what each point hit, not the number of the object (ObjIdx).")
    finite = np.isfinite(points_m).all(axis=1)
    files.finite_points(points_m, path)
    ego_m = to_ego_frame(points_m, lidar_position_m)
    keep = finite & ~in_ego_box(ego_m)
    return Points(ego_m[keep], None if tags is None else tags[keep].astype(np.uint8))


def to_ego_frame(points_m: np.ndarray, lidar_position_m: tuple[float, float, float]) -> np.ndarray:
    """CARLA's lidar frame (x forward, y right, z up) to the ego frame (y left), float32 [N, 3]."""
    x, y, z = (np.float32(value) for value in lidar_position_m)
    ego_m = points_m.astype(np.float32) + np.array([[x, -y, z]], np.float32)
    ego_m[:, 1] *= -1
    return ego_m


def in_ego_box(points_m: np.ndarray) -> np.ndarray:
    """bool [N], the points strictly inside the recording car."""
    half_length, half_width, height = EGO_BOX_M
    x, y, z = points_m[:, 0], points_m[:, 1], points_m[:, 2]
    return (np.abs(x) < half_length) & (np.abs(y) < half_width) & (z > 0) & (z < height)


def read_voxels(path: pathlib.Path, grid: config_lib.VoxelGrid,
                translate: Callable[[np.ndarray, pathlib.Path], np.ndarray] | None = None) -> np.ndarray:
    """Returns occupancy, uint8 [X, Y, Z]: 1 where a voxel holds something that is_occupied, else 0.

    Args:
      translate: as of `read_labels`.

    Raises:
      Refused: where the file is pickled and asks for more than arrays.
      DataError: where it is missing, damaged, no table of four columns, or beyond the grid.
    """
    rows = safe_pickle.load_npy(path)
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "ui" or rows.ndim != 2 or rows.shape[1] != 4:
        raise schema.DataError(f"{path}: expected whole numbers [M, 4] (ix, iy, iz, tag); make the voxels again.")
    index = rows[:, :3].astype(np.int64)
    if (index < 0).any() or (index >= np.asarray(grid.shape)).any():
        raise schema.DataError(f"{path}: voxel {index[~((index >= 0) & (index < np.asarray(grid.shape))).all(1)][0]} "
                               f"lies outside a grid of {list(grid.shape)}. Describe the grid in sensors.toml.")
    occupancy = np.zeros(grid.shape, np.uint8)
    occupancy[tuple(index.T)] = is_occupied(translate(rows[:, 3], path) if translate else rows[:, 3])
    return occupancy


def _read(path: pathlib.Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """An image as it is stored, of whole numbers and of this shape (None: any)."""
    pixels = pictures.read(path, None)
    fits = len(shape) == pixels.ndim and all(map(lambda want, side: want in (None, side), shape, pixels.shape))
    if not fits or pixels.dtype.kind not in "ui":
        raise schema.DataError(f"{path}: an image {list(pixels.shape)} of {pixels.dtype}, expected "
                               f"{['any' if side is None else side for side in shape]} of whole numbers. Write it "
                               f"as the authors' DataWriter does.")
    return pixels
