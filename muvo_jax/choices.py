"""What the flags and the --set of a training choose together, checked before anything is recorded or compiled."""

from __future__ import annotations

import itertools
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from muvo_jax import config as config_lib

if TYPE_CHECKING:
    from muvo_jax import train

_PATHS = {"backbone_weights": "train.backbone_weights", "perceptual_from": "train.perceptual_from"}


def check(options: train.Options, settings: Mapping[str, Any], fields: Mapping[str, str]) -> None:
    """Refuses what --set cannot change, and what it changes otherwise than a flag.

    Args:
      settings: those of --set.
      fields: flag -> the one setting that it is.

    Raises:
      ValueError: naming both, and what to write instead.
    """
    if "preset" in settings:
        raise ValueError(f"--set preset={settings['preset']}: a preset is more than its name, and --set would change "
                         f"the name alone. Choose it by --preset=NAME.")
    if "model.heads" in settings:
        _check_heads(settings["model.heads"])
    if options.augment and not any(settings.get(f"augmentation.{name}", True) for name in ("image", "route")):
        raise ValueError("--augment and --set augmentation.image=false augmentation.route=false contradict each other: "
                         "give one of them.")
    if (options.perceptual or options.perceptual_from) and settings.get("loss.image_perceptual") == 0:
        flag = "--perceptual-from" if options.perceptual_from else "--perceptual"
        raise ValueError(f"{flag} and --set loss.image_perceptual=0 contradict each other: give one of them.")
    given = {flag: getattr(options, flag) for flag in (*fields, *_PATHS)} | {"key_frames": options.key_frames or None}
    for flag, name in {**fields, **_PATHS, "key_frames": "data.key_frames"}.items():
        if given[flag] is not None and name in settings and not _same(given[flag], settings[name]):
            raise ValueError(f"{_written(flag, given[flag])} and --set {name}={_text(settings[name])} contradict each "
                             f"other: give one of them.")
    exact = names(options.heads)
    if exact and "model.heads" in settings and set(exact) != set(settings["model.heads"]):
        raise ValueError(f"--heads={options.heads} and --set model.heads={_text(settings['model.heads'])} contradict "
                         f"each other: give one of them.")


def of_variant(options: train.Options, settings: Mapping[str, Any]) -> dict[str, str]:
    """{"model.lidar": "pp", ...} from --variant=PP-BEV-FC.

    Raises:
      ValueError: for a name that does not exist, or another flag or one of --set's `settings` that contradicts it.
    """
    if options.variant is None:
        return {}
    kinds = (config_lib.LIDARS, config_lib.CAMERAS, config_lib.FUSIONS)
    known = ["-".join(parts).upper() for parts in itertools.product(*kinds)]
    if options.variant.upper() not in known:
        raise ValueError(f"--variant={options.variant} is unknown; known are {', '.join(known)}.")
    parts = dict(zip(("lidar", "camera", "fusion"), options.variant.lower().split("-"), strict=True))
    for flag, value in parts.items():
        others = {} if getattr(options, flag) is None else {f"--{flag}": getattr(options, flag)}
        others |= {f"--set {name}": settings[name] for name in (f"model.{flag}",) if name in settings}
        for name, other in others.items():
            if not _same(value, other):
                raise ValueError(f"--variant={options.variant} and {name}={_text(other)} contradict each other: give "
                                 f"one of them.")
    return {f"model.{flag}": value for flag, value in parts.items()}


def heads(options: train.Options, before: Sequence[str]) -> tuple[str, ...] | None:
    """The heads that the flags make of those `before`, None where no flag speaks of heads.

    Raises:
      ValueError: for a head that does not exist, flags that contradict each other, or where no head is left.
    """
    if (options.heads, options.with_heads, options.occupancy, options.no_occupancy) == (None, None, False, False):
        return None
    exact, more = names(options.heads), names(options.with_heads)
    for flag, given, named in (("--heads", options.heads, exact), ("--with-heads", options.with_heads, more)):
        if given is not None and not named:
            raise ValueError(f"{flag}= names no head: expected one or more of {', '.join(config_lib.KNOWN_HEADS)}, "
                             f"such as {flag}=image,occupancy.")
        for name in named:
            config_lib.check_choice(flag, name, tuple(config_lib.KNOWN_HEADS))
    if options.no_occupancy and (options.occupancy or "occupancy" in exact + more):
        raise ValueError("--no-occupancy and --occupancy (or --heads and --with-heads with occupancy) contradict each "
                         "other: give one of them.")
    wanted = {*(exact or before), *more} | ({"occupancy"} if options.occupancy else set())
    wanted -= {"occupancy"} if options.no_occupancy else set()
    if not wanted:
        raise ValueError("--no-occupancy leaves no head: occupancy is the only one. Name others with --with-heads.")
    return tuple(head for head in config_lib.KNOWN_HEADS if head in wanted)


def names(text: str | None) -> list[str]:
    """["image", "action"] of "image, action"."""
    return [name.strip() for name in text.split(",")] if text else []


def _check_heads(value: Any) -> None:
    """Refuses what is no list of known heads, each once."""
    named = value if isinstance(value, list) and all(isinstance(name, str) for name in value) else []
    for name in named:
        config_lib.check_choice("--set model.heads", name, tuple(config_lib.KNOWN_HEADS))
    if not named or len(set(named)) < len(named):
        raise ValueError(f"--set model.heads={_text(value)}: expected a list of one or more heads, each once, such as "
                         f"--set 'model.heads=[\"image\",\"action\"]' (or --heads=image,action); known are "
                         f"{', '.join(config_lib.KNOWN_HEADS)}.")


def _same(given: Any, other: Any) -> bool:
    """Whether a flag and --set say the same; no sensor is "none" and null."""
    if isinstance(given, pathlib.Path):
        return str(other) in (str(given), str(given.expanduser().resolve()))
    return given == other or (given == config_lib.NO_SENSOR and other is None)


def _written(flag: str, value: Any) -> str:
    name = f"--{flag.replace('_', '-')}"
    return name if value is True else f"{name}={value}"


def _text(value: Any) -> str:
    """A value as --set takes it."""
    return value if isinstance(value, str) else json.dumps(value)
