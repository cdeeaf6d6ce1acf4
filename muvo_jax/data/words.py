"""How numbers of things are written: 1 run, 2 runs."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str = "") -> str:
    """`counted(1, "run") -> "1 run"`, `counted(2, "run") -> "2 runs"`; `plural` where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
