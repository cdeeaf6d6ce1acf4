"""Frozen dataclasses from JSON and back: checked field by field, with the nearest known name in every refusal."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from muvo_jax.limits import RangeError


def check_choice(what: str, value: str, known: tuple[str, ...]) -> None:
    """Raises ValueError where `value` is none of `known`, naming the nearest ones."""
    if value in known:
        return
    near = difflib.get_close_matches(str(value), known, n=2)
    hint = f" Did you mean {' or '.join(near)}?" if near else ""
    raise ValueError(f"{what}: {value!r} is unknown; known are {', '.join(known)}.{hint}")


def parse(cls, values: dict[str, Any], path: str):
    """Builds the config dataclass `cls` from parsed JSON or TOML; `path` names the source in messages.

    Raises:
      ValueError: for an unknown field (naming the nearest known one), a value of the wrong type or out of its range.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{path}: got {values!r}, expected the fields of {cls.__name__}.")
    hints = typing.get_type_hints(cls)
    for name in values:
        check_choice(f"{path} ({cls.__name__})", name, tuple(hints))
    fields = {name: _coerce(hints[name], value, f"{path}.{name}") for name, value in values.items()}
    try:
        return cls(**fields)
    except RangeError as error:
        raise ValueError(f"{path}.{error.field}{error.problem}") from error


def override(config, dotted: str, value: Any):
    """Returns `config` with one dotted field replaced: `override(config, "model.dropout", 0.0)`.

    Raises:
      ValueError: for an unknown field, naming the nearest known one, or a value of the wrong type.
    """
    return override_all(config, {dotted: value})


def override_all(config, settings: Mapping[str, Any]):
    """`override` with several fields at once: only the result must make sense, not each step on the way."""
    values = dataclasses.asdict(config)
    for dotted, value in settings.items():
        node = values
        *parents, leaf = dotted.split(".")
        for name in parents:
            check_choice(f"field of {dotted!r}", name, tuple(node))
            node = node[name]
        check_choice(f"field of {dotted!r}", leaf, tuple(node))
        node[leaf] = value
    return parse(type(config), values, "config")


def _coerce(hint, value, path: str):
    """Returns `value` as `hint` wants it (JSON lists become tuples, whole floats stay floats), or raises."""
    if dataclasses.is_dataclass(hint):
        return parse(hint, value, path)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        check_choice(path, value, arguments)
        return value
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(inner) == len(value):
            return tuple(_coerce(kind, item, path) for kind, item in zip(inner, value, strict=True))
    if origin is types.UnionType and type(None) in arguments:
        return None if value is None else _coerce(arguments[0], value, path)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    raise ValueError(f"{path}: got {value!r}, expected {getattr(hint, '__name__', hint)}.")
