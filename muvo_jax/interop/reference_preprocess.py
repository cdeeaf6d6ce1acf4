"""What the reference does to a batch before the network sees it, for parity (NumPy, torch's layout [..., C, H, W]).

Our model normalises inside, and our labels are made in muvo_jax.objectives.labels; this follows the authors' order:
bytes to [0, 1], crop, labels at three scales, normalisation with ImageNet's statistics.
"""

from __future__ import annotations

import math

import numpy as np

CROP_LEFT_TOP_RIGHT_BOTTOM = (64, 138, 896, 458)
FIELD_OF_VIEW_DEG = 100.0  # of the model's configuration; the recordings were made with 110
CAMERA_POSITION_M = (1.0, 0.0, 2.0)
RANGE_SCALE_M = 50.0
BEV_CELLS, BEV_RESOLUTION_M, BEV_EGO_CELL = 48, 0.8, (8.0, 24.0)
BIRDVIEW_CELL_M, BIRDVIEW_AHEAD_CELLS = 0.2, 64  # the ego stands that far behind the middle of a bird's-eye label
INSTANCE_SIGMA_CELLS, IGNORED = 4.0, 255.0
SCALES = (1, 2, 4)
_MEAN = np.array([0.485, 0.456, 0.406], np.float32).reshape(3, 1, 1)
_STD = np.array([0.229, 0.224, 0.225], np.float32).reshape(3, 1, 1)


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    """float32 [3, 3] of an image of `size` (rows, columns), its centre being the principal point."""
    rows, columns = size
    focal = columns / (2.0 * math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2.0))
    return np.array([[focal, 0, columns / 2], [0, focal, rows / 2], [0, 0, 1]], np.float32)


def camera_to_ego() -> np.ndarray:
    """float32 [4, 4]: camera frame (right, down, forward) to ego frame (forward, left, up)."""
    x, y, z = CAMERA_POSITION_M
    return np.array([[0, 0, 1, x], [-1, 0, 0, y], [0, -1, 0, z], [0, 0, 0, 1]], np.float32)


def bev_intrinsics() -> np.ndarray:
    """float32 [3, 3]: metres in the ego frame to cells of the bird's-eye grid of the camera branch."""
    per_metre = 1.0 / BEV_RESOLUTION_M
    return np.array([[per_metre, 0, BEV_EGO_CELL[0]], [0, -per_metre, BEV_EGO_CELL[1]], [0, 0, 1]], np.float32)


def crop(image: np.ndarray) -> np.ndarray:
    """[..., H, W] -> [..., 320, 832], zeros where the window reaches beyond the image."""
    left, top, right, bottom = CROP_LEFT_TOP_RIGHT_BOTTOM
    rows, columns = image.shape[-2:]
    part = image[..., top:min(bottom, rows), left:min(right, columns)]
    missing = (bottom - top - part.shape[-2], right - left - part.shape[-1])
    return np.pad(part, [(0, 0)] * (image.ndim - 2) + [(0, count) for count in missing]) if any(missing) else part


def cropped_intrinsics(matrix: np.ndarray) -> np.ndarray:
    """Intrinsics [..., 3, 3] after `crop`."""
    out = np.array(matrix, np.float32)
    out[..., 0, 2] -= CROP_LEFT_TOP_RIGHT_BOTTOM[0]
    out[..., 1, 2] -= CROP_LEFT_TOP_RIGHT_BOTTOM[1]
    return out


