"""A training step whose matrix work is in bfloat16: what it computes in, what it keeps, and that it learns."""

import dataclasses
import re

import jax
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.model import world_model
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

WINDOWS, FRAMES, SIDE_PX = 4, 3, 32


def config_of(latent):
    tiny = config_lib.override_all(presets.tiny(), {
        "model.latent": latent, "model.compute_dtype": "bfloat16", "model.camera": "none", "model.route": False,
        "model.heads": ("range_view", "action"), "model.fusion.dropout": 0.0, "model.prior_dropout": 0.0,
        "model.range_view": config_lib.RangeViewGeometry(rows=SIDE_PX, columns=SIDE_PX)})
    return dataclasses.replace(
        tiny, data=dataclasses.replace(tiny.data, frames=FRAMES),
        optimizer=config_lib.OptimizerConfig(learning_rate=3e-3),
        train=dataclasses.replace(tiny.train, batch=WINDOWS, steps=20))


def batch_of():
    random, lead = np.random.default_rng(0), (WINDOWS, FRAMES)
    points_m = np.broadcast_to(random.uniform(-10, 10, (*lead, 1, 1, 3)), (*lead, SIDE_PX, SIDE_PX, 3))
    view = np.concatenate([points_m, np.linalg.norm(points_m, axis=-1, keepdims=True)], axis=-1)
    return types.Batch(action=random.uniform(-1, 1, (*lead, 2)).astype(np.float32),
                       is_first=np.broadcast_to(np.arange(FRAMES) == 0, lead).copy(),
                       range_view=view.astype(np.float32),
                       speed_mps=random.uniform(0, 10, lead).astype(np.float32)).validate()


@pytest.mark.parametrize("latent", ["1d", "2d"])
def test_products_are_bfloat16_parameters_and_moments_float32_and_the_loss_falls(latent):
    config = config_of(latent)
    model, batch = world_model.WorldModel(config.model), batch_of()
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    step = step_lib.make_train_step(model, config, devices=jax.devices()[:1])
    state, placed = state_lib.create(model.init(jax.random.key(0)), optimizer, jax.random.key(1)), step.place(batch)
    lowered = step.compiled.lower(state, placed)
    products = re.findall(r"stablehlo\.(?:dot_general|convolution).*", lowered.as_text())
    assert sum("bf16" in line for line in products) > len(products) / 2
    compiled, losses = lowered.compile(), []
    for _ in range(config.train.steps):
        state, metrics = compiled(state, placed)
        losses.append(float(metrics["total"]))
        assert float(metrics["finite"]) == 1.0
    floating = [leaf for leaf in jax.tree.leaves((state.variables, state.opt_state))
                if jax.numpy.issubdtype(leaf.dtype, jax.numpy.floating)]
    assert floating and all(leaf.dtype == np.float32 for leaf in floating)
    assert losses[-1] < 0.9 * losses[0]
