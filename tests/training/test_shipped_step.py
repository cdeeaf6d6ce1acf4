"""Training steps of a model with a geometric memory: where windows are cut, and one device against eight."""

import dataclasses

import jax
import numpy as np
import optax
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.model import world_model
from muvo_jax.ops import range_view
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

WINDOWS, FRAMES, SEEN = 8, 4, 3
VIEW = config_lib.RangeViewGeometry(rows=32, columns=32)


def keys(step, count=64):
    return step_lib.sample_keys(jax.random.key(1), step, 0, count, None)


def test_a_window_is_cut_at_a_frame_of_its_own_drawn_anew_in_each_step():
    is_first = np.broadcast_to(np.arange(FRAMES) == 0, (64, FRAMES))
    first, again, other = (np.asarray(step_lib._restarted(is_first, keys(step))) for step in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert first[:, 0].all() and set(first.sum(axis=1)) == {1, 2}  # nowhere, or at one frame more
    at = np.where(first[:, 1:].any(axis=1), 1 + np.argmax(first[:, 1:], axis=1), 0)
    assert set(at) == set(range(FRAMES))  # the last state has seen from one frame to all of them
    np.testing.assert_array_equal(first[::-1], step_lib._restarted(is_first, keys(0)[::-1]))


def test_cuts_of_a_recording_stay():
    cut = np.broadcast_to(np.arange(FRAMES) % 2 == 0, (64, FRAMES))
    assert np.asarray(step_lib._restarted(cut, keys(0)))[:, ::2].all()


def config_of():
    tiny = presets.tiny()
    small = dataclasses.replace(
        tiny.model, first_guess=config_lib.LastSeen(memory_frames=2, guided_channels=(8, 8, 8)),
        action_path="recurrence", camera=None, heads=("range_view", "occupancy"), route=False, range_view=VIEW,
        range_view_points="beams")
    return dataclasses.replace(
        tiny, model=small, data=dataclasses.replace(tiny.data, frames=FRAMES),
        train=dataclasses.replace(tiny.train, batch=WINDOWS, observe_frames=SEEN, decode_frames=2, restart=True))


def batch_of(config):
    """Windows on roads among walls; window i knows fewer voxels than i - 1."""
    random, lead = np.random.default_rng(0), (WINDOWS, FRAMES)
    beams = range_view.beam_directions(VIEW)
    walls_m = random.uniform(4.0, 15.0, (*lead, 1, VIEW.columns)) / np.sqrt(1.0 - beams[..., 2] ** 2)
    range_m = np.minimum(walls_m, VIEW.position_m[2] / np.maximum(-beams[..., 2], 1e-3))
    scan = np.concatenate([beams * range_m[..., None] + np.array(VIEW.position_m), range_m[..., None]], axis=-1)
    occupancy = (random.random((*lead, *config.model.voxels.shape)) < 0.1).astype(np.uint8)
    unknown = random.random(occupancy.shape) < np.linspace(0.0, 0.9, WINDOWS)[:, None, None, None, None]
    occupancy[unknown] = types.OCCUPANCY_UNKNOWN
    return types.Batch(action=random.uniform(-1, 1, (*lead, 2)).astype(np.float32),
                       is_first=np.broadcast_to(np.arange(FRAMES) == 0, lead).copy(),
                       range_view=scan.astype(np.float32), occupancy=occupancy,
                       speed_mps=random.uniform(0, 10, lead).astype(np.float32)).validate()


@pytest.mark.slow
def test_eight_devices_give_the_gradients_of_one():
    config = config_of()
    model, batch = world_model.WorldModel(config.model), batch_of(config)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    # Not fresh: where the last layers are zero, nothing before them has a gradient.
    random = np.random.default_rng(1)
    move = lambda leaf: leaf + 0.05 * random.normal(size=leaf.shape).astype(np.float32)
    variables = model.init(jax.random.key(1), batch)
    variables["params"] = jax.tree.map(move, variables["params"])
    state, found = state_lib.create(variables, optimizer, jax.random.key(2)), []
    for devices in (jax.devices()[:1], jax.devices()[:WINDOWS]):
        plan = parallel_lib.make_plan("auto", WINDOWS, devices)
        assert len(plan.devices) == len(devices)
        compiled = parallel_lib.spread(plan, step_lib.gradient_body(model, config))
        placed = parallel_lib.place_batch(plan, batch, 1)
        found.append(jax.tree.map(np.asarray, compiled(parallel_lib.place_state(plan, state), placed)))
    (one, _, metrics), (many, _, _) = found
    assert np.isfinite(metrics["total"])
    norm = float(optax.global_norm(one))
    worst = max(jax.tree.leaves(jax.tree.map(lambda a, b: np.abs(a - b).max(), many, one)))
    assert norm > 1e-3 and worst < 1e-4 * norm
    by_guide = jax.tree.leaves(one["decoders_range_view"])
    assert all(np.abs(leaf).max() > 0 for leaf in by_guide)
