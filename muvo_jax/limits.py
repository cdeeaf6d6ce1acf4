"""What numbers may be: a range and a unit beside each field of a dataclass, checked wherever it is created.

    class OptimizerConfig:
        learning_rate: Annotated[float, limits.above(0)] = 1e-4

    def __post_init__(self):
        limits.check(self)

Every float must be finite, with a range or without, and so in float32, in which a model computes.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import types
import typing
from typing import Any

# The ends of float32. A device takes what is smaller for 0.
_LARGEST, _SMALLEST = (2.0 - 2.0**-23) * 2.0**127, 2.0**-126


@dataclasses.dataclass(frozen=True)
class Limits:
    """A range of numbers.

    Attributes:
      lowest, highest: its ends.
      open_low, open_high: whether an end itself lies outside.
      unit: for messages; "" for none.
    """

    lowest: float = -math.inf
    highest: float = math.inf
    open_low: bool = False
    open_high: bool = False
    unit: str = ""

    def holds(self, value: float) -> bool:
        """Whether a number that is finite in float32 lies inside, there too where 0 does not; NaN never does."""
        above = value > self.lowest if self.open_low else value >= self.lowest
        below = value < self.highest if self.open_high else value <= self.highest
        vanishes = self.open_low and self.lowest == 0 and abs(value) < _SMALLEST
        return bool(above and below and abs(value) <= _LARGEST and not vanishes)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        low = f"{'above' if self.open_low else 'at least'} {self.lowest:g}" if math.isfinite(self.lowest) else ""
        high = f"{'below' if self.open_high else 'at most'} {self.highest:g}" if math.isfinite(self.highest) else ""
        return (" and ".join(filter(None, (low, high))) or "finite") + unit


FINITE = Limits()


def above(lowest: float, highest: float = math.inf, unit: str = "") -> Limits:
    """Greater than `lowest`, up to `highest`."""
    return Limits(lowest, highest, open_low=True, unit=unit)


def between(lowest: float, highest: float, unit: str = "") -> Limits:
    """From `lowest` to `highest`, both included."""
    return Limits(lowest, highest, unit=unit)


def at_least(lowest: float, unit: str = "") -> Limits:
    """`lowest` or greater."""
    return Limits(lowest, unit=unit)


COUNT = at_least(1)
NOT_NEGATIVE = at_least(0)
SHARE = between(0, 1)


class RangeError(ValueError):
    """A number that cannot be.

    Attributes:
      field: its name in its dataclass.
      problem: the rest of the sentence, after the name.
    """

    def __init__(self, owner: str, field: str, problem: str):
        self.field, self.problem = field, problem if problem.startswith(":") else f" {problem}"
        super().__init__(f"{owner}.{field}{self.problem}")


def check(instance: Any) -> None:
    """Compares the numbers of a dataclass, also those inside of tuples, with the limits beside its fields.

    Raises:
      RangeError: naming class, field, value and range.
    """
    cls: Any = type(instance)
    for name, limits, whole in of(cls):
        value = getattr(instance, name)
        for number in _numbers(value):
            if isinstance(number, bool) or not isinstance(number, numbers.Real) or (
                    whole and not isinstance(number, numbers.Integral)):
                kind = "whole numbers" if whole else "numbers"
                raise RangeError(cls.__name__, name, f"is {value!r}; expected {kind}.")
            if not _holds(limits, number):
                raise RangeError(cls.__name__, name, f"is {value!r}{_in_float32(number)}; it must be {limits}.")


def _holds(limits: Limits, number: Any) -> bool:
    try:
        return limits.holds(float(number))
    except OverflowError:  # a whole number that no float can be
        return False


def _in_float32(number: Any) -> str:
    """What float32 makes of a number that it does not hold; "" of others."""
    if math.inf > abs(number) > _LARGEST:
        return " (infinite in float32)"
    return " (0 in float32)" if 0 < abs(number) < _SMALLEST else ""


def _numbers(value: Any) -> typing.Iterator[Any]:
    """The leaves of nested tuples; None has none."""
    if isinstance(value, (tuple, list)):
        for item in value:
            yield from _numbers(item)
    elif value is not None:
        yield value


@functools.cache
def of(cls: type) -> tuple[tuple[str, Limits, bool], ...]:
    """(field, its limits, whether it is whole) of every field of a class that is made of numbers."""
    found = []
    for name, hint in typing.get_type_hints(cls, include_extras=True).items():
        limits = FINITE
        if typing.get_origin(hint) is typing.Annotated:
            hint, *extras = typing.get_args(hint)
            limits = next((extra for extra in extras if isinstance(extra, Limits)), FINITE)
        kinds = _leaf_kinds(hint)
        if kinds and kinds <= {int, float}:
            found.append((name, limits, float not in kinds))
    return tuple(found)


def _leaf_kinds(hint: Any) -> set[Any]:
    """The types that a hint, a tuple of any depth or an optional one is made of."""
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _leaf_kinds(typing.get_args(hint)[0])
    if origin in (tuple, types.UnionType, typing.Union):
        parts = (part for part in typing.get_args(hint) if part not in (Ellipsis, type(None)))
        return set().union(*map(_leaf_kinds, parts))
    return {hint}
