"""Importing what only a door needs, with an error that says how to get it."""

from __future__ import annotations

import importlib
from typing import Any


def need(module: str, extra: str) -> Any:
    """Imports `module`.

    Raises:
      ImportError: naming the extra of muvo_jax that brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} cannot be imported ({error}); this door needs the extra [{extra}]: "
                          f"pip install 'muvo_jax[{extra}]'") from error
