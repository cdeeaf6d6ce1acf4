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
