"""Weights by the rule for single modules and whole models, and the way between torch's layout and ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import names, weights_rule
from muvo_jax.interop.parity import cases, rounding
from muvo_jax.model import decoders
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


def run(module, *args, prefix: str = "", where: str = "", rename: Callable[[str], str] | None = None,
        static: tuple = ()) -> Any:
    """Applies a module with drawn weights, jitted: module(*args, *static).

    Args:
      args: arrays.
      prefix, where, rename: see `draw_variables`.
      static: further arguments that are no arrays.
    """
    variables, apply = prepared(module, *args, prefix=prefix, where=where, rename=rename, static=static)
    return apply(variables)


def prepared(module, *args, prefix: str = "", where: str = "", rename: Callable[[str], str] | None = None,
             static: tuple = ()) -> tuple[Any, Callable[[Any], Any]]:
    """Drawn weights of a module, and the function that `run` applies to them. Arguments as there."""
    args = tuple(jnp.asarray(arg) if isinstance(arg, np.ndarray) else arg for arg in args)
    shapes = jax.eval_shape(lambda key, *inputs: module.init(key, *inputs, *static), jax.random.key(0), *args)
    variables = draw_variables(shapes, prefix, where, rename)
    apply = jax.jit(lambda variables, *inputs: module.apply(variables, *inputs, *static))
    return variables, lambda variables: apply(variables, *args)


def action_check(entry: str, module: decoders.ActionDecoder, features: np.ndarray, where: str,
                 tolerance: float) -> cases.Check:
    """Of an action of a decoder with drawn weights."""
    variables, apply = prepared(module, features, where=where)
    roundings = lambda: (apply(moved)[1] for moved in rounding.in_pairs(variables))
    return cases.Check(entry, apply(variables)[1], tolerance, roundings=roundings)


def birds_eye_entries(prefix: str, scales: Mapping[int, jax.Array], axis: int) -> Iterator[tuple[str, np.ndarray]]:
    """The reference's three outputs for each scale of our head "birds_eye", channels at `axis`."""
    classes = config_lib.BIRDS_EYE_CLASSES
    parts = {"segmentation": slice(0, classes), "instance_offset": slice(classes, classes + 2),
             "instance_center": slice(classes + 2, classes + 3)}
    for scale, value in scales.items():
        for name, channels in parts.items():
            yield f"{prefix}/bev_{name}_{scale}", channels_first(value[..., channels], axis)
