"""The process that trains: its memory, and the signals that ask it to stop."""

from __future__ import annotations

import resource
import signal
import sys
import threading


def peak_memory_gib() -> float:
    """The most memory this process has held so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20


class StopRequest:
    """Turns the first SIGINT or SIGTERM into a wish that the loop sees between two steps; a second one interrupts."""

    def __init__(self):
        self.requested = False
        self._before: dict = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, *_) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
