"""The rule that draws the weights and inputs of parity packs from names, shapes and a seed (NumPy only).

The numbers in a pack come from running the authors' PyTorch code; neither weights nor inputs are stored, because both
sides draw them. Arrays are in torch's layout: dense (out, in), convolution (out, in, *K), transposed convolution
(in, out, *K), GRU gates in the order r, z, n, attention projections q, k, v.

Each array has its own stream, NumPy's PCG64 seeded with the CRC-32 of the state_dict key (weights) or of
"name|kind|seed" (inputs). Draws are in float64 and cast at the end; inputs use +, -, *, /, sqrt, floor, comparisons and
gathers only, so that no maths library changes them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable

import numpy as np

Shape = tuple[int, ...]
COMPUTED_BUFFERS = ("bev_intrinsics", "image_mean", "image_std")  # the model computes them; they are never drawn


def _stream(text: str) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(zlib.crc32(text.encode())))


def param_kind(key: str, shape: Shape) -> str:
    """Which rule draws one state_dict entry, from its key and shape alone."""
    leaf = key.split(".")[-1]
    fixed = {"num_batches_tracked": "zero_int", "running_mean": "bn_mean", "running_var": "bn_var"}
    if leaf in COMPUTED_BUFFERS:
        return "computed_buffer"
    if leaf in fixed:
        return fixed[leaf]
    if (leaf in ("type_embedding", "type_embeddings", "constant_tensor") or leaf.startswith("query_embed")
            or key.endswith(("command_encoder.0.weight", "command_next_encoder.0.weight"))):
        return "embedding"
    if len(shape) < 2:
        return "norm_weight" if leaf == "weight" else "bias"
    kernel = tuple(shape[2:])
    if ("transpose_conv" in key or "trans_conv" in key) and len(kernel) >= 2 and set(kernel) != {3}:
        # Stride 2 with a square kernel, or stride 1 on a single pixel, where the kernel is the size of the output.
        return "tconv_stride2" if len(set(kernel)) == 1 and kernel[0] in (4, 5, 6) else "tconv_seed"
    return "weight"


def make_param(key: str, shape: Shape) -> np.ndarray:
    """One state_dict entry: float32 (int64 for a counter) of `shape`.

    Raises:
      ValueError: for a buffer that the model computes itself.
    """
    shape = tuple(int(size) for size in shape)
    kind, stream = param_kind(key, shape), _stream(key)
    if kind == "computed_buffer":
        raise ValueError(f"{key} is computed by the model from its configuration, not drawn.")
    if kind == "zero_int":
        return np.zeros(shape, np.int64)
    if kind == "bn_var":
        return np.asarray(0.5 + stream.random(shape), np.float32)
    normal = stream.standard_normal(shape)
    if kind == "norm_weight":
        return np.asarray(1.0 + 0.1 * normal, np.float32)
    scale = {"bn_mean": 0.1, "embedding": 0.5, "bias": 0.02}
    if kind in scale:
        return np.asarray(scale[kind] * normal, np.float32)
    fan = {"weight": lambda: math.prod(shape[1:]), "tconv_seed": lambda: shape[0],
           "tconv_stride2": lambda: shape[0] * math.prod(shape[2:]) / 2 ** (len(shape) - 2)}[kind]()
    return np.asarray(normal / math.sqrt(fan), np.float32)


def make_input(name: str, shape: Shape, kind: str, seed: int = 0) -> np.ndarray:
    """One input.

    | kind | values |
    |---|---|
    | normal, uniform, pm1 | N(0, 1), U[0, 1), U[-1, 1), float32 |
    | speed, sigma | U[0, 15) m/s, 0.15 + 1.7 U[0, 1), float32 |
    | smooth, smooth_pm1 | low-frequency fields over the last two axes in [0, 1], [-1, 1], float32 |
    | image_u8, route_u8 | smooth field with rectangles; one 0/255 map copied to the 3 channels, uint8 |
    | range_view | [..., 4, h, w]: x, y, z, distance in metres, about 20 % empty (0, 0, 0, -1), float32 |
    | voxel2, voxel9, with _ign | boxes of classes; _ign adds boxes of 255, uint8 |
    | labels<K>, instance<K>, mask | rectangles of ids (int64), of True |
    | cloud | [n, 3] points, metres, float64 |
    | ints<K> | U{0..K-1}, int64 |
    | depth_m | smooth depth of 2 to 60 m with rectangles, some at 1000 m, float64 |

    Raises:
      ValueError: for another kind.
    """
    shape = tuple(int(size) for size in shape)
    stream = _stream(f"{name}|{kind}|{seed}")
    if kind in _FIELDS:
        return _FIELDS[kind](stream, shape).astype(np.float32)
    if kind in _ARRAYS:
        return _ARRAYS[kind](stream, shape)
    if kind.startswith("voxel"):
        return _voxels(stream, shape, int(kind[5]), kind.endswith("_ign"))
    for prefix in ("labels", "instance"):
        if kind.startswith(prefix):
            classes = int(kind[len(prefix):])
            return _labels(stream, shape, classes)
    if kind.startswith("ints"):
        return stream.integers(0, int(kind[4:]), shape)
    raise ValueError(f"make_input: got kind {kind!r}, expected one of the table in its documentation.")


def _stretch(coarse: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Linear interpolation of one axis to `size` samples, end points kept."""
    count = coarse.shape[axis]
    if size == 1 or count == 1:
        return np.repeat(np.take(coarse, [0], axis), size, axis)
    position = np.arange(size, dtype=np.float64) * (count - 1) / (size - 1)
    lower = np.minimum(np.floor(position).astype(np.int64), count - 2)
    share = (position - lower).reshape([size if i == axis % coarse.ndim else 1 for i in range(coarse.ndim)])
    return np.take(coarse, lower, axis) * (1.0 - share) + np.take(coarse, lower + 1, axis) * share


