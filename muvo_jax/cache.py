"""Where what can be made again is kept: recordings of the town, compiled programs."""

import os
import pathlib


def folder() -> pathlib.Path:
    """$XDG_CACHE_HOME/muvo_jax, or ~/.cache/muvo_jax.

    Raises:
      OSError: where there is neither, as for a user of a container whom its system does not know.
    """
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return pathlib.Path(given or pathlib.Path.home() / ".cache") / "muvo_jax"
    except RuntimeError as error:
        raise OSError(f"nowhere to keep what is made ({error}). Set XDG_CACHE_HOME to a folder that can be "
                      f"written.") from error
