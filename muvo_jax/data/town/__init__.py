"""The built-in driving town: a simulator and its recordings, with nothing to download."""

from muvo_jax.data.town.settings import TownConfig
from muvo_jax.data.town.simulator import Town, TownState

__all__ = ["Town", "TownConfig", "TownState"]
