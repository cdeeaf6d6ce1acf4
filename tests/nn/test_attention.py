"""Sine positions, keyed dropout and the transformer encoder."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.nn import attention, init

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def test_positions_by_hand():
    table = attention.sine_positions((2, 3), 8)
    assert table.shape == (6, 8)
    # Row-major: cell 5 is row 1 of 2 and column 2 of 3, the last of both, at angle 2 pi; cell 0 is at pi and 2 pi / 3.
    np.testing.assert_allclose(table[0, :2], [np.sin(np.pi), np.cos(np.pi)], atol=1e-5)
    np.testing.assert_allclose(table[0, 4:6], [np.sin(2 * np.pi / 3), np.cos(2 * np.pi / 3)], atol=1e-5)
    np.testing.assert_allclose(table[5, [2, 3]], [np.sin(2 * np.pi / 100), np.cos(2 * np.pi / 100)], atol=1e-5)
    np.testing.assert_array_equal(table[:3, :4], np.repeat(table[:1, :4], 3, axis=0))  # one row, one y code


def test_three_axes_share_the_channels():
    assert attention.sine_positions((2, 2, 2), 12).shape == (8, 12)
    with pytest.raises(ValueError, match="multiple of 6"):
        attention.sine_positions((2, 2, 2), 8)


def test_dropout_keeps_the_mean_and_follows_each_samples_key():
    keys = jax.random.split(jax.random.key(0), 4)
    x = jnp.ones((4, 2000))
    y = attention.dropout(x, keys, 3, 0.1)
    np.testing.assert_allclose(np.unique(y), [0, 1 / 0.9], rtol=1e-6)
    np.testing.assert_allclose(y.mean(), 1.0, atol=0.02)
    np.testing.assert_array_equal(attention.dropout(x[2:], keys[2:], 3, 0.1), y[2:])
    assert not np.array_equal(attention.dropout(x, keys, 4, 0.1), y)
    assert attention.dropout(x, None, 3, 0.1) is x


def encoder_and_params(layers_count=2):
    encoder = attention.TransformerEncoder(layers_count, 2, 16, 0.5)
    shapes = jax.eval_shape(encoder.init, jax.random.key(0), jnp.zeros((1, 5, 8)))
    return encoder, init.fill(shapes, jax.random.key(1))


def test_encoder_by_hand():
    encoder, variables = encoder_and_params(1)
    x = np.asarray(jax.random.normal(jax.random.key(2), (1, 5, 8)))
    layer = variables["params"]["layer0"]
    dense = lambda value, name: value @ layer[name]["kernel"] + layer[name]["bias"]
    normalise = lambda value: (value - value.mean(-1, keepdims=True)) / np.sqrt(value.var(-1, keepdims=True) + 1e-5)
    attend = layer["self_attn"]
    query, key, value = np.split(x[0] @ attend["in_proj"]["kernel"], 3, axis=-1)
    heads = []
    for part in (slice(0, 4), slice(4, 8)):
        weights = np.exp(query[:, part] @ key[:, part].T / 2)
        heads.append(weights / weights.sum(-1, keepdims=True) @ value[:, part])
    y = normalise(x[0] + np.concatenate(heads, -1) @ attend["out_proj"]["kernel"])
    y = normalise(y + dense(np.maximum(dense(y, "linear1"), 0), "linear2"))
    np.testing.assert_allclose(encoder.apply(variables, x)[0], y, rtol=1e-4, atol=1e-5)


def test_tokens_may_be_permuted():
    encoder, variables = encoder_and_params()
    x = jax.random.normal(jax.random.key(3), (2, 5, 8))
    order = np.array([3, 0, 4, 1, 2])
    np.testing.assert_allclose(encoder.apply(variables, x)[:, order], encoder.apply(variables, x[:, order]), atol=1e-5)


def test_dropout_of_a_sample_does_not_depend_on_the_batch():
    encoder, variables = encoder_and_params()
    x = jax.random.normal(jax.random.key(3), (4, 5, 8))
    keys = jax.random.split(jax.random.key(4), 4)
    whole = encoder.apply(variables, x, keys)
    np.testing.assert_allclose(encoder.apply(variables, x[1:3], keys[1:3]), whole[1:3], atol=1e-5)
    assert not np.allclose(whole, encoder.apply(variables, x), atol=1e-2)


def decoder_and_params():
    decoder = attention.TransformerDecoder(2, 2, 16, 0.5)
    shapes = jax.eval_shape(decoder.init, jax.random.key(0), jnp.zeros((1, 5, 8)), jnp.zeros((1, 7, 8)))
    return decoder, init.fill(shapes, jax.random.key(1))


def test_decoder_layer_by_hand():
    layer = attention.DecoderLayer(1, 16, 0.0)
    draw = lambda seed, length: np.asarray(jax.random.normal(jax.random.key(seed), (1, length, 8)))
    x, memory = draw(2, 3), draw(3, 4)
    shapes = jax.eval_shape(lambda key: layer.init(key, x, memory, None, 0), jax.random.key(0))
    params = init.fill(shapes, jax.random.key(1))["params"]
    dense = lambda value, name: value @ params[name]["kernel"] + params[name]["bias"]
    normalise = lambda value: (value - value.mean(-1, keepdims=True)) / np.sqrt(value.var(-1, keepdims=True) + 1e-5)

    def attend(name, x, memory):
        kernel = params[name]["in_proj"]["kernel"]
        weights = np.exp((x @ kernel[:, :8]) @ (memory @ kernel[:, 8:16]).T / np.sqrt(8))
        mixed = weights / weights.sum(-1, keepdims=True) @ (memory @ kernel[:, 16:])
        return mixed @ params[name]["out_proj"]["kernel"]

    y = normalise(x[0] + attend("self_attn", x[0], x[0]))
    y = normalise(y + attend("cross_attn", y, memory[0]))
    y = normalise(y + dense(np.maximum(dense(y, "linear1"), 0), "linear2"))
    np.testing.assert_allclose(layer.apply({"params": params}, x, memory, None, 0)[0], y, rtol=1e-4, atol=1e-5)


def test_decoder_reads_its_memory_as_a_set():
    decoder, variables = decoder_and_params()
    decode = jax.jit(decoder.apply)
    x, memory = jax.random.normal(jax.random.key(3), (2, 5, 8)), jax.random.normal(jax.random.key(4), (2, 7, 8))
    want = decode(variables, x, memory)
    np.testing.assert_allclose(decode(variables, x, memory[:, ::-1]), want, atol=1e-5)
    assert not np.allclose(decode(variables, x, 2 * memory), want, atol=1e-2)


def test_decoder_dropout_of_a_sample_follows_its_key():
    decoder, variables = decoder_and_params()
    decode = jax.jit(decoder.apply)
    x, memory = jax.random.normal(jax.random.key(3), (2, 5, 8)), jax.random.normal(jax.random.key(4), (2, 7, 8))
    keys = jax.random.split(jax.random.key(5), 2)
    dropped = decode(variables, x, memory, keys)
    np.testing.assert_allclose(decode(variables, x[::-1], memory[::-1], keys[::-1])[::-1], dropped, atol=1e-5)
    assert not np.allclose(decode(variables, x, memory), dropped, atol=1e-2)


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_large_weights_are_worked_out_head_by_head_and_mix_the_same(monkeypatch, rate):
    layer = attention.Attention(2, rate)
    x, memory = (jax.random.normal(jax.random.key(seed), (3, length, 8)) for seed, length in ((0, 5), (1, 7)))
    keys = jax.random.split(jax.random.key(2), 3)
    variables = init.fill(jax.eval_shape(layer.init, jax.random.key(0), x, memory, None, 0), jax.random.key(3))

    def scored(variables, x, memory):
        y = layer.apply(variables, x, memory, keys, 4)
        return (y**2).sum(), y

    def everything():
        results = jax.jit(jax.value_and_grad(scored, argnums=(0, 1, 2), has_aux=True))(variables, x, memory)
        return results, jax.jvp(lambda x: scored(variables, x, memory)[0], (x,), (jnp.ones_like(x),))

    program = lambda: str(jax.make_jaxpr(lambda *given: scored(*given))(variables, x, memory))
    assert "scan" not in program()
    at_once = everything()
    monkeypatch.setattr(attention, "_LARGE", 0)
    assert "scan" in program()
    chex.assert_trees_all_close(everything(), at_once, rtol=1e-5, atol=1e-5)
