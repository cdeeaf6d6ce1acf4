"""MobileViT-V2: maps whose sides are odd where attention wants whole patches of 2x2."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.nn import init, mobilevit, norm

EVAL = norm.Mode()


def filled(module, x):
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), x, EVAL))
    return init.fill(shapes, jax.random.key(1))


def test_an_odd_map_grows_before_the_first_convolution_of_its_block():
    """As timm does: a map that was grown by hand gives the same."""
    x = np.random.default_rng(0).normal(size=(1, 3, 5, 8)).astype(np.float32)
    rows, columns = (np.linspace(0, side - 1, side + 1) for side in (3, 5))
    between = lambda values, at, axis: np.apply_along_axis(
        lambda line: np.interp(at, np.arange(len(line)), line), axis, values)
    grown = jnp.asarray(between(between(x, rows, 1), columns, 2), jnp.float32)
    block = mobilevit.MobileVitBlock(1)
    variables = filled(block, grown)
    np.testing.assert_allclose(block.apply(variables, jnp.asarray(x), EVAL), block.apply(variables, grown, EVAL),
                               atol=1e-5)


@pytest.mark.parametrize("size, grown", [((160, 416), (6, 14)), ((128, 64), (4, 2)), ((32, 32), (2, 2))])
def test_only_who_asks_for_timms_sizes_sees_the_growth(size, grown):
    x = jax.ShapeDtypeStruct((1, *size, 3), jnp.float32)
    shapes = {}
    for keep in (False, True):
        module = mobilevit.MobileVit(4, (2, 3, 4), keep_grown=keep)
        maps, _ = jax.eval_shape(lambda x, module=module: module.init_with_output(jax.random.key(0), x, EVAL), x)
        shapes[keep] = [leaf.shape[1:3] for leaf in maps]
    assert shapes[False] == [(size[0] // stride, size[1] // stride) for stride in (8, 16, 32)]
    assert shapes[True] == [*(tuple(side + side % 2 for side in sides) for sides in shapes[False][:2]), grown]


@pytest.mark.parametrize("numerics", ["standard", "reference"])
@pytest.mark.parametrize("many_tokens", [False, True])
def test_a_model_encodes_sides_that_are_odd_in_patches(numerics, many_tokens):
    tiny = presets.tiny().model
    config = dataclasses.replace(
        tiny, backbone="mobilevitv2_100", image_size=(96, 160), numerics=numerics,
        fusion=dataclasses.replace(tiny.fusion, many_tokens=many_tokens),
        range_view=dataclasses.replace(tiny.range_view, rows=32, columns=96))
    shapes = world_model.WorldModel(config).variable_shapes()
    assert "backbone" in shapes["params"]["camera"] and "backbone" in shapes["params"]["lidar"]
