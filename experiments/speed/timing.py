"""Timing on a machine that others use as well: what is compared takes turns, and the processors' seconds count."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np


def first_call_s(function: Callable[[], Any]) -> float:
    """Processor seconds of the next call, of a function that was not called before: tracing and compilation."""
    start = time.process_time()
    jax.block_until_ready(function())
    return time.process_time() - start


def processor_seconds(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds [rounds] that all threads together spent in each function; compilation left out.

    Unlike time on the wall they do not grow with the load of other programs, but a bit with their use of the caches:
    compare within a round (`ratio`).
    """
    for function in functions.values():
        jax.block_until_ready(function())
    taken: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.process_time()
            jax.block_until_ready(function())
            taken[name].append(time.process_time() - start)
    return {name: np.array(seconds) for name, seconds in taken.items()}


def ratio(taken: np.ndarray, reference: np.ndarray) -> float:
    """Median over the rounds of taken / reference."""
    return float(np.median(taken / reference))
