"""The one table of what is decoded: a head's name, its decoder, channels, scales, unit and first guess."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common, decoders, outputs


@dataclasses.dataclass(frozen=True)
class Head:
    """One decoded quantity.

    Attributes:
      build: makes the decoder module, given the model's configuration and the channels.
      channels: of each output.
      scales: what the decoder returns; 1 is full size.
      unit: factor from the network's output to the prediction (the range view comes out in metres).
      initial_bias: bias of the last layers of a fresh model, the network's first guess.
    """

    build: Callable[[ModelConfig, int], linen.Module]
    channels: int
    scales: tuple[int, ...]
    unit: Callable[[ModelConfig], float] = lambda config: 1.0
    initial_bias: float | None = None


def _image(config: ModelConfig, channels: int) -> linen.Module:
    return decoders.PlaneDecoder(config.image_size, channels, config.decoder_channels, common.compute(config))


def _range_view(config: ModelConfig, channels: int) -> linen.Module:
    size = (config.range_view.rows, config.range_view.columns)
    return decoders.PlaneDecoder(size, channels, config.decoder_channels, common.compute(config))


def _occupancy(config: ModelConfig, channels: int) -> linen.Module:
    return decoders.VoxelDecoder(config.voxels.shape, channels, config.occupancy_channels, config.occupancy_blocks,
                                 common.compute(config))


def _action(config: ModelConfig, channels: int) -> linen.Module:
    del channels
    return decoders.ActionDecoder(common.compute(config))


TABLE = {
    "image": Head(_image, 3, (1, 2, 4), initial_bias=0.5),
    "range_view": Head(_range_view, 4, (1, 2, 4), unit=lambda config: config.range_scale_m, initial_bias=0.0),
    "occupancy": Head(_occupancy, 2, (1, 2, 4), initial_bias=0.0),
    "action": Head(_action, 2, (1,)),
}


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value, for the heads that this model has.

    Where the average training frame is the first guess, the last layers start at zero and add nothing to it.
    """
    values = {}
    for name, head in TABLE.items():
        if name not in config.heads or head.initial_bias is None:
            continue
        for scale in head.scales:
            path = f"decoders_{name}/head_{scale}"
            if config.first_guess == "training_mean" and name in outputs.FIRST_GUESS_HEADS:
                values |= {f"{path}/bias": 0.0, f"{path}/kernel": 0.0}
            else:
                values[f"{path}/bias"] = head.initial_bias
    return values
