"""Freezing: which paths a pattern means, and that what is frozen neither moves nor counts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.nn import norm
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import preparation, trainable
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

PARAMS = {"camera": {"stem": {"kernel": 1.0, "bias": 2.0}, "norm": {"scale": 3.0}}, "fusion": {"kernel": 4.0},
          "decoders_image": {"kernel": 5.0}, "decoders_action": {"kernel": 6.0}}


@pytest.mark.parametrize(("patterns", "trained"), [
    ("*", {1.0, 2.0, 3.0, 4.0, 5.0, 6.0}),
    ("decoders_*", {5.0, 6.0}),
    ("!camera", {4.0, 5.0, 6.0}),
    ("camera/stem", {1.0, 2.0}),
    ("*/kernel", {1.0, 4.0, 5.0, 6.0}),
    ("!camera, camera/norm", {3.0, 4.0, 5.0, 6.0}),
    ("decoders_*,!decoders_image", {6.0}),
])
def test_the_last_pattern_that_fits_decides(patterns, trained):
    chosen = trainable.chosen(PARAMS, patterns)
    trains, frozen = trainable.split(PARAMS, chosen)
    assert set(jax.tree.leaves(trains)) == trained
    assert set(jax.tree.leaves(frozen)) == {1.0, 2.0, 3.0, 4.0, 5.0, 6.0} - trained
    assert trainable.merge(trains, frozen) == PARAMS


@pytest.mark.parametrize(("patterns", "message"), [
    ("decoder_image", r"'decoder_image' fits no parameter.*Did you mean decoders_image.*parts are camera, decoders"),
    ("!camera/sten", r"'camera/sten' fits no parameter.*Did you mean camera/stem"),
    ("", r"'' fits no parameter"),
    ("*,!*", r"trainable=\*,!\*: nothing is left to train"),
])
def test_patterns_that_mean_nothing_are_refused(patterns, message):
    with pytest.raises(ValueError, match=message):
        trainable.chosen(PARAMS, patterns)


def test_a_run_is_refused_before_anything_is_recorded_or_compiled():
    config = config_lib.override(presets.tiny(), "train.trainable", "!decoder_image")
    with pytest.raises(ValueError, match=r"train\.trainable: 'decoder_image' .* Did you mean decoders_image"):
        preparation.check_trainable(config)
    preparation.check_trainable(config_lib.override(config, "train.trainable", "!decoders_image"))


@functools.cache
def after_three_updates():
    """(before, after, metrics of the last) of a model whose camera half is frozen; two micro-batches an update."""
    config = small_world.make_config(accumulate=2, heads=("action",))
    config = config_lib.override(config, "train.trainable", "!convolution,!norm")
    model, batch = small_world.SmallWorld(config.model), small_world.make_batch(config.model)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    state = state_lib.create(model.init(), optimizer, jax.random.key(1), config.train.trainable)
    step = step_lib.make_train_step(model, config, devices=jax.devices()[:1])
    before = jax.device_get((state.params, state.batch_stats, state.opt_state))
    for _ in range(3):
        state, metrics = step(state, batch)
    return before, jax.device_get((state.params, state.batch_stats, state.opt_state)), jax.device_get(metrics)


def test_what_is_frozen_stays_bit_for_bit_and_the_rest_moves():
    (params, batch_stats, _), (new_params, new_stats, _), metrics = after_three_updates()
    assert metrics["finite"] == 1.0
    for part in params:
        moved = [not np.array_equal(one, other) for one, other in zip(
            jax.tree.leaves(params[part]), jax.tree.leaves(new_params[part]), strict=True)]
        assert not any(moved) if part in ("convolution", "norm") else any(moved), part
    jax.tree.map(np.testing.assert_array_equal, new_stats["norm"], batch_stats["norm"])
    assert not np.array_equal(new_stats["range_norm"]["mean"], batch_stats["range_norm"]["mean"])


def test_what_is_frozen_has_neither_moments_nor_a_share_in_the_norms():
    (params, _, opt_state), _, metrics = after_three_updates()
    trained = [leaf for part, tree in params.items() if part not in ("convolution", "norm")
               for leaf in jax.tree.leaves(tree)]
    moments = sum(leaf.size for leaf in jax.tree.leaves(opt_state) if leaf.ndim)
    assert moments == 2 * sum(leaf.size for leaf in trained)
    expected = np.sqrt(sum(np.square(leaf, dtype=np.float64).sum() for leaf in trained))
    assert metrics["parameter_norm"] == pytest.approx(expected, rel=0.05)


class TwoNorms(linen.Module):
    def setup(self):
        self.one, self.other = norm.BatchNorm(), norm.BatchNorm()

    def __call__(self, x, mode):
        return self.one(x, mode), self.other(x, mode)


def test_a_frozen_batch_norm_works_on_its_running_statistics():
    x = jnp.linspace(1.0, 9.0, 12).reshape(6, 2)
    module = TwoNorms()
    variables = module.init(jax.random.key(0), x, norm.Mode())
    variables["params"] = jax.tree.map(jnp.ones_like, variables["params"])
    apply = lambda train: module.apply(variables, x, norm.Mode(train), mutable=["batch_stats"])
    (trained, _), moved = apply(True)
    (still, _), stayed = apply(False)
    trains = {"one": {"scale": True, "bias": True}, "other": {"scale": False, "bias": False}}
    with trainable.frozen_norms(trains):
        (one, other), updated = apply(True)
    np.testing.assert_array_equal(one, trained)
    np.testing.assert_array_equal(other, still)
    jax.tree.map(np.testing.assert_array_equal, updated["batch_stats"]["one"], moved["batch_stats"]["one"])
    jax.tree.map(np.testing.assert_array_equal, updated["batch_stats"]["other"], stayed["batch_stats"]["other"])
    assert not np.allclose(trained, still)
    jax.tree.map(np.testing.assert_array_equal, apply(True)[0][1], trained)  # the context is over


def test_gradients_are_those_of_a_step_that_trains_everything():
    config = small_world.make_config(heads=("action",))
    model, batch = small_world.SmallWorld(config.model), small_world.make_batch(config.model)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, 1)
    state = state_lib.create(model.init(), optimizer, jax.random.key(1))

    def gradients(patterns):
        some = dataclasses.replace(config, train=dataclasses.replace(config.train, trainable=patterns))
        body = jax.jit(lambda state, batch: step_lib.gradient_body(model, some)(state, batch, None)[0])
        return body(state, jax.tree.map(lambda leaf: leaf[None], batch))

    some, everything = gradients("!transition"), gradients("*")
    assert not jax.tree.leaves(some["transition"]) and jax.tree.leaves(everything["transition"])
    for part in set(some) - {"transition"}:
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-7), some[part], everything[part])
