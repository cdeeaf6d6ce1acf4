"""One setting by its dotted name, as --set and the flags of the commands give it."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from muvo_jax.config import migration, parsing, parts, sizes
from muvo_jax.config.whole import Config

_FILLED_IN = "model.kinematics"  # by Config


def override(config: Config, dotted: str, value: Any) -> Config:
    """`override_all` with one setting: `override(config, "model.fusion.dropout", 0.0)`."""
    return override_all(config, {dotted: value})


def override_all(config: Config, settings: Mapping[str, Any]) -> Config:
    """Returns `config` with some settings replaced, all at once: only the result must make sense.

    Args:
      config: what stays otherwise.
      settings: dotted name -> value, as JSON has it or an instance of the field's class. A part is chosen by its kind,
        {"model.latent": "1d", "model.lidar": "none"}: it has the size of the config's preset, and stays as it is where
        it is of that kind already.

    Raises:
      ValueError: for an unknown name (naming the nearest known one), a name of earlier versions (naming today's), a
        setting that follows from others or that only another kind of part has, or a value of the wrong type.
    """
    values = dataclasses.asdict(config)
    for dotted in sorted(settings, key=lambda name: name.count(".")):  # a part is chosen before its settings
        if today := migration.new_name(dotted):
            raise ValueError(f"{dotted} is called {today} now: parts of the model have settings of their own.")
        if f"{dotted}.".startswith(f"{_FILLED_IN}."):
            raise ValueError(f"{dotted} follows from contract, which the recording says, and data.stride: a value of "
                             f"its own would not count. Leave it out.")
        try:
            _set(values, Config, "", dotted.split("."), settings[dotted], config.preset)
        except _UnknownError as error:
            raise ValueError(f"field of {dotted!r}: {error}.{_hint(dotted, config)}") from None
    return parsing.parse(Config, values, "config")


def names(values: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """{"model.fusion.dropout": 0.1, ...} of a configuration, or a part of one, as a dictionary."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= names(value, f"{above}{name}.") if isinstance(value, dict) else {f"{above}{name}": value}
    return found


def _hint(dotted: str, config: Config) -> str:
    """The settings whose last name is like that of an unknown one, those of its section before others."""
    section, last = dotted.partition(".")[0], dotted.rpartition(".")[2]
    free = (name for name in names(dataclasses.asdict(config)) if not name.startswith(_FILLED_IN))
    known = sorted(free, key=lambda name: not name.startswith(f"{section}."))
    by_last: dict[str, str] = {}
    for name in known:
        by_last.setdefault(name.rpartition(".")[2], name)
    near = [by_last[name] for name in difflib.get_close_matches(last, by_last.keys() - {"kind"}, n=2)]
    return f" Did you mean {' or '.join(near)}?" if near else ""


class _UnknownError(ValueError):
    """There is no such setting; which ones there are."""


def _set(node: dict[str, Any], cls: Any, at: str, below: Sequence[str], value: Any, preset: str) -> None:
    """Sets what is called `below`, in `node`, the dictionary of a `cls`, which itself is called `at`."""
    name, *rest = below
    fields = [field.name for field in dataclasses.fields(cls) if field.init]
    if name not in fields:
        raise _UnknownError(f"{name!r} is unknown; known are {', '.join(fields)}" if fields else
                            f"{at} has no settings of its own")
    here, hint = f"{at}.{name}".removeprefix("."), typing.get_type_hints(cls)[name]
    kinds = parts.kinds(hint)
    if not rest:
        if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):  # its other fields would be the defaults
            raise ValueError(f"{here} is a section of settings, not one: set what is in it, such as "
                             f"{here}.{next(iter(node[name]))}.")
        node[name] = _chosen(kinds, node[name], preset, here, value) if kinds else value
        return
    if kinds:
        kind = None if node[name] is None else node[name]["kind"]
        parsing.check_acts(kinds, kind, rest[0], here)
        hint = kinds[kind] if kind else None
    if not dataclasses.is_dataclass(hint):
        raise _UnknownError(f"{here} has no settings of its own")
    _set(node[name], hint, here, rest, value, preset)


def _chosen(kinds: Mapping[str, Any], now: Any, preset: str, dotted: str, value: Any) -> Any:
    """The part that takes the place of `now`, as a dictionary; None for no sensor."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    optional = (parts.NO_SENSOR,) if dotted in ("model.lidar", "model.camera") else ()
    value = parts.NO_SENSOR if value is None and optional else value
    parsing.check_choice(dotted, value, (*kinds, *optional))
    if value == parts.NO_SENSOR:
        return None
    return now if now is not None and now["kind"] == value else dataclasses.asdict(sizes.of(preset, kinds[value]))