def _smooth(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    *leading, rows, columns = shape
    out: np.ndarray = np.zeros(())
    for knots, amplitude in ((3, 0.5), (7, 0.3), (15, 0.2)):
        coarse = stream.random((*leading, min(knots, rows), min(knots + 2, columns)))
        out = out + amplitude * _stretch(_stretch(coarse, rows, -2), columns, -1)
    return out


def _rectangles(stream: np.random.Generator, array: np.ndarray, count: int,
                value: Callable[[np.random.Generator], float]) -> np.ndarray:
    """Paints rectangles of drawn values on the last two axes of every leading slice, in place."""
    rows, columns = array.shape[-2:]
    for plane in array.reshape(-1, rows, columns):
        for _ in range(count):
            high, wide = (1 + int(stream.integers(max(1, side // 4))) for side in (rows, columns))
            top, left = int(stream.integers(rows - high + 1)), int(stream.integers(columns - wide + 1))
            plane[top:top + high, left:left + wide] = value(stream)
    return array


def _labels(stream: np.random.Generator, shape: Shape, classes: int) -> np.ndarray:
    return _rectangles(stream, np.zeros(shape, np.int64), 4 * classes, lambda random: int(random.integers(classes)))


def _box(stream: np.random.Generator, sides: Shape, divisor: int) -> tuple[slice, ...]:
    size = [1 + int(stream.integers(max(1, side // divisor))) for side in sides]
    start = [int(stream.integers(side - extent + 1)) for side, extent in zip(sides, size, strict=True)]
    return tuple(slice(a, a + n) for a, n in zip(start, size, strict=True))


def _voxels(stream: np.random.Generator, shape: Shape, classes: int, unknown: bool) -> np.ndarray:
    """Boxes of classes in an empty grid with a ragged ground plane; three boxes of 255 where `unknown`."""
    sides = shape[-3:]
    out = np.zeros(shape, np.uint8)
    for grid in out.reshape(-1, *sides):
        ground = stream.random(sides[:2]) < 0.5
        grid[:, :, sides[2] // 5] = ground * (1 if classes == 2 else 1 + stream.integers(0, 2, sides[:2]))
        for _ in range(56):
            where = _box(stream, sides, 8)
            grid[where] = 1 + int(stream.integers(classes - 1))
        for _ in range(3 if unknown else 0):
            grid[_box(stream, sides, 6)] = 255
    return out


def _cloud(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    """[n, 3] metres: ground 50 %, faces of boxes 35 %, far clutter 10 %, exact duplicates of earlier points 5 %."""
    count = shape[0]
    duplicates, far, on_boxes = count // 20, count // 10, (count * 35) // 100
    on_ground = count - duplicates - far - on_boxes
    columns = lambda *values: np.stack(values, 1)
    spread = lambda n, width: stream.random(n) * width - width / 2
    ground = columns(spread(on_ground, 120), spread(on_ground, 120), 0.05 * stream.standard_normal(on_ground))
    boxes = 30
    centre = columns(spread(boxes, 80), spread(boxes, 80), stream.random(boxes) * 2)
    extent = columns(1 + stream.random(boxes) * 4, 1 + stream.random(boxes) * 2, 1 + stream.random(boxes) * 5)
    which = stream.integers(0, boxes, on_boxes)
    box_points = centre[which] + extent[which] * (stream.random((on_boxes, 3)) - 0.5)
    clutter = columns(spread(far, 200), spread(far, 200), stream.random(far) * 30 - 5)
    points = np.concatenate([ground, box_points, clutter], 0)
    points = points[stream.permutation(points.shape[0])]
    return np.concatenate([points, points[stream.integers(0, points.shape[0], duplicates)]], 0)


def _image(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    image = np.floor(_smooth(stream, shape) * 256).astype(np.uint8)
    return _rectangles(stream, image, 6, lambda random: int(random.integers(256)))


def _route(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    route = _rectangles(stream, np.zeros(shape[:-3] + shape[-2:], np.uint8), 5, lambda _: 255)
    return np.repeat(route[..., None, :, :], shape[-3], axis=-3)


def _range_view(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    field = _smooth(stream, (*shape[:-3], 3, *shape[-2:]))
    xyz = (field - 0.5) * np.array([100.0, 100.0, 12.0]).reshape(3, 1, 1)
    distance = np.sqrt(xyz[..., 0, :, :] ** 2 + xyz[..., 1, :, :] ** 2 + xyz[..., 2, :, :] ** 2)
    empty = stream.random(distance.shape) < 0.2
    xyz, distance = np.where(empty[..., None, :, :], 0.0, xyz), np.where(empty, -1.0, distance)
    return np.concatenate([xyz, distance[..., None, :, :]], -3)


def _depth(stream: np.random.Generator, shape: Shape) -> np.ndarray:
    depth = 2 + 58 * _smooth(stream, shape)
    _rectangles(stream, depth, 12, lambda random: 3 + 40 * float(random.random()))
    return _rectangles(stream, depth, 3, lambda _: 1000.0)


_FIELDS: dict[str, Callable[[np.random.Generator, Shape], np.ndarray]] = {
    "normal": lambda stream, shape: stream.standard_normal(shape),
    "uniform": lambda stream, shape: stream.random(shape),
    "pm1": lambda stream, shape: 2 * stream.random(shape) - 1,
    "speed": lambda stream, shape: 15 * stream.random(shape),
    "sigma": lambda stream, shape: 0.15 + 1.7 * stream.random(shape),
    "smooth": _smooth,
    "smooth_pm1": lambda stream, shape: 2 * _smooth(stream, shape) - 1,
    "range_view": _range_view,
}
_ARRAYS: dict[str, Callable[[np.random.Generator, Shape], np.ndarray]] = {
    "image_u8": _image,
    "route_u8": _route,
    "mask": lambda stream, shape: _rectangles(stream, np.zeros(shape, bool), 5, lambda _: True),
    "cloud": _cloud,
    "depth_m": _depth,
}
