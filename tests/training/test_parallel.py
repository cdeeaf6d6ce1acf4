"""One step, three ways to spread it: equal raw gradients, one trace, exact replay.

Gradients are compared before the optimiser (Adam hides a wrong factor), with sampled latents, dropout and prior dropout on,
and with windows whose masks differ, so that a mean of per-device means would be another number. The tolerance is a share
of the global norm: a bias in front of a BatchNorm has a true gradient of zero.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from muvo_jax import presets, types
from muvo_jax.model import world_model
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

WINDOWS = 8
TOLERANCE = 2e-5


def make_config(accumulate=1):
    config = presets.tiny()
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, dropout=0.2, prior_dropout=0.5),
        data=dataclasses.replace(config.data, frames=3),
        train=dataclasses.replace(config.train, batch=WINDOWS // accumulate),
        optimizer=dataclasses.replace(config.optimizer, accumulate=accumulate),
        loss=dataclasses.replace(config.loss, chamfer=0.1, chamfer_points=32))


def make_batch(model_config, frames=3, seed=0):
    """Random windows; window i has more holes and unknown voxels than window i - 1, and window 0 has none."""
    generator = np.random.default_rng(seed)
    prefix, share = (WINDOWS, frames), np.linspace(0.0, 0.9, WINDOWS)
    rows, columns = model_config.range_view.rows, model_config.range_view.columns
    points = generator.normal(size=(*prefix, rows, columns, 3)).astype(np.float32) * 10
    range_view = np.concatenate([points, np.linalg.norm(points, axis=-1, keepdims=True)], axis=-1)
    holes = generator.random((*prefix, rows, columns)) < share[:, None, None, None]
    range_view[holes] = (0, 0, 0, types.RANGE_NO_RETURN_M)
    voxels = generator.random((*prefix, *model_config.voxels.shape))
    occupancy = (voxels < 0.1).astype(np.uint8)
    unknown = generator.random(voxels.shape) < share[:, None, None, None, None]
    occupancy[unknown] = types.OCCUPANCY_UNKNOWN
    return types.Batch(
        action=generator.uniform(-1, 1, (*prefix, 2)).astype(np.float32),
        is_first=np.broadcast_to(np.arange(frames) == 0, prefix).copy(),
        image=generator.integers(0, 256, (*prefix, *model_config.image_size, 3), np.uint8),
        range_view=range_view, occupancy=occupancy,
        route_map=generator.integers(0, 2, (*prefix, 64, 64), np.uint8) * np.uint8(255),
        speed_mps=generator.uniform(0, 10, prefix).astype(np.float32)).validate()


@functools.cache
def setting(accumulate=1):
    """Model, config, batch and a fresh state; the two-step tests share one compiled step per setting."""
    config = make_config(accumulate)
    model = world_model.WorldModel(config.model)
    batch = make_batch(config.model)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    state = state_lib.create(model.init(jax.random.key(0), batch), optimizer, jax.random.key(1))
    return model, config, batch, state


@functools.cache
def spread_gradients(mode, accumulate=1):
    """Gradients, running statistics and metrics of one step under `mode`, as NumPy."""
    model, config, batch, state = setting(accumulate)
    if mode == "single":
        plan = parallel_lib.make_plan("auto", 1, jax.devices()[:1])
    else:
        plan = parallel_lib.make_plan(mode, WINDOWS // accumulate, jax.devices()[:WINDOWS // accumulate])
    assert plan.mode == mode
    compiled = parallel_lib.spread(plan, step_lib.gradient_body(model, config))
    out = compiled(parallel_lib.place_state(plan, state), parallel_lib.place_batch(plan, batch, accumulate))
    return jax.tree.map(np.asarray, out)


def largest_difference(got, want):
    leaves = jax.tree.leaves(jax.tree.map(lambda a, b: np.abs(a - b).max(), got, want))
    return max(leaves)


@pytest.mark.parametrize("mode", ["pmap", "shard_map"])
def test_eight_devices_give_the_gradients_of_one(mode):
    assert jax.device_count() >= WINDOWS
    gradients, batch_stats, metrics = spread_gradients(mode)
    want_gradients, want_stats, want_metrics = spread_gradients("single")
    norm = float(optax.global_norm(want_gradients))
    assert norm > 1e-3
    assert largest_difference(gradients, want_gradients) < TOLERANCE * norm
    assert largest_difference(batch_stats, want_stats) < 1e-4
    for name, value in want_metrics.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-4, err_msg=name)


@functools.cache
def compiled_step():
    model, config, _, _ = setting()
    return step_lib.make_train_step(model, config, parallel="shard_map", devices=jax.devices()[:2])


def copy_of(state):
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), state)


def test_one_trace_serves_many_steps():
    model, _, batch, state = setting()
    step, traces = compiled_step(), []
    state = copy_of(state)
    for index in range(3):
        state, metrics = step(state, make_batch(model.config, seed=index))
        traces.append(step.compiled._cache_size())
    assert traces == [1, 1, 1]
    assert int(state.step) == 3
    assert float(metrics["finite"]) == 1.0
    # A batch that was placed ahead is the same batch.
    step(state, step.place(batch))
    assert step.compiled._cache_size() == 1


def test_a_step_replays_exactly_from_its_state():
    _, _, batch, state = setting()
    step = compiled_step()
    state, _ = step(copy_of(state), batch)
    (first, first_metrics), (second, second_metrics) = step(copy_of(state), batch), step(copy_of(state), batch)
    for one, other in zip(jax.tree.leaves((first.variables, first_metrics)),
                          jax.tree.leaves((second.variables, second_metrics)), strict=True):
        np.testing.assert_array_equal(one, other)
    # Another step number is another draw of noise and dropout: the loss of the same batch differs.
    _, later_metrics = step(copy_of(state).replace(step=jnp.int32(7)), batch)
    assert float(later_metrics["total"]) != float(first_metrics["total"])


def test_a_loss_that_is_not_finite_changes_nothing_but_the_step():
    _, _, batch, state = setting()
    broken = batch.replace(speed_mps=np.full_like(batch.speed_mps, np.nan))
    after, metrics = compiled_step()(copy_of(state), broken)
    assert float(metrics["finite"]) == 0.0
    assert int(after.step) == 1
    jax.tree.map(np.testing.assert_array_equal, after.variables, state.variables)


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
    with pytest.raises(ValueError, match="multiple of 6"):
        parallel_lib.place_batch(parallel_lib.make_plan("auto", 2, devices[:2]), setting()[2], 3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["pmap", "shard_map"])
def test_accumulation_is_spread_the_same_way(mode):
    gradients, _, metrics = spread_gradients(mode, accumulate=2)
    want_gradients, _, want_metrics = spread_gradients("single", accumulate=2)
    norm = float(optax.global_norm(want_gradients))
    assert largest_difference(gradients, want_gradients) < TOLERANCE * norm
    np.testing.assert_allclose(metrics["total"], want_metrics["total"], rtol=1e-5)
