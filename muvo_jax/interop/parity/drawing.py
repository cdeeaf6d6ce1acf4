"""Weights by the rule for single modules and whole models, and the way between torch's layout and ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.interop import names, weights_rule
from muvo_jax.model import heads
from muvo_jax.nn import norm

EVAL = norm.Mode()


def channels_last(array: np.ndarray, axis: int = 1) -> np.ndarray:
    """[..., C, *S] with C at `axis` -> [..., *S, C]"""
    return np.ascontiguousarray(np.moveaxis(array, axis, -1))


def channels_first(array: Any, axis: int = 1) -> np.ndarray:
    """[..., *S, C] -> [..., C, *S] with C at `axis`"""
    return np.moveaxis(np.asarray(array), -1, axis)


def draw_variables(shapes: Any, prefix: str = "", where: str = "",
                   rename: Callable[[str], str] | None = None) -> Any:
    """Variables of the given shapes, drawn by the rule.

    Args:
      shapes: {"params": ..., ...} as jax.eval_shape gives.
      prefix: of the reference's keys, such as "encoder.".
      where: place of the module in our network, such as "camera/neck/", which the names are translated from.
      rename: applied to each of the reference's keys.
    """
    def draw(path, leaf):
        ours = where + "/".join(part.key for part in path[1:])
        key = prefix + names.reference_key(ours)
        if rename is not None:
            key = rename(key)
        drawn = weights_rule.make_param(key, names.reference_shape(ours, leaf.shape))
        return np.ascontiguousarray(names.to_our_layout(ours.rsplit("/")[-1], leaf.shape, drawn), np.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def rounded_anew(variables: Any, tries: int = 32, size: float = 1e-7) -> Iterator[Any]:
    """The variables as rounding could have left them: times 1 + size N(0, 1).

    The noise of the packs was measured with 1e-7; what a deep network makes of its own rounding is about 1e-6.
    """
    return (_moved(variables, seed, size) for seed in range(tries))


def rounded_in_pairs(variables: Any, pairs: int = 8, size: float = 1e-5) -> Iterator[Any]:
    """The variables moved by 1 + size N(0, 1) and by 1 - size N(0, 1), in turns.

    In the mean of what a smooth function makes of a pair the move itself is gone, to 1e-10; what is left are two
    roundings that know nothing of each other, because the move is much larger than they are.
    """
    return (_moved(variables, seed, signed) for seed in range(pairs) for signed in (size, -size))


def _moved(variables: Any, seed: int, size: float) -> Any:
    normal = np.random.default_rng(seed).standard_normal
    return jax.tree.map(lambda leaf: np.asarray(leaf * (1.0 + size * normal(leaf.shape)), np.float32), variables)


def run(module, *args, prefix: str = "", where: str = "", rename: Callable[[str], str] | None = None,
        static: tuple = ()) -> Any:
    """Applies a module with drawn weights, jitted: module(*args, *static).

    Args:
      args: arrays.
      prefix, where, rename: see `draw_variables`.
      static: further arguments that are no arrays.
    """
    args = tuple(jnp.asarray(arg) if isinstance(arg, np.ndarray) else arg for arg in args)
    shapes = jax.eval_shape(lambda key, *inputs: module.init(key, *inputs, *static), jax.random.key(0), *args)
    variables = draw_variables(shapes, prefix, where, rename)
    return jax.jit(lambda variables, *inputs: module.apply(variables, *inputs, *static))(variables, *args)


def birds_eye_entries(prefix: str, scales: Mapping[int, jax.Array], axis: int) -> Iterator[tuple[str, np.ndarray]]:
    """The reference's three outputs for each scale of our head "birds_eye", channels at `axis`."""
    classes = heads.BIRDS_EYE_CLASSES
    parts = {"segmentation": slice(0, classes), "instance_offset": slice(classes, classes + 2),
             "instance_center": slice(classes + 2, classes + 3)}
    for scale, value in scales.items():
        for name, channels in parts.items():
            yield f"{prefix}/bev_{name}_{scale}", channels_first(value[..., channels], axis)
