"""The one table of what is decoded: a head's name, its decoder, channels, scales, tokens, unit and first guess.

config/heads.py says what a head is compared with, objectives/terms.py how, and what a new head takes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from flax import linen

from muvo_jax.config import BIRDS_EYE_CLASSES, EGO_MOTION_UNITS, ModelConfig, TokenLatent, ZeroGuess
from muvo_jax.model import common, decoders, memory, outputs, token_decoders, tokens


@dataclasses.dataclass(frozen=True)
class Head:
    """One decoded quantity.

    Attributes:
      build: makes the decoder module, given the model's configuration and the channels.
      channels: of each output, or what the configuration makes of it; see `channels_of`.
      scales: what the decoder returns; 1 is full size.
      tokens: which group of the 2D latent the decoder reads (muvo_jax.model.tokens), None for one vector of all groups
        (tokens.pool); with the 1D latent it reads all features.
      unit: factor, or one a channel, from the network's output to the prediction (the range view comes out in metres).
      initial_bias: bias of the last layers of a fresh model, the network's first guess.
    """

    build: Callable[[ModelConfig, int], linen.Module]
    channels: int | Callable[[ModelConfig], int]
    scales: tuple[int, ...]
    tokens: str | None
    unit: Callable[[ModelConfig], float | tuple[float, ...]] = lambda config: 1.0
    initial_bias: float | None = None

    def channels_of(self, config: ModelConfig) -> int:
        """Channels of each output of a model."""
        return self.channels(config) if callable(self.channels) else self.channels


def _plane(config: ModelConfig, channels: int, size: tuple[int, int], token_shrink: int) -> linen.Module:
    width = config.decoder_channels
    if isinstance(config.latent, TokenLatent):
        stages = token_shrink.bit_length() - 4  # three more doublings end in an output each
        return token_decoders.TokenDecoder(channels, width, width, stages, common.compute(config))
    return decoders.PlaneDecoder(size, channels, width, common.compute(config))


def _image(config: ModelConfig, channels: int) -> linen.Module:
    return _plane(config, channels, config.image_size, tokens.IMAGE_SHRINK)


def _range_view(config: ModelConfig, channels: int) -> linen.Module:
    size = (config.range_view.rows, config.range_view.columns)
    return _plane(config, channels, size, tokens.RANGE_VIEW_SHRINK)


def _occupancy(config: ModelConfig, channels: int) -> linen.Module:
    width = config.occupancy_channels
    if isinstance(config.latent, TokenLatent):
        return token_decoders.TokenDecoder(channels, 2 * width, width, config.latent.occupancy_token_stages,
                                           common.compute(config))
    return decoders.StyledDecoder(config.voxels.shape, channels, 2 * width, width, config.latent.occupancy_blocks,
                                  compute=common.compute(config))


def _birds_eye(config: ModelConfig, channels: int) -> linen.Module:
    width, compute, head = config.decoder_channels, common.compute(config), decoders.BirdsEyeHead
    if isinstance(config.latent, TokenLatent):
        return token_decoders.TokenDecoder(channels, width, width, config.latent.occupancy_token_stages, compute, head,
                                           flat=True)
    return decoders.StyledDecoder(config.voxels.shape[:2], channels, width, width, config.latent.occupancy_blocks, head,
                                  compute)


def _action(config: ModelConfig, channels: int) -> linen.Module:
    del channels
    return decoders.ActionDecoder(common.compute(config))


def _vector(config: ModelConfig, channels: int) -> linen.Module:
    """A few numbers, without an output activation: reward, motion and the like."""
    return decoders.VectorDecoder(channels, config.decoder_channels, common.compute(config))


def _classes(config: ModelConfig) -> int:
    return config.semantic_classes


TABLE = {
    "image": Head(_image, 3, (1, 2, 4), "image", initial_bias=0.5),
    "range_view": Head(_range_view, 4, (1, 2, 4), "range_view", unit=lambda config: config.range_scale_m,
                       initial_bias=0.0),
    "occupancy": Head(_occupancy, 2, (1, 2, 4), "occupancy", initial_bias=0.0),
    "depth": Head(_image, 1, (1, 2, 4), "image", unit=lambda config: config.range_scale_m, initial_bias=0.0),
    "semantic_image": Head(_image, _classes, (1, 2, 4), "image"),
    "semantic_range_view": Head(_range_view, _classes, (1, 2, 4), "range_view"),
    "birds_eye": Head(_birds_eye, BIRDS_EYE_CLASSES + decoders.INSTANCE_CHANNELS, (1, 2, 4), "occupancy"),
    "action": Head(_action, 2, (1,), "action"),
    "reward": Head(_vector, 1, (1,), None),  # as recorded with the frame
    "continue": Head(_vector, 1, (1,), None),  # logit of the drive not being over
    "ego_motion": Head(_vector, 4, (1,), None, unit=lambda config: EGO_MOTION_UNITS),  # types.Batch.ego_motion
}


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value, for the heads that this model has.

    Where the average training frame is the first guess, the last layers start at zero and add nothing to it.
    """
    values: dict[str, float] = {}
    guessed = memory.guessed_heads(config)
    for name, head in TABLE.items():
        if name not in config.heads or head.initial_bias is None:
            continue
        for scale in head.scales:
            path = f"decoders_{name}/{'decoder/' if name in guessed else ''}head_{scale}"
            if name in guessed and name == "image" and scale == 1:
                values[f"decoders_{name}/decoder/blur/kernel"] = 0.0
            if not isinstance(config.first_guess, ZeroGuess) and name in outputs.FIRST_GUESS_HEADS:
                values |= {f"{path}/bias": 0.0, f"{path}/kernel": 0.0}
            else:
                values[f"{path}/bias"] = head.initial_bias
    return values
