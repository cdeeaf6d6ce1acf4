"""Frozen dataclasses from JSON and back: checked field by field, with the nearest known name in every refusal."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from muvo_jax.config import parts
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
    types_of = typing.get_type_hints(cls)
    hints = {field.name: types_of[field.name] for field in dataclasses.fields(cls) if field.init}
    for name in values:
        check_choice(f"{path} ({cls.__name__})", name, tuple(hints))
    fields = {name: _coerce(hints[name], value, f"{path}.{name}") for name, value in values.items()}
    try:
        return cls(**fields)
    except RangeError as error:
        raise ValueError(f"{path}.{error.field}{error.problem}") from error


def _coerce(hint, value, path: str):
    """Returns `value` as `hint` wants it (JSON lists become tuples, whole floats stay floats), or raises."""
    if dataclasses.is_dataclass(value) and isinstance(value, hint):
        return value
    if kinds := parts.kinds(hint):
        return None if value is None and type(None) in typing.get_args(hint) else _part(kinds, value, path)
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
    if origin is Mapping and isinstance(value, dict):
        return {name: _coerce(arguments[1], item, f"{path}.{name}") for name, item in value.items()}
    if hint is Any:
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    raise ValueError(f"{path}: got {value!r}, expected {getattr(hint, '__name__', hint)}.")


def _part(kinds: Mapping[str, Any], value: Any, path: str):
    """A part from {"kind": ..., its settings}."""
    if not isinstance(value, dict) or "kind" not in value:
        raise ValueError(f"{path}: got {value!r}, expected {{\"kind\": ...}} of {', '.join(kinds)}, and its settings.")
    check_choice(f"{path}.kind", value["kind"], tuple(kinds))
    fields = {name: item for name, item in value.items() if name != "kind"}
    for name in fields:
        check_acts(kinds, value["kind"], name, path)
    return parse(kinds[value["kind"]], fields, path)


def check_acts(kinds: Mapping[str, Any], kind: str | None, field: str, path: str) -> None:
    """Refuses a setting that only parts of another kind have.

    Args:
      kinds: kind -> class of the parts that there may be.
      kind: the one that there is, None for none.
      field: the setting.
      path: of the part, for messages.

    Raises:
      ValueError: saying which kind has it.
    """
    having = [name for name, cls in kinds.items() if field in {item.name for item in dataclasses.fields(cls)}]
    if having and kind not in having:
        part = path.removeprefix("config.")
        raise ValueError(f"{part}.{field} is a setting of {part}={' or '.join(having)} "
                         f"({', '.join(kinds[name].__name__ for name in having)}), and {part} is {kind or 'none'}: it "
                         f"would do nothing. Leave it out, or choose {part}={having[0]}.")
