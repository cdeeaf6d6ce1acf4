"""3x3 convolutions with fewer products beside the definition: numbers, gradients, odd sizes, chunks."""

import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from muvo_jax.ops import conv, conv_cpu, conv_winograd

SAME = ((1, 1), (1, 1))
EMITTERS = "--xla_cpu_use_fusion_emitters"


def emitters(monkeypatch, on: bool):
    """As if XLA were started so; it has read its flags by then, of which the number of devices stays."""
    kept = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if not flag.startswith(EMITTERS)]
    monkeypatch.setenv("XLA_FLAGS", " ".join([*kept, f"{EMITTERS}={str(on).lower()}"]))


def drawn(size, channels, padding, dtype):
    """x, kernel and the gradient of what they give."""
    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (*size, channels[0]), dtype)
    kernel = jax.random.normal(keys[1], (3, 3, *channels), dtype)
    outs = [side + low + high - 2 for side, (low, high) in zip(size[1:], padding, strict=True)]
    return x, kernel, jax.random.normal(keys[2], (size[0], *outs, channels[1]), dtype)


def results(function, x, kernel, gradient):
    """What a convolution gives, and its two gradients."""
    @jax.jit
    def both(x, kernel, gradient):
        found, pull_back = jax.vjp(function, x, kernel)
        return found, *pull_back(gradient)

    return both(x, kernel, gradient)


@pytest.mark.parametrize(("size", "padding", "tiles"), [
    ((2, 7, 9), SAME, 512), ((2, 7, 9), SAME, 5), ((3, 8, 12), ((0, 0), (0, 0)), 13), ((4, 2, 2), SAME, 2),
    ((1, 5, 6), ((2, 0), (0, 1)), 4), ((1, 11, 4), ((-1, 2), (1, -1)), 3), ((6, 3, 5), SAME, 12)])
def test_it_is_the_definition(size, padding, tiles, monkeypatch):
    """Odd sides, uneven and negative padding; chunks of some samples, of some rows, rows that are left over."""
    monkeypatch.setattr(conv_winograd, "_CHUNK_TILES", tiles)
    with jax.enable_x64(True):
        given = drawn(size, (5, 3), padding, jnp.float64)
        got = results(lambda x, kernel: conv_winograd.dense(x, kernel, padding), *given)
        want = results(lambda x, kernel: conv_cpu.plain(x, kernel, (1, 1), padding), *given)
    for found, expected in zip(got, want, strict=True):
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_its_rounding_is_about_that_of_the_definition():
    with jax.enable_x64(True):
        given = drawn((2, 24, 31), (128, 64), SAME, jnp.float64)
        exact = results(lambda x, kernel: conv_cpu.plain(x, kernel, (1, 1), SAME), *given)
        single = [value.astype(jnp.float32) for value in given]
        exact = [np.asarray(value) for value in exact]
    error = lambda function: [np.sqrt(((np.asarray(found) - want)**2).mean() / (want**2).mean())
                              for found, want in zip(results(function, *single), exact, strict=True)]
    ours = error(lambda x, kernel: conv_winograd.dense(x, kernel, SAME))
    plain = error(lambda x, kernel: conv_cpu.plain(x, kernel, (1, 1), SAME))
    for found, usual in zip(ours, plain, strict=True):
        assert found < max(4 * usual, 2e-6)


def test_it_is_taken_where_it_pays(monkeypatch):
    """Many channels and much work; twice the channels where XLA's fusion emitters write the transforms' code."""
    shape = lambda *size, dtype=jnp.float32: jax.ShapeDtypeStruct(size, dtype)
    pays = lambda channels, side=64, kernel=3, **kind: conv_winograd.pays(
        shape(6, side, side, channels, **kind), shape(kernel, kernel, channels, 2 * channels, **kind), SAME)
    emitters(monkeypatch, on=False)
    assert pays(128) and pays(512) and not pays(64)
    assert not pays(128, side=8), "little work"
    assert not pays(128, kernel=5) and not pays(128, dtype=jnp.bfloat16)
    emitters(monkeypatch, on=True)
    assert pays(256) and not pays(128)


def test_convolutions_take_it(monkeypatch):
    """Plain and transposed ones, jitted, and in a loop."""
    monkeypatch.setattr(conv_winograd, "_LITTLE_WORK", 0.0)
    monkeypatch.setattr(conv_winograd, "_FEWEST_CHANNELS", 1)
    emitters(monkeypatch, on=False)
    taken = []
    dense = conv_winograd.dense
    monkeypatch.setattr(conv_winograd, "dense", lambda *given: taken.append(given[0].shape) or dense(*given))
    key = jax.random.key(0)
    x, kernel = jax.random.normal(key, (2, 6, 10, 3)), jax.random.normal(key, (3, 3, 3, 3))
    twice = lambda implementation: jax.jit(lambda x, kernel: jax.lax.fori_loop(0, 2, lambda _, x: conv.conv(
        x, kernel, padding=1, implementation=implementation), x))
    np.testing.assert_allclose(twice("gemm")(x, kernel), twice("xla")(x, kernel), rtol=1e-4, atol=1e-4)
    assert taken == [x.shape]
    wide = jax.random.normal(key, (6, 6, 3, 4))
    doubled = functools.partial(conv.conv_transpose, stride=2, padding=2)
    np.testing.assert_allclose(doubled(x, wide, implementation="gemm"), doubled(x, wide, implementation="xla"),
                               rtol=1e-4, atol=1e-4)
    assert len(taken) == 2


@pytest.mark.parametrize("fewest", [1, 10**9])
def test_gradients_in_a_mesh_whose_axes_are_checked(fewest, monkeypatch):
    """In a user's own jax.shard_map, with its default check: images vary from device to device, and so, formally, does
    the kernel, as that check asks of whatever has a derivative of its own."""
    monkeypatch.setattr(conv_winograd, "_LITTLE_WORK", 0.0)
    monkeypatch.setattr(conv_winograd, "_FEWEST_CHANNELS", fewest)
    monkeypatch.setattr(conv_cpu, "_LITTLE_WORK", 0.0)
    emitters(monkeypatch, on=False)
    mesh = jax.make_mesh((2,), ("data",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:2])
    x, kernel, gradient = drawn((2, 6, 7), (3, 4), SAME, jnp.float32)
    slope = lambda x, kernel, gradient: jax.grad(
        lambda kernel: (conv.conv(x, kernel, padding=1, implementation="gemm") * gradient).sum())(kernel)
    summed = lambda x, kernel, gradient: jax.lax.psum(slope(x, jax.lax.pcast(kernel, "data", to="varying"), gradient),
                                                      "data")
    spread = jax.shard_map(summed, mesh=mesh, in_specs=(P("data"), P(), P("data")), out_specs=P())
    np.testing.assert_allclose(jax.jit(spread)(x, kernel, gradient), slope(x, kernel, gradient), rtol=1e-4, atol=1e-4)
