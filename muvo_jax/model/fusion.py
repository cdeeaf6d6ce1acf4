"""Fusion of the sensors' maps and the measurements into one embedding per frame (paper section III-B, Table I).

A model without camera or without lidar has None for that map and fuses what is left (the paper has both).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax.config import ModelConfig
from muvo_jax.model import tokens as tokens_lib
from muvo_jax.nn import attention, layers, norm, resnet


class Compression(linen.Module):
    """[N, H, W, C] -> [N, features]: a halving block, a block (which halves too where `halvings` is 2), the mean.

    Or all cells side by side, [N, H/2 * W/2 * features]: in a small preset the map has a handful of cells, and their
    mean no longer says what stands left and what right.
    """

    features: int
    compute: layers.Compute = layers.Compute()
    halvings: int = 1
    keep_cells: bool = False

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        x = resnet.BasicBlock(self.features, self.compute, stride=2, project=True, name="block0")(x, mode)
        twice = self.halvings == 2
        x = resnet.BasicBlock(self.features, self.compute, 2 if twice else 1, twice, name="block1")(x, mode)
        return x.reshape(x.shape[0], -1) if self.keep_cells else jnp.mean(x, axis=(1, 2))


class TransformerFuser(linen.Module):
    """TR: the cells of both maps are tokens of one transformer.

    Image and lidar maps [N, h, w, token_channels]. For the 1D latent each sensor's tokens are then pooled to a vector
    and joined with the measurements [N, measurement_channels]: [N, embedding_channels]. For the 2D latent each
    measurement [N, token_channels] is one more token, and the tokens are the embedding: [N, M, token_channels].
    """

    config: ModelConfig

    @linen.compact
    def __call__(self, image_map: jax.Array | None, lidar_map: jax.Array | None, measurements: list[jax.Array],
                 mode: norm.Mode, keys: jax.Array | None) -> jax.Array:
        config, compute, latent = self.config, layers.Compute.of(self.config), self.config.latent
        fusion = tokens_lib.fusion(config)
        maps = {name: cells for name, cells in (("image", image_map), ("lidar", lidar_map)) if cells is not None}
        channels = fusion.token_channels
        as_tokens = measurements if isinstance(latent, config_lib.TokenLatent) else []
        type_embedding = self.param("type_embedding", layers.shape_only, (len(maps) + len(as_tokens), channels))
        tokens = []
        for index, cells in enumerate(maps.values()):
            added = jnp.asarray(attention.sine_positions(cells.shape[1:3], channels)) + type_embedding[index][None]
            tokens.append(cells.reshape(cells.shape[0], -1, channels) + added[None].astype(cells.dtype))
        for index, value in enumerate(as_tokens, start=len(maps)):
            tokens.append(jnp.expand_dims(value + type_embedding[index][None].astype(value.dtype), 1))
        transformer = attention.TransformerEncoder(fusion.layers, fusion.heads, fusion.hidden_channels, fusion.dropout,
                                                   compute, name="transformer")
        mixed = transformer(jnp.concatenate(tokens, axis=1), keys)
        if isinstance(latent, config_lib.TokenLatent):
            return mixed.astype(jnp.float32)
        compress = functools.partial(Compression, latent.fused_channels, compute, keep_cells=latent.keep_cells)
        vectors, start = [], 0
        for name, cells in maps.items():
            stop = start + cells.shape[1] * cells.shape[2]
            vectors.append(compress(name=f"{name}_compression")(mixed[:, start:stop].reshape(cells.shape), mode))
            start = stop
        joined = jnp.concatenate([*vectors, *measurements], axis=-1)
        return layers.Dense(latent.embedding_channels, compute, name="combine")(joined).astype(jnp.float32)


class PooledFuser(linen.Module):
    """What FC and AVG have in common: each sensor's map becomes one vector.

    The measurements [N, measurement_channels] are spread over the image map [N, h, w, map_channels], which goes through
    three levels of a ResNet-18 before it is compressed; the lidar map is compressed as it is. Without a camera the
    lidar map is treated as the image map. Result: [N, embedding_channels].
    """

    config: ModelConfig

    def vectors(self, image_map: jax.Array | None, lidar_map: jax.Array | None, measurements: list[jax.Array],
                mode: norm.Mode, features: int) -> list[jax.Array]:
        """One vector [N, features] a sensor, camera first; to be called in a compact method."""
        config, compute = self.config, layers.Compute.of(self.config)
        first, *others = (cells for cells in (image_map, lidar_map) if cells is not None)
        spread = [jnp.broadcast_to(value[:, None, None], (*first.shape[:3], value.shape[-1])) for value in measurements]
        joined = jnp.concatenate([first, *spread], axis=-1)
        (deep,) = resnet.ResNet18(config.backbone_width, (3,), compute, name="map_backbone")(joined, mode)
        vectors = [Compression(features, compute, name="image_state")(deep, mode)]
        for cells in others:
            vectors.append(Compression(features, compute, halvings=2, name="lidar_state")(cells, mode))
        return vectors


class ConcatenationFuser(PooledFuser):
    """FC: both vectors side by side, then a dense layer."""

    @linen.compact
    def __call__(self, image_map: jax.Array | None, lidar_map: jax.Array | None, measurements: list[jax.Array],
                 mode: norm.Mode, keys: jax.Array | None) -> jax.Array:
        del keys
        latent = config_lib.as_kind(self.config.latent, config_lib.VectorLatent)
        both = self.vectors(image_map, lidar_map, measurements, mode, latent.fused_channels)
        join = layers.Dense(latent.embedding_channels, layers.Compute.of(self.config), name="join")
        return join(jnp.concatenate(both, axis=-1)).astype(jnp.float32)


class AverageFuser(PooledFuser):
    """AVG: the mean of both vectors (the paper says so; in the reference's code the line is commented out)."""

    @linen.compact
    def __call__(self, image_map: jax.Array | None, lidar_map: jax.Array | None, measurements: list[jax.Array],
                 mode: norm.Mode, keys: jax.Array | None) -> jax.Array:
        del keys
        latent = config_lib.as_kind(self.config.latent, config_lib.VectorLatent)
        vectors = self.vectors(image_map, lidar_map, measurements, mode, latent.embedding_channels)
        return jnp.mean(jnp.stack(vectors).astype(jnp.float32), axis=0)


REGISTRY: dict[type, type[linen.Module]] = {
    config_lib.TransformerFusion: TransformerFuser, config_lib.ConcatenationFusion: ConcatenationFuser,
    config_lib.AverageFusion: AverageFuser}


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value: a fresh fusion transformer hands its tokens through unmixed."""
    if not isinstance(config.fusion, config_lib.TransformerFusion):
        return {}
    return {f"fusion/transformer/layer{index}/{layer}/kernel": 0.0
            for index in range(config.fusion.layers) for layer in ("self_attn/out_proj", "linear2")}