def nearest(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resizes the last two axes; pixel i reads floor(i * old / new)."""
    rows, columns = (np.arange(new) * old // new for new, old in zip(size, array.shape[-2:], strict=True))
    return array[..., rows[:, None], columns[None]]


def halved_mean(image: np.ndarray) -> np.ndarray:
    """Bilinear halving of the last two axes without antialiasing: the mean of 2x2 pixels."""
    *lead, rows, columns = image.shape
    return image.reshape(*lead, rows // 2, 2, columns // 2, 2).mean(axis=(-3, -1), dtype=image.dtype)


def cascade(array: np.ndarray, halve) -> dict[int, np.ndarray]:
    """{scale: array}: each scale is half of the one before."""
    half = halve(array)
    return {1: array, 2: half, 4: halve(half)}


def halved_nearest(axes: int):
    """Returns a function that keeps every second entry of the last `axes` axes."""
    return lambda array: array[(..., *(slice(None, None, 2),) * axes)]


def normalise(image: np.ndarray) -> np.ndarray:
    """float32 [..., 3, H, W] in [0, 1] -> ImageNet statistics."""
    return (image - _MEAN) / _STD


def unit_range(image: np.ndarray) -> np.ndarray:
    """Bytes to float32 in [0, 1]."""
    return image.astype(np.float32) / np.float32(255.0)


def network_inputs(raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The camera, route and lidar inputs and their labels, by the reference's names ("rgb_label_2", ...).

    Args:
      raw: image and route_map uint8, range_view_pcd_xyzd in metres, voxel uint8, intrinsics; [B, S, ...].
    """
    image = crop(unit_range(raw["image"]))
    range_view = raw["range_view_pcd_xyzd"] / np.float32(RANGE_SCALE_M)
    out = {"image": normalise(image), "intrinsics": cropped_intrinsics(raw["intrinsics"]),
           "route_map": normalise(nearest(unit_range(raw["route_map"]), (64, 64))),
           "range_view_pcd_xyzd": range_view, "voxel": raw["voxel"]}
    for name, values in (("rgb_label", cascade(image, halved_mean)),
                         ("range_view_label", cascade(range_view, halved_nearest(2))),
                         ("voxel_label", cascade(raw["voxel"], halved_nearest(3)))):
        out |= {f"{name}_{scale}": value for scale, value in values.items()}
    return out


def birdview_labels(birdview: np.ndarray) -> dict[int, np.ndarray]:
    """Bird's-eye classes or instances [..., H, W], forward up, to {scale: [..., W, H]}, forward to the right."""
    return cascade(np.rot90(birdview, -1, axes=(-2, -1)), halved_nearest(2))


def centres_and_offsets(instances: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Where instances are, and where each of their pixels finds its centre.

    Args:
      instances: integers [B, S, 1, H, W], 0 for none.
      sigma: of the bumps, in pixels.

    Returns:
      float32 [B, S, 1, H, W], the largest exp(-(distance / sigma)**2) to a centre; and float32 [B, S, 2, H, W], rows
      and columns to the own centre, 255 where there is none. Centres are rounded half to even.
    """
    rows_columns = np.indices(instances.shape[-2:])
    centres = np.zeros(instances.shape, np.float32)
    offsets = np.full((*instances.shape[:2], 2, *instances.shape[-2:]), IGNORED, np.float32)
    for frame in np.ndindex(*instances.shape[:2]):
        plane = instances[frame][0]
        for instance in np.unique(plane[plane > 0]):
            mask = plane == instance
            centre = np.round(rows_columns[:, mask].astype(np.float32).mean(axis=1))
            away = centre[:, None, None] - rows_columns
            bump = np.exp(-np.square(away).sum(axis=0) / sigma**2)
            centres[frame][0] = np.maximum(centres[frame][0], bump)
            offsets[frame][:, mask] = away[:, mask]
    return centres, offsets


def optional_labels(raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The labels of heads that the released models lack, by the reference's names.

    Args:
      raw: birdview and instance [B, S, 1, cells, cells]; depth, image_instance_mask and semantic_image
        [B, S, 1, H, W] of the uncropped camera; range_view_pcd_seg [B, S, 1, rows, columns].
    """
    depth, mask, semantic = (crop(raw[name]) for name in ("depth", "image_instance_mask", "semantic_image"))
    instances = birdview_labels(raw["instance"])
    # The reference crops the depth that is already cropped, and calls that depth_color.
    out = {"birdview_label": birdview_labels(raw["birdview"])[1], "instance_label": instances[1], "depth": depth,
           "depth_color": crop(depth), "depth_mask": (depth < 0).astype(np.uint8), "image_instance_mask": mask,
           "semantic_image": semantic, "range_view_pcd_seg": raw["range_view_pcd_seg"]}
    for scale, instance in instances.items():
        centre, offset = centres_and_offsets(instance, INSTANCE_SIGMA_CELLS / scale)
        out |= {f"center_label_{scale}": centre, f"offset_label_{scale}": offset}
    out |= {"center_label": out["center_label_1"], "offset_label": out["offset_label_1"]}
    for name, labels in (("birdview_label", birdview_labels(raw["birdview"])), ("instance_label", instances),
                         ("depth_label", cascade(depth, halved_mean)),
                         ("image_instance_mask", cascade(mask, halved_nearest(2))),
                         ("semantic_image_label", cascade(semantic, halved_nearest(2))),
                         ("range_view_seg_label", cascade(raw["range_view_pcd_seg"], halved_nearest(2)))):
        out |= {f"{name}_{scale}": value for scale, value in labels.items()}
    return out


def out_of_view(image_size: tuple[int, int], cells: int) -> np.ndarray:
    """bool [cells, cells], forward up: what of a bird's-eye label no column of the cropped image looks at."""
    matrix = cropped_intrinsics(intrinsics(image_size))
    left, _, right, _ = CROP_LEFT_TOP_RIGHT_BOTTOM
    behind = int((cells / 2 - BIRDVIEW_AHEAD_CELLS) + CAMERA_POSITION_M[0] / BIRDVIEW_CELL_M)
    ahead_m = 0.01 + BIRDVIEW_CELL_M * np.arange(cells - behind)[::-1, None]
    right_m = BIRDVIEW_CELL_M * (np.arange(cells) - cells // 2)[None]
    column = right_m / ahead_m * matrix[0, 0] + matrix[0, 2]
    hidden = (column < 0) | (column >= right - left)
    return np.concatenate([hidden, np.ones((behind, cells), bool)])


def halved_antialiased(image: np.ndarray) -> np.ndarray:
    """Bilinear halving of the last two axes with antialiasing: weights 1, 3, 3, 1, rescaled at the borders."""
    for axis in (-2, -1):
        moved = np.moveaxis(image, axis, -1)
        padded = np.pad(moved, [(0, 0)] * (moved.ndim - 1) + [(1, 1)])
        count = np.pad(np.ones(moved.shape[-1], image.dtype), 1)
        half = moved.shape[-1] // 2
        weighted = lambda values, half=half: sum(weight * values[..., tap:tap + 2 * half:2]
                                                 for tap, weight in enumerate((1, 3, 3, 1)))
        image = np.moveaxis(weighted(padded) / weighted(count), -1, axis)
    return image
