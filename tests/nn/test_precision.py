"""float32 means float32 in every product of a model, forwards and backwards, on accelerators too."""

import re

import jax
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.training import optimizer, preparation, state, step


@pytest.mark.parametrize("latent", ["1d", "2d"])
def test_a_training_step_for_a_gpu_rounds_no_factor(latent):
    config = config_lib.override(presets.tiny(), "model.latent", latent)
    model, make = world_model.WorldModel(config.model), optimizer.make_optimizer(config.optimizer, 1)
    fresh = jax.eval_shape(lambda variables, key: state.create(variables, make, key), model.variable_shapes(),
                           jax.random.key(0))
    batch = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype),
                         preparation.expected_batch(config, 2))
    body = step.gradient_body(model, config)
    traced = jax.jit(lambda state, batch: body(state, batch, None)).trace(fresh, batch)
    program = traced.lower(lowering_platforms=("cuda",)).as_text()
    products = re.findall(r"stablehlo\.(?:dot_general|convolution).*", program)
    assert len(products) > 100
    rounded = [line for line in products if line.count("HIGHEST") != 2]
    assert not rounded, "\n".join(rounded)
