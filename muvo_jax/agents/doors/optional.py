"""Importing what only a door needs, with an error that says how to get it."""

from __future__ import annotations

import importlib
from typing import Any

import jax
import numpy as np


def need(module: str, extra: str) -> Any:
    """Imports `module`.

    A door may be opened for the first time inside jit: arrays that a library makes when it is imported (stoa's kinds of
    steps) must not belong to that trace.

    Raises:
      ImportError: naming the extra of muvo_jax that brings it.
    """
    try:
        with jax.ensure_compile_time_eval():
            return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} cannot be imported ({error}); this door needs the extra [{extra}]: "
                          f"pip install 'muvo_jax[{extra}]'") from error


def one_horizon(where: str, params: Any) -> None:
    """Raises ValueError for horizons of several cars: such a door drives one, and its wrappers take one number."""
    shape = np.shape(params.max_steps_in_episode)
    if shape:
        raise ValueError(f"{where}: max_steps_in_episode is {list(shape)}, expected one number. Cars with horizons of "
                         f"their own drive in the environment itself, under jax.vmap.")
