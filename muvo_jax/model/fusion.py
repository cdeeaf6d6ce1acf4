"""Fusion of the sensors' maps and the measurements into one embedding per frame (paper section III-B, Table I)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax.config import ModelConfig
from muvo_jax.model import common
from muvo_jax.nn import attention, layers, norm, resnet


class Compression(linen.Module):
    """[N, H, W, C] -> [N, features]: a halving block, a block, the mean over the map.

    Or all of its cells side by side, [N, H/2 * W/2 * features]: in a small preset the map has a handful of cells, and
    their mean no longer says what stands left and what right.
    """

    features: int
    keep_cells: bool = False
    compute: layers.Compute = layers.Compute()

    @linen.compact
    def __call__(self, x: jax.Array, mode: norm.Mode) -> jax.Array:
        x = resnet.BasicBlock(self.features, self.compute, stride=2, project=True, name="block0")(x, mode)
        x = resnet.BasicBlock(self.features, self.compute, name="block1")(x, mode)
        return x.reshape(x.shape[0], -1) if self.keep_cells else jnp.mean(x, axis=(1, 2))


class TransformerFusion(linen.Module):
    """TR: the cells of both maps are tokens of one transformer.

    Image and lidar maps [N, h, w, token_channels]. For the 1D latent each sensor's tokens are then pooled to a vector
    and joined with the measurements [N, measurement_channels]: [N, embedding_channels]. For the 2D latent each
    measurement [N, token_channels] is one more token, and the tokens are the embedding: [N, M, token_channels].
    """

    config: ModelConfig

    @linen.compact
    def __call__(self, image_map: jax.Array, lidar_map: jax.Array, measurements: list[jax.Array], mode: norm.Mode,
                 keys: jax.Array | None) -> jax.Array:
        config, compute = self.config, common.compute(self.config)
        channels = config.token_channels
        as_tokens = measurements if config.latent == "2d" else []
        type_embedding = self.param("type_embedding", layers.shape_only, (2 + len(as_tokens), channels))
        tokens = []
        for index, cells in enumerate((image_map, lidar_map)):
            added = jnp.asarray(attention.sine_positions(cells.shape[1:3], channels)) + type_embedding[index][None]
            tokens.append(cells.reshape(cells.shape[0], -1, channels) + added[None].astype(cells.dtype))
        for index, value in enumerate(as_tokens, start=2):
            tokens.append(jnp.expand_dims(value + type_embedding[index][None].astype(value.dtype), 1))
        image_count = tokens[0].shape[1]
        mixed = attention.TransformerEncoder(
            config.transformer_layers, config.transformer_heads, config.transformer_hidden_channels, config.dropout,
            compute, name="transformer")(jnp.concatenate(tokens, axis=1), keys)
        if config.latent == "2d":
            return mixed.astype(jnp.float32)
        image_vector = Compression(config.fused_channels, config.keep_cells, compute, name="image_compression")(
            mixed[:, :image_count].reshape(image_map.shape), mode)
        lidar_vector = Compression(config.fused_channels, config.keep_cells, compute, name="lidar_compression")(
            mixed[:, image_count:].reshape(lidar_map.shape), mode)
        joined = jnp.concatenate([image_vector, lidar_vector, *measurements], axis=-1)
        return layers.Dense(config.embedding_channels, compute, name="combine")(joined).astype(jnp.float32)


REGISTRY = {"tr": TransformerFusion}


def initial_constants(config: ModelConfig) -> dict[str, float]:
    """Path of a parameter -> its first value: a fresh fusion transformer hands its tokens through unmixed."""
    if config.fusion != "tr":
        return {}
    return {f"fusion/transformer/layer{index}/{layer}/kernel": 0.0
            for index in range(config.transformer_layers) for layer in ("self_attn/out_proj", "linear2")}
