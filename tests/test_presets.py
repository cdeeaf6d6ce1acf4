"""Presets against the reference's sizes, and the town preset for every variant."""

import itertools
import math

import jax
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import world_model

# The reference counts layers that it only copies from: of the fusion transformer, of prior and posterior.
_ENCODER_TEMPLATE, _DECODER_TEMPLATE = 2_168_192, 2_760_320
_PUBLISHED = {"reference-1d": 176_185_437 - _ENCODER_TEMPLATE,
              "reference-2d": 119_079_973 - _ENCODER_TEMPLATE - 2 * _DECODER_TEMPLATE,
              "reference-mobilevit": 113_533_012 - _ENCODER_TEMPLATE - 2 * _DECODER_TEMPLATE}
_VARIANTS = [dict(zip(("lidar", "camera", "fusion", "latent"), (*parts, "1d"), strict=True))
             for parts in itertools.product(config_lib.LIDARS, config_lib.CAMERAS, config_lib.FUSIONS)]


def parameters(config):
    shapes = world_model.WorldModel(config).variable_shapes()["params"]
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))


@pytest.mark.parametrize("name", sorted(_PUBLISHED))
def test_reference_presets_have_the_released_sizes_and_schedule(name):
    config = presets.get(name)
    assert parameters(config.model) == _PUBLISHED[name]
    assert config.model.numerics == "reference"
    assert (config.train.batch, config.optimizer.accumulate, config.train.steps) == (1, 16, 100_000)
    assert (config.data.context, config.data.horizon) == (6, 10)
    optimizer = config.optimizer
    assert (optimizer.learning_rate, optimizer.weight_decay, optimizer.clip_norm) == (1e-4, 0.01, 0.0)


def test_paper_presets_have_the_papers_lengths_and_heads():
    paper, occupancy = presets.get("paper"), presets.get("paper-occupancy")
    for config in (paper, occupancy):
        assert config.train.batch * config.optimizer.accumulate == 16 and config.model.image_size == (320, 832)
    assert (paper.data.frames, paper.data.context, paper.data.horizon) == (12, 6, 6)
    assert (occupancy.data.frames, occupancy.data.context, occupancy.data.horizon) == (6, 4, 2)
    assert "occupancy" in occupancy.model.heads and "occupancy" not in paper.model.heads


@pytest.mark.parametrize("variant", [*_VARIANTS, *({**_VARIANTS[0], "fusion": "tr", "latent": "2d", "camera": camera}
                                                   for camera in config_lib.CAMERAS)])
def test_the_town_preset_exists_for_every_variant_at_a_small_size(variant):
    choices = {f"model.{part}": kind for part, kind in variant.items()}
    config = config_lib.override_all(presets.get("town"), choices).model
    # AVG is the largest: both of its vectors must be as wide as the embedding that is their mean. The 2D latent is the
    # smallest: no vector is unfolded into maps, and the route's encoder is small.
    assert 2.5e6 < parameters(config) < 25e6
