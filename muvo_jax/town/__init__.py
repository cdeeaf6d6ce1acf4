"""The built-in driving town: a simulator and its recordings, with nothing to download."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from muvo_jax.town.settings import TownConfig
    from muvo_jax.town.simulator import Town, TownState

__all__ = ["Town", "TownConfig", "TownState"]


def __getattr__(name):
    """The simulator brings JAX, which waits until it is used."""
    if name in __all__:
        from muvo_jax.town import settings, simulator

        return getattr(settings if name == "TownConfig" else simulator, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
