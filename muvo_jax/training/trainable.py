"""Which parameters train (`train.trainable`), and what becomes of those that do not.

A frozen parameter gets no gradient, no moments and no update. A BatchNorm whose parameters are frozen works on its
running statistics and leaves them as they are, in training as in evaluation; dropout goes on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import fnmatch
import functools
import operator
from collections.abc import Iterable
from typing import Any

import jax
from flax import linen

from muvo_jax.nn import norm

EVERYTHING = "*"


def chosen(params: Any, patterns: str) -> Any:
    """Which parameters train, as a tree of bool like `params`.

    Args:
      params: nested dictionaries of arrays or shapes; camera/backbone/stem_conv/kernel is the path of one.
      patterns: separated by commas, with *, ? and [] as in file names. One fits what it names and all below. The last
        that fits a parameter decides: "!" in front freezes. Before the first, nothing trains, or everything where the
        first freezes.

    Raises:
      ValueError: for a pattern that fits no parameter, naming neighbours; where nothing is left to train.
    """
    listed = [text.strip() for text in patterns.split(",")]
    leaves, structure = jax.tree_util.tree_flatten_with_path(params)
    above = [_above(tuple(part.key for part in path)) for path, _ in leaves]
    trains = [listed[0].startswith("!")] * len(leaves)
    for text in listed:
        pattern = text.removeprefix("!")
        fits = [any(fnmatch.fnmatchcase(name, pattern) for name in names) for names in above]
        if not any(fits):
            raise ValueError(_unknown(pattern, above))
        trains = [text == pattern if fit else before for fit, before in zip(fits, trains, strict=True)]
    if not any(trains):
        raise ValueError(f"train.trainable={patterns}: nothing is left to train.")
    return jax.tree.unflatten(structure, trains)


def _above(path: tuple[str, ...]) -> list[str]:
    """The names of a parameter and of all that it is part of, outermost first."""
    return ["/".join(path[:length]) for length in range(1, len(path) + 1)]


def _unknown(pattern: str, above: Iterable[list[str]]) -> str:
    known = list(dict.fromkeys(name for names in above for name in names))
    near = difflib.get_close_matches(pattern, known, n=3)
    hint = f" Did you mean {' or '.join(near)}?" if near else ""
    parts = ", ".join(name for name in known if "/" not in name)
    return f"train.trainable: {pattern!r} fits no parameter of this model.{hint} Its parts are {parts}."


def _at(tree: Any, path: tuple[str, ...]) -> Any:
    return functools.reduce(operator.getitem, path, tree)


def split(params: Any, trains: Any) -> tuple[Any, Any]:
    """Two trees in the form of `params`, what trains and what is frozen; None stands where the other has the leaf."""
    return (jax.tree.map(lambda leaf, trained: leaf if trained else None, params, trains),
            jax.tree.map(lambda leaf, trained: None if trained else leaf, params, trains))


def merge(trained: Any, frozen: Any) -> Any:
    """The inverse of `split`."""
    return jax.tree.map(lambda one, other: other if one is None else one, trained, frozen,
                        is_leaf=lambda leaf: leaf is None)


def frozen_norms(trains: Any) -> contextlib.AbstractContextManager:
    """While this context lasts, BatchNorms that do not train are traced in evaluation mode."""
    if all(jax.tree.leaves(trains)):
        return contextlib.nullcontext()

    def intercept(call, args, options, context):
        if isinstance(context.module, norm.BatchNorm) and context.method_name == "__call__":
            x, mode, *mask = args
            if mode.train and not any(jax.tree.leaves(_at(trains, context.module.path))):
                args = (x, dataclasses.replace(mode, train=False), *mask)
        return call(*args, **options)

    return linen.intercept_methods(intercept)
