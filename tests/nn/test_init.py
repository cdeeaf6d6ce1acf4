"""Fresh parameters: the rules, and what depends on what."""

import jax
import numpy as np
import pytest

from muvo_jax.nn import init


def shape(*sizes):
    return jax.ShapeDtypeStruct(sizes, np.float32)


SHAPES = {
    "params": {
        "backbone": {"conv1": {"kernel": shape(3, 3, 16, 32)}},
        "linear": {"kernel": shape(400, 30), "bias": shape(30)},
        "up": {"transposed_kernel": shape(6, 6, 16, 8), "bias": shape(8)},
        "style": {"kernel": shape(20, 6), "bias": shape(6)},
        "bn1": {"scale": shape(4), "bias": shape(4)},
        "bn2": {"scale": shape(4), "bias": shape(4)},
    },
    "batch_stats": {"bn1": {"mean": shape(4), "var": shape(4)}},
}


def test_a_traced_key_is_refused_with_what_to_do_instead():
    with pytest.raises(ValueError, match=r"init: got a traced key .*variable_shapes\(\).* loop over keys"):
        jax.vmap(lambda key: init.fill(SHAPES, key))(jax.random.split(jax.random.key(0), 2))


def test_rules():
    filled = init.fill(SHAPES, jax.random.key(0))
    params = filled["params"]
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(filled))
    np.testing.assert_allclose(params["backbone"]["conv1"]["kernel"].std(), np.sqrt(2 / (9 * 32)), rtol=0.05)
    np.testing.assert_allclose(params["linear"]["kernel"].std(), 400**-0.5, rtol=0.05)
    np.testing.assert_array_equal(params["linear"]["bias"], 0)
    np.testing.assert_allclose(params["up"]["transposed_kernel"].std(), np.sqrt(1.5 / (16 * 36 / 4)), rtol=0.05)
    np.testing.assert_array_equal(params["up"]["bias"], 0)
    np.testing.assert_array_equal(params["style"]["bias"], [1, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(params["bn1"]["scale"], 1)
    np.testing.assert_array_equal(params["bn2"]["scale"], 0)
    np.testing.assert_array_equal(filled["batch_stats"]["bn1"]["var"], 1)


def test_a_leaf_depends_on_the_key_and_its_path_only():
    filled = init.fill(SHAPES, jax.random.key(0))
    fewer = {"params": {"linear": SHAPES["params"]["linear"]}}
    np.testing.assert_array_equal(init.fill(fewer, jax.random.key(0))["params"]["linear"]["kernel"],
                                  filled["params"]["linear"]["kernel"])
    other = init.fill(fewer, jax.random.key(1))["params"]["linear"]
    assert not np.array_equal(other["kernel"], filled["params"]["linear"]["kernel"])


def test_constants_replace_the_rule():
    filled = init.fill(SHAPES, jax.random.key(0), {"linear/bias": 0.5})
    np.testing.assert_array_equal(filled["params"]["linear"]["bias"], 0.5)
    array = np.arange(30.0)
    filled = init.fill(SHAPES, jax.random.key(0), {"linear/bias": array})
    np.testing.assert_array_equal(filled["params"]["linear"]["bias"], array)
