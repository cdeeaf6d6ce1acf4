"""When things happen in a run, and what its time goes into."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Iterator
from typing import Any

import jax

from muvo_jax import config as config_lib
from muvo_jax.training import screen

OF_THE_CLOCK = ("steps_per_s", "waiting_percent")  # fields of records that another run of the same has otherwise
TRACED = range(3, 8)  # steps after a start: the first ones touch memory that later ones have


@dataclasses.dataclass(frozen=True)
class Due:
    """What happens after a step."""

    log: bool
    validate: bool
    checkpoint: bool
    preview: bool

    @property
    def any_pause(self) -> bool:
        return self.validate or self.checkpoint or self.preview


def due(step: int, settings: config_lib.TrainConfig) -> Due:
    """What the run's settings ask for after that many steps."""
    def every(period):
        return period > 0 and step % period == 0
    return Due(every(settings.log_every), every(settings.validate_every), every(settings.checkpoint_every),
                every(settings.preview_every))


class Pace:
    """Steps per second, the share of time spent waiting for data, and the time left, since the last `mark`."""

    def __init__(self):
        self._since_s = time.perf_counter()
        self._steps = 0
        self._waited_s = 0.0

    def step(self, waited_s: float) -> None:
        self._steps += 1
        self._waited_s += waited_s

    def mark(self, left: int) -> dict[str, float]:
        """The figures since the last mark, for `left` steps to go; starts anew."""
        elapsed_s = max(time.perf_counter() - self._since_s, 1e-9)
        rate_hz = self._steps / elapsed_s
        figures = {"steps_per_s": rate_hz, "waiting_percent": 100.0 * self._waited_s / elapsed_s,
                   "left_s": left / rate_hz if rate_hz else float("nan")}
        self.restart()
        return figures

    def restart(self) -> None:
        """Forgets what was measured, so that validation does not count as slow training."""
        self._since_s, self._steps, self._waited_s = time.perf_counter(), 0, 0.0


class Spent:
    """Seconds of the wall clock by what they went into."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}

    def add(self, **seconds: float) -> None:
        for part, more in seconds.items():
            self._seconds[part] = self._seconds.get(part, 0.0) + more

    @contextlib.contextmanager
    def on(self, part: str) -> Iterator[None]:
        """What happens within counts for a part."""
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.add(**{part: time.perf_counter() - start_s})

    def seconds(self) -> dict[str, float]:
        """{"steps_s": 316.2, ...} since the start."""
        return {f"{part}_s": round(value, 3) for part, value in self._seconds.items()}

    def text(self) -> str:
        """steps 5 min 16 s, validation 58 s, ...: the longest first."""
        longest = sorted(self._seconds.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{part} {screen.duration_text(value)}" for part, value in longest)


class Trace:
    """JAX's profiler, on for the steps TRACED; off without a folder."""

    def __init__(self, folder: pathlib.Path | None):
        self._folder, self._on, self._begun = folder, False, False

    def begin(self, step: int) -> None:
        """Before a step, the first of a start being 0."""
        if self._folder is not None and step == TRACED.start:
            jax.profiler.start_trace(self._folder)
            self._on = self._begun = True

    def end(self, step: int | None, results: Any) -> str | None:
        """After a step, or after the last one (None): what to tell the user once the trace is written."""
        if step is None and self._folder is not None and not self._begun:
            return f"nothing was traced: steps {TRACED.start + 1} to {TRACED.stop} are, and there were fewer"
        if not self._on or (step is not None and step + 1 < TRACED.stop):
            return None
        jax.block_until_ready(results)
        jax.profiler.stop_trace()
        self._on = False
        return f"traced steps into {self._folder}"
