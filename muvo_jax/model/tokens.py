"""The tokens of fusion and of the 2D latent: which ones a state has, which of them a head reads, what a policy reads.

A state is one row of tokens [..., N, C], group after group in the order of `groups`: the cells of the image, of the
range view and of the voxel grid, each in row-major order, and one token for the action. All groups are there whatever
the heads, as in the reference, so that a model can gain a head later.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from muvo_jax.config import ModelConfig, PlaneCamera, RangeViewLidar, TokenLatent, TransformerFusion, as_kind

IMAGE_SHRINK, RANGE_VIEW_SHRINK = 32, 16


def fusion(config: ModelConfig) -> TransformerFusion:
    """The fusion of a model that has tokens: every model with the 2D latent, and some others."""
    return as_kind(config.fusion, TransformerFusion)


def fine_maps(config: ModelConfig) -> bool:
    """Whether fusion takes the sensors' finest maps: where it has no tokens, or many of them."""
    return not isinstance(config.fusion, TransformerFusion) or config.fusion.many_tokens


def groups(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Name of a group -> its grid; () is a single token."""
    view = config.range_view
    voxel_shrink = 2 ** (as_kind(config.latent, TokenLatent).occupancy_token_stages + 3)
    return {"image": tuple(side // IMAGE_SHRINK for side in config.image_size),
            "range_view": (view.rows // RANGE_VIEW_SHRINK, view.columns // RANGE_VIEW_SHRINK),
            "occupancy": tuple(side // voxel_shrink for side in config.voxels.shape),
            "action": ()}


def count(config: ModelConfig) -> int:
    """Tokens of a state; 1093 at the paper's sizes."""
    return sum(math.prod(grid) for grid in groups(config).values())


def split(tokens: jax.Array, config: ModelConfig) -> dict[str, jax.Array]:
    """[..., N, C] -> name of a group -> its tokens [..., n, C]."""
    parts, start = {}, 0
    for name, grid in groups(config).items():
        stop = start + math.prod(grid)
        parts[name] = tokens[..., start:stop, :]
        start = stop
    return parts


def read(features: jax.Array, group: str, config: ModelConfig) -> jax.Array:
    """What the decoder of a head reads: features [..., N, 2 C] -> the group's map [..., *grid, 2 C].

    The paper decodes from the deterministic and the stochastic state; the reference from the stochastic one alone,
    [..., *grid, C] under numerics="reference".
    """
    part = split(features, config)[group]
    if config.numerics == "reference":
        part = part[..., part.shape[-1] // 2:]
    return part.reshape(*part.shape[:-2], *groups(config)[group], part.shape[-1])


def pool(features: jax.Array, config: ModelConfig) -> jax.Array:
    """[..., N, 2 C] -> [..., G * 2 C]: the mean of each group's tokens side by side, the action's token last."""
    return jnp.concatenate([part.mean(axis=-2) for part in split(features, config).values()], axis=-1)


def of_observation(embedding: jax.Array, config: ModelConfig) -> jax.Array:
    """An observation's tokens [..., M, C] in the places of the state's tokens: [..., N, C].

    The image's cells go to the group "image" with PlaneCamera, the range view's to "range_view" with RangeViewLidar:
    those have the same grids, unless there are many tokens. What has no counterpart gets the mean of the whole
    observation.
    """
    sizes = {group: math.prod(grid) for group, grid in groups(config).items()}
    lidar_ends = embedding.shape[-2] - (config.route + 3 * config.navigation + config.speed)
    placed = {}
    if isinstance(config.camera, PlaneCamera) and not fine_maps(config):
        placed["image"] = embedding[..., :sizes["image"], :]
    if isinstance(config.lidar, RangeViewLidar) and not fine_maps(config):
        placed["range_view"] = embedding[..., lidar_ends - sizes["range_view"]:lidar_ends, :]
    whole = embedding.mean(axis=-2, keepdims=True)
    spread = lambda size: jnp.broadcast_to(whole, (*whole.shape[:-2], size, whole.shape[-1]))
    parts = [placed[group] if group in placed else spread(size) for group, size in sizes.items()]
    return jnp.concatenate(parts, axis=-2)
