"""Training steps as the town preset ships them, sizes aside: where windows are cut, and one device against eight."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.config import sizes
from muvo_jax.model import world_model
from muvo_jax.ops import camera, range_view
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import preparation
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

WINDOWS, FRAMES, SEEN = 8, 6, 4
VIEW = config_lib.RangeViewGeometry(rows=32, columns=32)
EPSILON = float(np.finfo(np.float32).eps)


def keys(step, count=64):
    """Of the run whose key is that of `state_of`."""
    return step_lib.sample_keys(jax.random.key(1), step, 0, count, None)


def test_a_window_is_cut_at_a_frame_of_its_own_drawn_anew_in_each_step():
    is_first = np.broadcast_to(np.arange(FRAMES) == 0, (64, FRAMES))
    first, again, other = (np.asarray(step_lib._restarted(is_first, keys(step), FRAMES)) for step in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert first[:, 0].all() and set(first.sum(axis=1)) == {1, 2}  # nowhere, or at one frame more
    at = np.where(first[:, 1:].any(axis=1), 1 + np.argmax(first[:, 1:], axis=1), 0)
    assert set(at) == set(range(FRAMES))  # the last state has seen from one frame to all of them
    np.testing.assert_array_equal(first[::-1], step_lib._restarted(is_first, keys(0)[::-1], FRAMES))
    seen = np.asarray(step_lib._restarted(is_first, keys(0), SEEN))
    assert not seen[:, SEEN:].any() and seen[:, SEEN - 1].any()  # what is imagined has no cut


def test_cuts_of_a_recording_stay():
    cut = np.broadcast_to(np.arange(FRAMES) % 2 == 0, (64, FRAMES))
    assert np.asarray(step_lib._restarted(cut, keys(0), FRAMES))[:, ::2].all()


def test_no_motion_is_learned_across_a_cut():
    config = dataclasses.replace(
        presets.get("tiny"), model=dataclasses.replace(presets.get("tiny").model, heads=("ego_motion",)))
    config = config_lib.override_all(config, {
        "train.restart": True, "train.observe_frames": SEEN, "train.decode_frames": 0, "data.frames": FRAMES})
    model = world_model.WorldModel(config.model)
    shapes = preparation.expected_batch(config, WINDOWS)
    batch = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    batch = dataclasses.replace(batch, is_first=np.broadcast_to(np.arange(FRAMES) == 0, (WINDOWS, FRAMES)))
    variables = model.init(jax.random.key(0), batch)
    ours = keys(0, WINDOWS)
    cut = np.asarray(step_lib._restarted(batch.is_first, ours, SEEN))
    loss = jax.jit(functools.partial(step_lib.forward, model=model, config=config, train=True, axis_name=None))

    def of(where):
        moved = np.where(where[..., None], np.float32([1e6, 1e6, 1e6, 0.0]), np.zeros(4, np.float32))
        _, (terms, _) = loss(variables["params"], variables["batch_stats"],
                             dataclasses.replace(batch, ego_motion=moved), ours)
        return float(terms["ego_motion"])

    assert cut[:, 1:].any()
    assert of(cut) == of(np.zeros_like(cut)) < 1e3 < of(~cut)


def config_of(latent):
    """The town preset with every setting that it ships, at the tiny preset's sizes, and dropout beside them."""
    town, tiny = presets.get("town"), presets.get("tiny").model
    if latent is config_lib.VectorLatent:
        town = config_lib.override(town, "model.latent", "1d")
    switches = {name: value for name, value in vars(town.model.latent).items() if isinstance(value, bool)}
    model = dataclasses.replace(
        town.model, latent=dataclasses.replace(sizes.of("tiny", latent), **switches),
        fusion=dataclasses.replace(sizes.of("tiny", config_lib.TransformerFusion), dropout=0.2),
        first_guess=dataclasses.replace(town.model.first_guess, memory_frames=SEEN, guided_channels=(8, 8, 8)),
        range_view=VIEW, convolution="xla", **{name: getattr(tiny, name) for name in (
            "image_size", "voxels", "backbone_width", "decoder_channels", "occupancy_channels")})
    return dataclasses.replace(
        town, model=model, data=dataclasses.replace(town.data, frames=FRAMES),
        loss=dataclasses.replace(town.loss, chamfer_points=16),
        train=dataclasses.replace(town.train, batch=WINDOWS, observe_frames=SEEN))


