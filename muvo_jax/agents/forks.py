"""Environments in processes that fork: JAX's threads do not survive a fork, and the first call would wait for ever."""

from __future__ import annotations

import os

from jax._src import xla_bridge  # the public interface starts backends instead of saying whether they run

_forked_with_jax = False


def _note() -> None:
    global _forked_with_jax
    _forked_with_jax = _forked_with_jax or xla_bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_note)


def check(where: str) -> None:
    """Raises RuntimeError in a process that was forked from one in which JAX had run already."""
    if _forked_with_jax:
        raise RuntimeError(f"{where}: this process was forked after JAX had run, and JAX does not survive that. Start "
                           f"processes by spawning: multiprocessing.get_context(\"spawn\"), or "
                           f"gymnasium.vector.AsyncVectorEnv(..., context=\"spawn\"). Environments can be pickled.")
