"""The training loop of docs/agents.md runs as it stands there."""

import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.training import preparation

PAGE = pathlib.Path(__file__).parents[2] / "docs" / "agents.md"


@pytest.mark.slow
def test_the_training_loop_runs():
    config = presets.get("tiny")
    model = world_model.WorldModel(config.model)
    shapes = preparation.expected_batch(config, 2)
    batch = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    names = {"model": model, "variables": jax.tree.map(jnp.asarray, model.init(jax.random.key(0))), "config": config,
             "batch": batch, "updates": 2}
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.strip().splitlines()) <= 30
    exec(compile(code, str(PAGE), "exec"), names)
    assert names["transitions"].reward.shape == (15,) and np.isfinite(names["transitions"].reward).all()
    assert np.isfinite(names["metrics"]["actor_loss"])
