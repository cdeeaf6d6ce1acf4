"""Convolutions: the fast forms against the definition in NumPy, against XLA and against XLA's gradients."""

import functools
import itertools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax.ops import conv as conv_ops
from muvo_jax.ops import conv_cpu, conv_doubled, resample

PROPERTY = settings(max_examples=10, deadline=None, derandomize=True)


@pytest.fixture(autouse=True, scope="module")
def as_if_large():
    """Tiny layers take the form that large ones take."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conv_cpu, "_LITTLE_WORK", 0)
        yield


@st.composite
def problems(draw, transposed: bool):
    rank = draw(st.integers(1, 3))
    per_axis = lambda low, high: tuple(draw(st.integers(low, high)) for _ in range(rank))
    taps, strides, pads = per_axis(1, 6 if rank < 3 else 4), per_axis(1, 3), per_axis(0, 2)
    sizes = per_axis(1, 5)
    options = {"stride": strides, "padding": pads}
    if transposed:
        options["output_padding"] = tuple(draw(st.integers(0, s - 1)) for s in strides)
        sizes = tuple(n + 2 * p for n, p in zip(sizes, pads, strict=True))
    else:
        sizes = tuple(max(n, k - 2 * p, 1) for n, k, p in zip(sizes, taps, pads, strict=True))
    batch = draw(st.sampled_from([1, 2, 8]))
    channels_in, channels_out = draw(st.integers(1, 4)), draw(st.integers(1, 9))
    return (batch, *sizes, channels_in), (*taps, channels_in, channels_out), options


def normal(seed: int, *shapes, dtype=np.float32):
    random = np.random.default_rng(seed)
    return [jnp.asarray(random.normal(size=shape), dtype) for shape in shapes]


def conv_by_definition(x, kernel, stride, padding):
    x = np.pad(x, ((0, 0), *((p, p) for p in padding), (0, 0)))
    taps = kernel.shape[:-2]
    sizes = [(n - k) // s + 1 for n, k, s in zip(x.shape[1:-1], taps, stride, strict=True)]
    out = np.zeros((x.shape[0], *sizes, kernel.shape[-1]))
    for tap in itertools.product(*map(range, taps)):
        window = tuple(slice(k, k + (n - 1) * s + 1, s) for k, n, s in zip(tap, sizes, stride, strict=True))
        out += x[(slice(None), *window)] @ kernel[tap]
    return out


def conv_transpose_by_definition(x, kernel, stride, padding, output_padding):
    taps = kernel.shape[:-2]
    full = [(n - 1) * s + k + e for n, s, k, e in zip(x.shape[1:-1], stride, taps, output_padding, strict=True)]
    out = np.zeros((x.shape[0], *full, kernel.shape[-1]))
    for place in itertools.product(*map(range, x.shape[1:-1])):
        for tap in itertools.product(*map(range, taps)):
            target = tuple(i * s + k for i, s, k in zip(place, stride, tap, strict=True))
            out[(slice(None), *target)] += x[(slice(None), *place)] @ kernel[tap]
    return out[(slice(None), *(slice(p, n - p) for p, n in zip(padding, full, strict=True)))]


def assert_near(got, expected, tolerance=2e-5):
    scale = max(float(np.abs(np.asarray(expected, np.float64)).max(initial=0.0)), 1e-6)
    assert got.shape == expected.shape
    np.testing.assert_allclose(np.asarray(got, np.float64), np.asarray(expected, np.float64), atol=tolerance * scale)


def assert_same_function(function, x, kernel, seed=1, tolerance=2e-5):
    """Values and both gradients of the CPU forms are those of XLA; returns the values."""
    shape = jax.eval_shape(functools.partial(function, implementation="xla"), x, kernel).shape
    (cotangent,) = normal(seed, shape, dtype=x.dtype)

    @functools.partial(jax.jit, static_argnums=3)
    def differentiate(x, kernel, cotangent, implementation):
        value, pull_back = jax.vjp(functools.partial(function, implementation=implementation), x, kernel)
        return value, *pull_back(cotangent)

    fast, exact = (differentiate(x, kernel, cotangent, implementation) for implementation in ("gemm", "xla"))
    for got, expected in zip(fast, exact, strict=True):
        assert got.dtype == expected.dtype
        assert_near(got, expected, tolerance)
    return fast[0]


@PROPERTY
@given(problems(transposed=False))
def test_conv_is_its_definition_and_differentiates_like_xla(problem):
    x_shape, kernel_shape, options = problem
    x, kernel = normal(0, x_shape, kernel_shape)
    with jax.numpy_dtype_promotion("strict"):
        got = assert_same_function(functools.partial(conv_ops.conv, **options), x, kernel)
    assert_near(got, conv_by_definition(np.asarray(x), np.asarray(kernel), **options))


@PROPERTY
@given(problems(transposed=False))
def test_a_layer_of_few_pixels_and_many_channels_is_its_definition_too(problem):
    x_shape, kernel_shape, options = problem
    x, kernel = normal(0, x_shape, kernel_shape)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conv_cpu, "_FEW_PIXELS", 1000)
        patch.setattr(conv_cpu, "_MANY_WEIGHTS", 0)
        got = assert_same_function(functools.partial(conv_ops.conv, **options), x, kernel)
    assert_near(got, conv_by_definition(np.asarray(x), np.asarray(kernel), **options))


@PROPERTY
@given(problems(transposed=True))
def test_conv_transpose_is_its_definition_and_differentiates_like_xla(problem):
    x_shape, kernel_shape, options = problem
    x, kernel = normal(0, x_shape, kernel_shape)
    expected = conv_transpose_by_definition(np.asarray(x), np.asarray(kernel), **options)
    if min(expected.shape) < 1:
        with pytest.raises(ValueError, match="reduce the padding"):
            conv_ops.conv_transpose(x, kernel, **options)
        return
    with jax.numpy_dtype_promotion("strict"):
        got = assert_same_function(functools.partial(conv_ops.conv_transpose, **options), x, kernel)
    assert_near(got, expected)


@pytest.mark.parametrize(("size", "taps", "options", "expected"), [
    (4, 6, {"stride": 2, "padding": 2}, 8),
    (4, 5, {"stride": 2, "padding": 2, "output_padding": 1}, 8),
    (4, 4, {"stride": 2, "padding": 1}, 8),
    (1, 5, {}, 5),
])
def test_the_decoders_transposed_layers(size, taps, options, expected, strict_dtypes):
    x, kernel = normal(0, (2, size, size, 3), (taps, taps, 3, 2))
    out = assert_same_function(functools.partial(conv_ops.conv_transpose, **options), x, kernel)
    assert out.shape == (2, expected, expected, 2)


@pytest.mark.parametrize("z_size", [2, 4, 5, 8, 19])
@pytest.mark.parametrize("channels_out", [2, 8])
def test_folded_voxels_of_any_height(z_size, channels_out, strict_dtypes):
    x, kernel = normal(0, (2, 4, 3, z_size, 3), (3, 3, 3, 3, channels_out))
    assert_same_function(functools.partial(conv_ops.conv, padding=1), x, kernel)


@PROPERTY
@given(st.lists(st.integers(1, 5), min_size=2, max_size=3), st.integers(1, 3), st.sampled_from([1, 5, 16, 17]))
def test_convolving_what_was_doubled_without_doubling_it(sizes, channels_in, channels_out):
    """Down to a single voxel, all of whose neighbours lie beyond the border."""
    x, kernel = normal(0, (2, *sizes, channels_in), (*(3,) * len(sizes), channels_in, channels_out))
    with jax.numpy_dtype_promotion("strict"):
        got = assert_same_function(conv_doubled.conv_doubled, x, kernel)
    doubled = np.asarray(resample.upsample_linear(x))
    assert_near(got, conv_by_definition(doubled, np.asarray(kernel), (1,) * len(sizes), (1,) * len(sizes)))


def test_convolving_what_was_doubled_takes_three_taps_an_axis():
    x, kernel = normal(0, (1, 4, 4, 4, 2), (3, 3, 5, 2, 2))
    with pytest.raises(ValueError, match="expected \\[3, 3, C, O\\]"):
        conv_doubled.conv_doubled(x, kernel)


@pytest.mark.parametrize("channels_out", [63, 64])
def test_folded_voxels_of_many_channels(channels_out, strict_dtypes):
    x, kernel = normal(0, (1, 3, 4, 6, 2), (3, 3, 3, 2, channels_out))
    assert_same_function(functools.partial(conv_ops.conv, padding=1), x, kernel)


@pytest.mark.parametrize("chunk_bytes", [1, 600, 3000, 10**6])
def test_kernel_gradient_does_not_depend_on_the_chunks(chunk_bytes, monkeypatch, strict_dtypes):
    monkeypatch.setattr(conv_cpu, "_CHUNK_BYTES", chunk_bytes)
    for channels in ((3, 4), (4, 3)):  # the side with fewer is the one that is shifted
        x, kernel = normal(0, (6, 7, 5, channels[0]), (3, 2, *channels))
        assert_same_function(functools.partial(conv_ops.conv, padding=(1, 0)), x, kernel)


@pytest.mark.parametrize(("size", "taps", "stride"), [((9, 8), 3, 1), ((9, 8), 3, 2), ((12, 7), 7, 2), ((8, 8), 6, 3)])
def test_gradients_inside_a_loop_are_of_the_form_that_is_fast_there(size, taps, stride, monkeypatch, strict_dtypes):
    """XLA's CPU backend reorders axes in the outermost computation alone; in loops other orders are far slower."""
    monkeypatch.setattr(conv_cpu, "_LITTLE_WORK", math.inf)
    random = np.random.default_rng(0)
    x, kernel = (random.normal(size=shape).astype(np.float32) for shape in ((2, *size, 3), (taps, taps, 3, 4)))
    through = lambda implementation: jax.grad(lambda x, kernel: jnp.sum(jnp.sin(conv_ops.conv(
        x, kernel, stride=stride, padding=taps // 2, implementation=implementation))), argnums=(0, 1))
    for found, expected in zip(through("gemm")(x, kernel), through("xla")(x, kernel), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    text = str(jax.make_jaxpr(through("gemm"))(x, kernel))
    orders = re.findall(r"dimension_numbers=ConvDimensionNumbers\((.*?)\)\n? *feature", text, re.DOTALL)
    assert len(orders) == 3
    for order in orders:
        assert re.findall(r"spec=\(([0-9, ]+)\)", order) == ["0, 3, 1, 2", "3, 2, 0, 1", "0, 3, 1, 2"]


@pytest.mark.parametrize(("function", "sizes"), [
    (functools.partial(conv_ops.conv, padding=1), (24, 24)),
    (functools.partial(conv_ops.conv, padding=1, stride=2), (24, 24)),
    (functools.partial(conv_ops.conv_transpose, padding=1, stride=2), (24, 24)),
    (conv_doubled.conv_doubled, (12, 8, 6)),
])
def test_bfloat16_accumulates_in_float32(function, sizes):
    x, kernel = normal(0, (2, *sizes, 4), (*(3,) * len(sizes), 4, 4), dtype=jnp.bfloat16)
    exact = functools.partial(function, implementation="xla")
    fast = functools.partial(function, implementation="gemm")
    gradients = lambda f: jax.jit(jax.grad(lambda x, kernel: f(x, kernel).astype(jnp.float32).sum(), (0, 1)))
    got = gradients(fast)(x, kernel)
    expected = gradients(exact)(x.astype(jnp.float32), kernel.astype(jnp.float32))
    for rounded, unrounded in zip(got, expected, strict=True):
        assert rounded.dtype == jnp.bfloat16
        assert_near(rounded, unrounded, 1e-2)  # one rounding to 8 bits, not 1152 of them


def test_kernel_gradients_of_bfloat16_under_strict_promotion(strict_dtypes):
    x, kernel = normal(0, (2, 6, 5, 4), (3, 3, 4, 2), dtype=jnp.bfloat16)
    assert_same_function(functools.partial(conv_ops.conv, padding=1), x, kernel, tolerance=2e-2)


def test_vmap_scan_remat_and_jit(strict_dtypes):
    x, kernel = normal(0, (3, 2, 5, 5, 4, 2), (3, 3, 3, 2, 2))
    layer = functools.partial(conv_ops.conv, kernel=kernel, padding=1, implementation="gemm")
    loss = lambda x: (layer(x) ** 2).sum()
    gradient = jax.jit(jax.grad(loss))
    each = jnp.stack([gradient(one) for one in x])
    assert_near(jax.jit(jax.vmap(jax.grad(jax.checkpoint(loss))))(x), each)
    scanned = lambda x: jax.lax.scan(lambda total, one: (total + loss(one), None), jnp.float32(0), x)[0]
    assert_near(jax.jit(jax.grad(scanned))(x), each)


@pytest.mark.parametrize("function", [conv_ops.conv, conv_ops.conv_transpose])
def test_xla_supports_forward_mode_and_hessians(function, strict_dtypes):
    x, kernel = normal(0, (1, 4, 4, 1), (3, 3, 1, 1))
    loss = lambda k: (function(x, k, stride=2, padding=1, implementation="xla") ** 2).sum()
    hessian = jax.jit(jax.hessian(loss))(kernel).reshape(9, 9)
    # The loss is quadratic in the kernel: k^T H k / 2.
    flat = kernel.reshape(9)
    np.testing.assert_allclose(flat @ hessian @ flat / 2, loss(kernel), rtol=1e-5)


def test_max_pool_pads_with_minus_infinity_and_takes_the_first_of_equals(strict_dtypes):
    x = -jnp.ones((1, 4, 4, 1), jnp.float32)
    pool = functools.partial(conv_ops.max_pool, window=3, stride=2, padding=1)
    np.testing.assert_array_equal(pool(x), -jnp.ones((1, 2, 2, 1)))
    gradient = jax.grad(lambda x: pool(x).sum())(x)[0, :, :, 0]
    # The windows start at rows and columns -1 and 1; their first valid entries are 0 and 1.
    np.testing.assert_array_equal(gradient, [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(0, 1), st.integers(0, 5))
def test_max_pool_is_reduce_window_with_its_gradient(rank, window, stride, padding, seed):
    padding = min(padding, window // 2)
    sizes = (5, 4, 6)[:rank]
    x = jnp.asarray(np.random.default_rng(seed).integers(0, 4, (2, *sizes, 2)), jnp.float32)

    def reference(x):
        pairs = ((0, 0), *((padding, padding),) * rank, (0, 0))
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, *(window,) * rank, 1), (1, *(stride,) * rank, 1),
                                     pairs)

    pool = lambda x: conv_ops.max_pool(x, window=window, stride=stride, padding=padding)
    (cotangent,) = normal(seed, jax.eval_shape(reference, x).shape)
    differentiate = lambda f: jax.jit(lambda x, cotangent: (f(x), jax.vjp(f, x)[1](cotangent)[0]))(x, cotangent)
    (got, gradient), (expected, expected_gradient) = differentiate(pool), differentiate(reference)
    np.testing.assert_array_equal(got, expected)
    assert_near(gradient, expected_gradient)


def test_max_pool_keeps_nan():
    x = jnp.array([0.0, jnp.nan, 1.0, 2.0])[None, :, None]
    np.testing.assert_array_equal(conv_ops.max_pool(x, window=2, stride=1)[0, :, 0], [np.nan, np.nan, 2.0])


@pytest.mark.parametrize(("x_shape", "kernel_shape", "options", "message"), [
    ((1, 4, 4, 2), (3, 3, 3, 2), {}, "x has 2 channels"),
    ((1, 4, 4, 2), (3, 2, 2), {}, "spatial axes"),
    ((1, 4, 4, 2), (3, 3, 2, 2), {"stride": 0}, "stride: got 0"),
    ((1, 4, 4, 2), (3, 3, 2, 2), {"padding": (1,)}, "padding: got"),
    ((1, 2, 2, 2), (3, 3, 2, 2), {}, "smaller than the kernel"),
    ((1, 4, 4, 2), (3, 3, 2, 2), {"implementation": "fast"}, "implementation: got 'fast'"),
])
def test_errors_name_what_came(x_shape, kernel_shape, options, message):
    with pytest.raises(ValueError, match=message):
        conv_ops.conv(jnp.zeros(x_shape), jnp.zeros(kernel_shape), **options)


def test_more_errors():
    x, kernel = jnp.zeros((1, 4, 4, 2)), jnp.zeros((3, 3, 2, 2))
    with pytest.raises(ValueError, match="cast one of them"):
        conv_ops.conv(x, kernel.astype(jnp.bfloat16))
    with pytest.raises(ValueError, match="output_padding"):
        conv_ops.conv_transpose(x, kernel, stride=2, output_padding=2)
    with pytest.raises(ValueError, match="half of the window"):
        conv_ops.max_pool(x, window=2, stride=2, padding=2)


def test_the_form_is_that_of_the_platform_lowered_for():
    x, kernel = normal(0, (1, 4, 4, 4, 2), (3, 3, 3, 2, 2))
    gradient = jax.jit(jax.grad(lambda x, kernel: conv_ops.conv(x, kernel, padding=1).sum(), argnums=(0, 1)))
    text = lambda *platforms: gradient.trace(x, kernel).lower(lowering_platforms=platforms).as_text()
    in_space = "[b, 0, 1, 2, f]"  # XLA's own 3D convolution; the CPU's form makes 2D ones of it
    assert in_space not in text("cpu") and "[b, 0, 1, f]" in text("cpu")
    assert in_space in text("cuda") and "[b, 0, 1, f]" not in text("cuda")
    both = jax.export.export(gradient, platforms=("cpu", "cuda"))(x, kernel)
    for got, expected in zip(both.call(x, kernel), gradient(x, kernel), strict=True):
        assert_near(got, expected)


def test_without_jit_too_a_convolution_is_compiled_once(caplog):
    x, kernel = normal(0, (1, 5, 4, 2), (3, 3, 2, 2))
    conv_ops.conv(x, kernel)
    with jax.log_compiles():
        conv_ops.conv(x, kernel)
    assert not [record for record in caplog.messages if record.startswith("Compiling")]


def test_the_forms_of_an_accelerator_give_the_same_numbers(monkeypatch, strict_dtypes):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    x, kernel = normal(0, (2, 4, 5, 3), (6, 6, 3, 2))
    for function in (functools.partial(conv_ops.conv_transpose, stride=2, padding=2),
                     functools.partial(conv_ops.conv, stride=2, padding=2)):
        expected, pull_back = jax.vjp(functools.partial(function, implementation="xla"), x, kernel)
        got, pull_back_fast = jax.vjp(function, x, kernel)
        assert_near(got, expected)
        for fast, slow in zip(pull_back_fast(got), pull_back(got), strict=True):
            assert_near(fast, slow)
