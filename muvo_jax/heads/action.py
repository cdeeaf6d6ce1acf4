"""What the driver of the recordings does next: acceleration and steering in (-1, 1)."""

from __future__ import annotations

from muvo_jax import head
from muvo_jax.model import decoders
from muvo_jax.nn import layers
from muvo_jax.objectives import regression


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    return {"action": regression.l1_sums(learned.predictions[1], learned.truth("action"))}


HEAD = head.Head(
    targets=lambda model: {"action": (2,)}, build=lambda model: decoders.ActionDecoder(layers.Compute.of(model)),
    tokens="action", losses=_losses, weights=lambda loss: {"action": loss.action})
