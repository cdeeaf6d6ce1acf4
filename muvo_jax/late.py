"""Imports that wait until their module is used, so that --help and a wrong flag cost no JAX.

    with late.imports():
        from muvo_jax.training import loop

binds `loop` at once, but runs its file when one of its names is first asked for, or at `late.load()`. An `import jax`
of what already waits runs it (Python asks it for its `__spec__`), so only the command itself has one.
"""

from __future__ import annotations

import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from collections.abc import Iterator, Sequence

_ROOT = __name__.partition(".")[0]
_waiting: list[str] = []


class _Finder(importlib.abc.MetaPathFinder):
    """Finds jax and the modules of this package, for loaders that wait; all else is left to the finders behind it."""

    def find_spec(self, fullname: str, path: Sequence[str] | None,
                  target: types.ModuleType | None = None) -> importlib.machinery.ModuleSpec | None:
        if fullname != "jax" and not fullname.startswith(f"{_ROOT}."):
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = importlib.util.LazyLoader(spec.loader)
            _waiting.append(fullname)
        return spec


@contextlib.contextmanager
def imports() -> Iterator[None]:
    """Within it, `import jax` and `from muvo_jax.PART import MODULE` wait; names of a module do not."""
    finder = _Finder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


def load() -> None:
    """Runs what still waits: before threads start, which must not meet a module that is half there."""
    while _waiting:
        module = sys.modules.get(_waiting.pop())
        if module is not None:
            _ = module.__doc__  # any name will do