def batch_of(model):
    """Windows on roads among walls; window i knows fewer voxels than i - 1, so a mean over devices is another one."""
    random, lead = np.random.default_rng(0), (WINDOWS, FRAMES)
    beams = range_view.beam_directions(VIEW)
    walls_m = random.uniform(4.0, 15.0, (*lead, 1, VIEW.columns)) / np.sqrt(1.0 - beams[..., 2] ** 2)
    range_m = np.minimum(walls_m, VIEW.position_m[2] / np.maximum(-beams[..., 2], 1e-3))
    scan = np.concatenate([beams * range_m[..., None] + np.array(VIEW.position_m), range_m[..., None]], axis=-1)
    occupancy = (random.random((*lead, *model.voxels.shape)) < 0.1).astype(np.uint8)
    unknown = random.random(occupancy.shape) < np.linspace(0.0, 0.9, WINDOWS)[:, None, None, None, None]
    occupancy[unknown] = types.OCCUPANCY_UNKNOWN
    intrinsics = camera.intrinsics_from_fov(model.image_size[1], model.image_size[0], 1.4)
    return types.Batch(
        action=random.uniform(-1, 1, (*lead, 2)).astype(np.float32),
        is_first=np.broadcast_to(np.arange(FRAMES) == 0, lead).copy(),
        image=random.integers(0, 256, (*lead, *model.image_size, 3), np.uint8),
        range_view=scan.astype(np.float32), occupancy=occupancy,
        route_map=random.integers(0, 2, (*lead, *world_model.ROUTE_MAP_SIZE), np.uint8) * np.uint8(255),
        speed_mps=random.uniform(0, 10, lead).astype(np.float32),
        intrinsics=np.stack([intrinsics.astype(np.float32)] * WINDOWS),
        camera_to_ego=np.stack([np.float32(camera.level_camera_to_ego((1.0, 0.0, 1.8)))] * WINDOWS)).validate()


def state_of(model, config, batch):
    """Not fresh: where the last layers are zero, nothing before them has a gradient."""
    random = np.random.default_rng(1)
    move = lambda leaf: leaf + 0.05 * random.normal(size=leaf.shape).astype(np.float32)
    variables = model.init(jax.random.key(1), batch)
    variables["params"] = jax.tree.map(move, variables["params"])
    return state_lib.create(variables, optimizer_lib.make_optimizer(config.optimizer, 1), jax.random.key(1))


def distances(one, other):
    """Of two trees: name of a leaf -> norm of the difference."""
    apart = jax.tree.map(lambda a, b: np.linalg.norm(np.ravel(np.float64(a) - np.float64(b))), one, other)
    return {jax.tree_util.keystr(path): value for path, value in jax.tree_util.tree_leaves_with_path(apart)}


@pytest.mark.slow
@pytest.mark.usefixtures("fast_compilation")
@pytest.mark.parametrize("latent", [config_lib.TokenLatent, config_lib.VectorLatent])
def test_eight_devices_give_the_gradients_of_one(latent):
    """Gradients, running statistics and metrics, leaf by leaf, within what the rounding of float32 leaves open.

    Two parts: what one device answers to its windows in another order (the same sums, added up differently, and all
    that follows), once for each of the partial sums; and the rounding of n additions inside a window, which devices
    compile differently: sqrt(n) times half a unit in the last place, n the pixels and voxels of a leaf's longest sum.
    A fault as small as two windows that draw each other's randomness is a hundred times that in every gradient, but for
    those of the ranges' decoder: an L1 and offsets from beams tell least of it (37 times, the half-size view's bias).
    """
    config = config_of(latent)
    model = world_model.WorldModel(config.model)
    batch = batch_of(config.model)
    state, windows = state_of(model, config, batch), np.arange(WINDOWS)
    differentiate = jax.jit(jax.value_and_grad(functools.partial(
        step_lib.forward, model=model, config=config, train=True, axis_name=None), has_aux=True))

    def alone(order, order_of_keys):
        some = jax.tree.map(lambda leaf: leaf[order], batch)
        (_, (metrics, batch_stats)), gradients = differentiate(
            state.params, state.batch_stats, some, keys(0, WINDOWS)[order_of_keys])
        return gradients, batch_stats, metrics

    plan = parallel_lib.make_plan("auto", WINDOWS, jax.devices()[:WINDOWS])
    assert len(plan.devices) == WINDOWS
    compiled = parallel_lib.spread(plan, step_lib.gradient_body(model, config))
    many = compiled(parallel_lib.place_state(plan, state), parallel_lib.place_batch(plan, batch, 1))

    one = alone(windows, windows)
    size = distances(one, jax.tree.map(jnp.zeros_like, one))
    assert all(np.isfinite(value) for value in size.values())
    orders = (windows[::-1], np.roll(windows, 3), np.roll(windows, 5))
    others = [distances(one, alone(order, order)) for order in orders]
    additions = WINDOWS * SEEN * max(np.prod(config.model.image_size), np.prod(config.model.voxels.shape))
    rounding = {name: WINDOWS * max(other[name] for other in others) + 0.5 * EPSILON * np.sqrt(additions) * size[name]
                for name in size}
    apart = distances(one, many)
    assert not {name: (apart[name], rounding[name]) for name in size if apart[name] > rounding[name]}

    faulty = distances(one, alone(windows, np.array([*windows[:-2], 7, 6])))
    # A bias in front of a BatchNorm has a true gradient of zero: all of it is rounding.
    gradients = [name for name in size if name.startswith("[0]") and size[name] > rounding[name]]
    assert len(gradients) > 0.95 * len(jax.tree.leaves(one[0]))
    least = lambda name: 10 if "decoders_range_view" in name else 100
    assert not {name: (faulty[name], rounding[name]) for name in gradients
                if faulty[name] < least(name) * rounding[name]}
