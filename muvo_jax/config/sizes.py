"""What a part is like in each preset, whether the preset has it or another one in its place.

So a model that changes a part keeps its size: the town preset has the 2D latent, and --latent=1d gives it a 1D latent
that is small too. A part that is not listed has the paper's size, the defaults of parts.py.
"""

from __future__ import annotations

from typing import Any, TypeVar

from muvo_jax.config import parts
from muvo_jax.geometry import BirdsEyeGrid, PillarGrid

_Part = TypeVar("_Part")
_SIZES: dict[str, tuple[Any, ...]] = {
    "town": (
        parts.VectorLatent(fused_channels=256, keep_cells=True, deterministic_channels=384, stochastic_channels=128,
                           occupancy_blocks=0),
        parts.TokenLatent(transition_layers=1, aligned_tokens=True, occupancy_token_stages=0),
        parts.TransformerFusion(token_channels=96, layers=2, heads=4, hidden_channels=256, dropout=0.0),
        parts.ConcatenationFusion(map_channels=32),
        parts.AverageFusion(map_channels=32),
        parts.PillarLidar(PillarGrid(half_side_m=24.0, cells_per_m=2.0, points=8192, channels=16)),
        parts.BirdsEyeCamera(BirdsEyeGrid(cells=24, cell_m=1.0, cells_behind=4, depth_bins=20, lifted_bins=8,
                                          hidden_channels=128))),
    "tiny": (
        parts.VectorLatent(embedding_channels=16, fused_channels=8, deterministic_channels=16, stochastic_channels=8,
                           action_channels=8, occupancy_blocks=1),
        parts.TokenLatent(transition_layers=1, occupancy_token_stages=0),
        parts.TransformerFusion(token_channels=12, layers=1, heads=2, hidden_channels=16),
        parts.ConcatenationFusion(map_channels=8),
        parts.AverageFusion(map_channels=8),
        parts.PillarLidar(PillarGrid(half_side_m=16.0, cells_per_m=1.0, points=1024, channels=4)),
        parts.BirdsEyeCamera(BirdsEyeGrid(cells=8, cell_m=4.0, cells_behind=2, depth_bins=12, lifted_bins=3,
                                          hidden_channels=8))),
}


def of(preset: str, cls: type[_Part]) -> _Part:
    """The part of that class at the size of a preset; at the paper's size for a preset without sizes of its own."""
    return next((part for part in _SIZES.get(preset, ()) if type(part) is cls), cls())
