"""One step, three ways to spread it: equal raw gradients, one trace, exact replay.

Gradients are compared before the optimiser (Adam hides a wrong factor), with sampled latents, dropout and prior dropout
on, and with windows whose masks differ, so that a mean of per-device means would be another number. The tolerance is a
share of the global norm: a bias in front of a BatchNorm has a true gradient of zero.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import small_world

from muvo_jax import config as config_lib
from muvo_jax.model import rollout
from muvo_jax.training import checkpoint
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

TOLERANCE = 1e-5
FEW = ("image", "action")
TRACES = []


class CountedWorld(small_world.SmallWorld):
    """Notes every trace of its first step."""

    def initial_state(self, batch_size):
        TRACES.append(batch_size)
        return super().initial_state(batch_size)


@functools.cache
def setting(accumulate=1, heads=config_lib.HEADS):
    """Model, config, batch and a fresh state; fewer heads where a test is not about the losses (compiling is slow)."""
    config = small_world.make_config(accumulate, heads=heads)
    model, batch = CountedWorld(config.model), small_world.make_batch(config.model)
    return model, config, batch, fresh(model, config)


def fresh(model, config):
    return state_lib.create(model.init(), optimizer_lib.of_config(config), jax.random.key(1))


def gradients_under(mode, model, config, batch, state):
    """Gradients, running statistics and metrics of one step, as NumPy."""
    count = 1 if mode == "single" else config.train.batch
    plan = parallel_lib.make_plan("auto" if mode == "single" else mode, config.train.batch, jax.devices()[:count],
                                  share_state=config.train.share_state)
    assert (plan.mode, len(plan.devices)) == (mode, count)
    compiled = parallel_lib.spread(plan, step_lib.gradient_body(model, config), shared=lambda state: state.params)
    placed = parallel_lib.place_batch(plan, batch, config.optimizer.accumulate)
    return jax.tree.map(np.asarray, compiled(parallel_lib.place_state(plan, state), placed))


def assert_same_gradients(got, want):
    """Gradients within a share of their global norm; statistics and metrics within float32 noise."""
    norm = float(optax.global_norm(want[0]))
    assert norm > 1e-3
    worst = max(jax.tree.leaves(jax.tree.map(lambda a, b: np.abs(a - b).max(), got[0], want[0])))
    assert worst < TOLERANCE * norm
    for one, other in zip(jax.tree.leaves(got[1:]), jax.tree.leaves(want[1:]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


@functools.cache
def gradients_of_one_device(accumulate, heads):
    return gradients_under("single", *setting(accumulate, heads))


@pytest.mark.parametrize("mode", ["pmap", "shard_map"])
def test_many_devices_give_the_gradients_of_one(mode):
    assert jax.device_count() >= small_world.WINDOWS
    assert_same_gradients(gradients_under(mode, *setting()), gradients_of_one_device(1, config_lib.HEADS))


def test_accumulation_is_spread_alike():
    assert_same_gradients(gradients_under("shard_map", *setting(2, FEW)), gradients_of_one_device(2, FEW))


@pytest.fixture
def small_shares(monkeypatch):
    """The arrays of a small model are shared too."""
    monkeypatch.setattr(parallel_lib, "LEAST_SHARED", 64)


@pytest.mark.usefixtures("small_shares")
@pytest.mark.parametrize(("accumulate", "heads"), [(1, config_lib.HEADS), (2, FEW)])
def test_devices_that_share_the_state_get_the_gradients_of_one(accumulate, heads):
    model, config, batch, state = setting(accumulate, heads)
    config = config_lib.override(config, "train.share_state", True)
    assert_same_gradients(gradients_under("shard_map", model, config, batch, state),
                          gradients_of_one_device(accumulate, heads))


@pytest.mark.usefixtures("small_shares")
def test_a_shared_state_is_in_parts_and_learns_what_one_device_learns():
    model, config, _, _ = setting(heads=FEW)
    count, shared = 4, config_lib.override(config, "train.share_state", True)
    steps = {1: step_lib.make_train_step(model, config, devices=jax.devices()[:1]),
             count: step_lib.make_train_step(model, shared, devices=jax.devices()[:count])}
    assert steps[count].plan.describe().endswith("4 cpu devices, which share the state")
    states = {1: fresh(model, config), count: fresh(model, shared)}
    for seed in range(4):
        losses = []
        for devices, step in steps.items():
            states[devices], metrics = step(states[devices], small_world.make_batch(model.config, seed=seed))
            losses.append({name: float(value) for name, value in metrics.items()})
        assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    large = lambda leaf: leaf.size >= parallel_lib.LEAST_SHARED and any(size % count == 0 for size in leaf.shape)
    parts = [leaf.addressable_shards[0].data.size / leaf.size
             for leaf in jax.tree.leaves((states[count].params, states[count].opt_state)) if large(leaf)]
    assert len(parts) > 10 and set(parts) == {1 / count}


@pytest.mark.usefixtures("small_shares")
def test_a_shared_state_moves_to_other_devices_through_a_checkpoint(tmp_path):
    model, config, batch, _ = setting(heads=FEW)
    shared = config_lib.override(config, "train.share_state", True)
    state, _ = step_lib.make_train_step(model, shared, devices=jax.devices()[:4])(fresh(model, shared), batch)
    keeper = checkpoint.Checkpoints(tmp_path)
    keeper.save(1, state, config=shared)
    for devices in (1, 8):
        other = step_lib.make_train_step(model, shared, devices=jax.devices()[:devices])
        like = parallel_lib.place_state(other.plan, fresh(model, shared))
        found = keeper.restore_latest(like, shared).state
        for one, want, place in zip(*map(jax.tree.leaves, (found, state, like)), strict=True):
            assert one.sharding == place.sharding
            if not jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
                np.testing.assert_array_equal(one, want)
    with pytest.raises(ValueError, match=r"share_state=True.*cannot go on with False.*--init"):
        keeper.restore_latest(fresh(model, config), config)
    keeper.close()


def test_accumulation_averages_the_gradients_of_its_micro_batches():
    model, config, batch, state = setting(2, FEW)
    body = jax.jit(functools.partial(jax.value_and_grad(step_lib.forward, has_aux=True), model=model, config=config,
                                     train=True, axis_name=None))
    batch_stats, parts = state.batch_stats, []
    for index in range(2):
        keys = step_lib.sample_keys(state.key, state.step, index, 4, None)
        (_, (_, batch_stats)), gradients = body(state.params, batch_stats, batch[4 * index:4 * index + 4], keys)
        parts.append(gradients)
    mean = jax.tree.map(lambda a, b: (a + b) / 2, *parts)
    got_gradients, got_stats, _ = gradients_of_one_device(2, FEW)
    norm = float(optax.global_norm(mean))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=TOLERANCE * norm), got_gradients, mean)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), got_stats, batch_stats)


@functools.cache
def compiled_step():
    model, config, _, _ = setting(heads=FEW)
    return step_lib.make_train_step(model, config, parallel="shard_map", devices=jax.devices()[:2])


def copy_of(state):
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), state)


def test_one_trace_serves_many_steps():
    model, _, batch, state = setting(heads=FEW)
    step, state = compiled_step(), copy_of(state)
    state, _ = step(state, batch)
    traced = len(TRACES)
    for seed in range(3):
        state, metrics = step(state, small_world.make_batch(model.config, seed=seed))
    state, metrics = step(state, step.place(batch))
    assert len(TRACES) == traced
    assert int(state.step) == 5
    assert float(metrics["finite"]) == 1.0
    assert float(metrics["update_norm"]) > 0.0


def test_a_step_replays_exactly_from_its_state():
    _, _, batch, state = setting(heads=FEW)
    step = compiled_step()
    state, _ = step(copy_of(state), batch)
    (first, first_metrics), (second, second_metrics) = step(copy_of(state), batch), step(copy_of(state), batch)
    for one, other in zip(jax.tree.leaves((first.variables, first_metrics)),
                          jax.tree.leaves((second.variables, second_metrics)), strict=True):
        np.testing.assert_array_equal(one, other)
    # Another step number draws other noise and dropout: the loss of the same batch differs.
    _, later_metrics = step(copy_of(state).replace(step=jnp.int32(7)), batch)
    assert float(later_metrics["total"]) != float(first_metrics["total"])


def test_a_loss_that_is_not_finite_changes_nothing_but_the_step():
    _, _, batch, state = setting(heads=FEW)
    broken = batch.replace(action=np.full_like(batch.action, np.nan))
    after, metrics = compiled_step()(copy_of(state), broken)
    assert float(metrics["finite"]) == 0.0
    assert int(after.step) == 1
    jax.tree.map(np.testing.assert_array_equal, after.variables, state.variables)


def test_an_update_that_is_not_finite_is_not_applied_though_loss_and_gradients_are():
    _, _, batch, state = setting(heads=FEW)
    broken = optax.tree_utils.tree_set(state.opt_state, eps=jnp.float32(np.nan))
    after, metrics = compiled_step()(copy_of(state).replace(opt_state=copy_of(broken)), batch)
    assert np.isfinite([float(metrics["total"]), float(metrics["gradient_norm"])]).all()
    assert float(metrics["finite"]) == 0.0 and np.isnan(float(metrics["update_norm"]))
    jax.tree.map(np.testing.assert_array_equal, after.variables, state.variables)


def test_the_logged_rate_is_the_applied_one_after_a_skipped_step_too():
    _, config, batch, state = setting(heads=FEW)
    broken = batch.replace(action=np.full_like(batch.action, np.nan))
    logged, state = [], copy_of(state)
    for given in (batch, broken, batch):
        state, metrics = compiled_step()(state, given)
        logged.append(float(metrics["learning_rate"]))
    rate = optimizer_lib.learning_rate(config.optimizer, config.train.steps)
    np.testing.assert_allclose(logged, [rate(0), rate(0), rate(1)], rtol=1e-6)
    assert logged[1] != logged[2] == float(state.opt_state.hyperparams["learning_rate"])


@pytest.mark.parametrize("leaf_by_leaf", [False, True])
def test_the_rate_is_found_behind_clipping(leaf_by_leaf):
    config = config_lib.OptimizerConfig(clip_norm=1.0)
    optimizer = optimizer_lib.make_optimizer(config, 10, leaf_by_leaf=leaf_by_leaf)
    state = optimizer.init({"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2)})
    np.testing.assert_allclose(step_lib._applied_rate(state), optimizer_lib.learning_rate(config, 10)(0), rtol=1e-6)


def test_validation_agrees_over_devices_and_neither_drops_out_nor_learns():
    model, config, batch, state = setting(1, FEW)
    validate = {count: step_lib.make_validation_step(model, config, devices=jax.devices()[:count]) for count in (1, 4)}
    before = validate[1](state, batch)
    spread = validate[4](state, batch)
    assert set(spread) == set(before)
    for name in before:
        np.testing.assert_allclose(spread[name], before[name], rtol=1e-4, err_msg=name)
    jax.tree.map(np.testing.assert_array_equal, validate[1](state.replace(step=jnp.int32(3)), batch), before)


def test_plans():
    devices = jax.devices()[:4]
    assert parallel_lib.make_plan("auto", 4, devices).mode == "shard_map"
    assert len(parallel_lib.make_plan("auto", 6, devices).devices) == 3
    assert parallel_lib.make_plan("auto", 1, devices).mode == "single"
    assert parallel_lib.make_plan("auto", 4, devices[:1]).describe() == "one cpu device"
    assert parallel_lib.make_plan("pmap", 4, devices).describe() == "pmap over 4 cpu devices"
    with pytest.raises(ValueError, match="multiple of 4"):
        parallel_lib.make_plan("pmap", 6, devices)
    with pytest.raises(ValueError, match="expected one of"):
        parallel_lib.make_plan("pjit", 4, devices)
    with pytest.raises(ValueError, match="every device holds the state whole"):
        parallel_lib.make_plan("pmap", 4, devices, share_state=True)
    with pytest.raises(ValueError, match="multiple of 6"):
        parallel_lib.place_batch(parallel_lib.make_plan("auto", 2, devices[:2]), setting()[2], 3)


def test_some_frames_of_each_window_are_decoded_and_others_in_the_next_step():
    _, _, batch, _ = setting(heads=FEW)
    features = np.arange(small_world.WINDOWS * 3, dtype=np.float32).reshape(small_world.WINDOWS, 3, 1)
    draws = []
    for step in (0, 0, 1):
        keys = step_lib.sample_keys(jax.random.key(1), step, 0, small_world.WINDOWS, None)
        picked, some = step_lib._some_frames(features, batch, keys, 2)
        frames = np.asarray(picked[..., 0], np.int64) - 3 * np.arange(small_world.WINDOWS)[:, None]
        assert frames.shape == (small_world.WINDOWS, 2) and (frames[:, 0] != frames[:, 1]).all()
        for window, chosen in enumerate(frames):
            np.testing.assert_array_equal(some.action[window], batch.action[window, chosen])
            np.testing.assert_array_equal(some.image[window], batch.image[window, chosen])
        draws.append(frames)
    np.testing.assert_array_equal(draws[0], draws[1])
    assert (draws[0] != draws[2]).any()
    everything, same = step_lib._some_frames(features, batch, keys, 0)
    assert everything is features and same is batch


def test_imagined_frames_follow_from_the_last_observed_one():
    model, config, batch, state = setting(heads=FEW)
    keys = step_lib.sample_keys(jax.random.key(1), 0, 0, small_world.WINDOWS, None)

    @jax.jit
    def walk(variables, batch):
        observed, _ = rollout.observe_window(model, variables, batch.time_slice(0, 2), keys, train=True)
        return observed, step_lib._and_imagined(model, variables, observed, batch.action, keys).features

    observed, features = walk(state.variables, batch)
    # By hand: action[1] leads from the last observed frame, 1, to frame 2; h does not depend on the noise.
    noise = jnp.zeros_like(observed.last.stochastic)
    expected, _ = model.imagine_step(state.variables, noise, observed.last, batch.action[:, 1])
    deterministic = config.model.latent.deterministic_channels
    np.testing.assert_array_equal(features[:, :2], observed.states.features)
    np.testing.assert_allclose(features[:, 2, :deterministic], expected.deterministic, rtol=1e-5, atol=1e-6)


def test_only_the_observed_frames_reach_the_encoder():
    model, config, batch, state = setting(heads=FEW)
    keys = step_lib.sample_keys(jax.random.key(1), 0, 0, small_world.WINDOWS, None)
    statistics = jax.jit(lambda some: step_lib.forward(
        state.params, state.batch_stats, some, keys, model=model, config=config, train=True, axis_name=None)[1][1])
    unseen = batch.replace(range_view=np.concatenate([batch.range_view[:, :2], 0 * batch.range_view[:, 2:]], axis=1))
    seen = batch.replace(range_view=np.concatenate([0 * batch.range_view[:, :2], batch.range_view[:, 2:]], axis=1))
    before = jax.tree.leaves(statistics(batch))
    for one, other in zip(before, jax.tree.leaves(statistics(unseen)), strict=True):
        np.testing.assert_array_equal(one, other)
    assert any((np.asarray(one) != np.asarray(other)).any()
               for one, other in zip(before, jax.tree.leaves(statistics(seen)), strict=True))
