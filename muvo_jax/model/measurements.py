"""Encoders of the inputs that are not sensors' views: the planned route, the speed and what the navigation says."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import ModelConfig, VectorLatent
from muvo_jax.model import camera, common
from muvo_jax.nn import layers, norm, resnet
from muvo_jax.ops import conv_cpu

COMMANDS = 6


class RouteEncoder(linen.Module):
    """Route map uint8 [N, 64, 64] -> [N, common.measurement_channels]: a ResNet-18 on three equal channels."""

    config: ModelConfig

    @linen.compact
    def __call__(self, route_map: jax.Array, mode: norm.Mode) -> jax.Array:
        compute = common.compute(self.config)
        image = camera.normalise_image(jnp.repeat(jnp.expand_dims(route_map, -1), 3, axis=-1)).astype(compute.dtype)
        (deepest,) = resnet.ResNet18(self.config.backbone_width, (4,), compute, name="backbone")(image, mode)
        channels = common.measurement_channels(self.config)
        return layers.Dense(channels, compute, name="linear")(jnp.mean(deepest, axis=(1, 2)))


class SmallRouteEncoder(linen.Module):
    """The same by two convolutions on blocks of 4x4 pixels, whose cells stay apart: where the route turns matters."""

    config: ModelConfig

    @linen.compact
    def __call__(self, route_map: jax.Array, mode: norm.Mode) -> jax.Array:
        del mode
        compute = common.compute(self.config)
        x = jnp.expand_dims(route_map, -1).astype(compute.dtype) / 255.0
        x = jax.nn.relu(layers.Dense(16, compute, name="blocks")(conv_cpu.space_to_depth(x, (4, 4))))
        x = jax.nn.relu(layers.Conv(32, (3, 3), compute, 2, name="conv")(x))
        return layers.Dense(common.measurement_channels(self.config), compute, name="linear")(
            x.reshape(x.shape[0], -1))


ROUTE_ENCODERS: dict[str, type[RouteEncoder] | type[SmallRouteEncoder]] = {
    "resnet18": RouteEncoder, "small": SmallRouteEncoder}


class SpeedEncoder(linen.Module):
    """Speed float32 [N] in m/s -> [N, common.measurement_channels]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, speed_mps: jax.Array) -> jax.Array:
        scaled = jnp.expand_dims(speed_mps / self.config.speed_scale_mps, -1)
        widths = (self.config.measurement_channels, common.measurement_channels(self.config))
        return jax.nn.relu(layers.Mlp(widths, common.compute(self.config), name="mlp")(scaled))


class CommandEncoder(linen.Module):
    """A navigation command int32 [N], 0 to 5 -> [N, common.measurement_channels]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, command: jax.Array) -> jax.Array:
        channels = self.config.measurement_channels // 2
        embedding = self.param("embedding", layers.shape_only, (COMMANDS, channels))
        out = channels if isinstance(self.config.latent, VectorLatent) else common.measurement_channels(self.config)
        return jax.nn.relu(layers.Mlp((channels, out), common.compute(self.config), name="mlp")(
            jnp.take(embedding, command, axis=0)))


class TargetEncoder(linen.Module):
    """The places of both commands, float32 [N, 2] each, m -> [N, common.measurement_channels]."""

    config: ModelConfig

    @linen.compact
    def __call__(self, target_m: jax.Array, next_target_m: jax.Array) -> jax.Array:
        widths = (self.config.measurement_channels, common.measurement_channels(self.config))
        both = jnp.concatenate([target_m, next_target_m], axis=-1)
        return jax.nn.relu(layers.Mlp(widths, common.compute(self.config), name="mlp")(both))
