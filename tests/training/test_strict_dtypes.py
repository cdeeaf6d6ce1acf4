"""What ships, traced where JAX refuses to promote dtypes implicitly, with float64 switched on too."""

import functools

import jax
import jax.numpy as jnp
import pytest

import muvo_jax
from muvo_jax import presets
from muvo_jax.config import override_all
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import preparation
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

WINDOWS, FRAMES = 2, 3


@pytest.mark.parametrize("wide", [False, True], ids=["float32", "x64"])
def test_the_town_preset_promotes_no_dtype_implicitly(wide):
    config = override_all(presets.get("town"), {"train.batch": WINDOWS, "data.frames": FRAMES,
                                                "train.observe_frames": FRAMES - 1})
    model = muvo_jax.WorldModel(config.model)
    batch = preparation.expected_batch(config, WINDOWS)
    actions = jax.ShapeDtypeStruct((WINDOWS, 2, 2), jnp.float32)

    def everything(variables, batch, actions):
        observed = muvo_jax.observe(model, variables, key, batch)
        dream = muvo_jax.imagine(model, variables, key, observed.last, actions)
        return muvo_jax.decode(model, variables, dream.states, memory=observed.memory), dream.states.features

    with jax.numpy_dtype_promotion("strict"), jax.enable_x64(wide):
        key, variables = jax.random.key(0), model.variable_shapes()
        shown = jax.eval_shape(everything, variables, batch, actions)
        assert {leaf.dtype for leaf in jax.tree.leaves(shown)} == {jnp.dtype(jnp.float32)}

        train = step_lib.make_train_step(model, config, devices=jax.devices()[:1])
        create = functools.partial(state_lib.create, optimizer=optimizer_lib.of_config(config), key=key)
        state = jax.eval_shape(create, variables)
        windows = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), batch)
        after, metrics = jax.eval_shape(train.compiled, state, windows)
        kind = lambda leaf: (leaf.shape, leaf.dtype)
        assert jax.tree.map(kind, after) == jax.tree.map(kind, state)
        assert {leaf.dtype for leaf in jax.tree.leaves(metrics)} == {jnp.dtype(jnp.float32)}
