"""The geometric memory: what fresh decoders make of it, what is hidden from them, streams, dreams, slopes, refusals."""

import dataclasses
import functools
import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import planners, rewards
from muvo_jax.model import checks, glimpse, live, memory, rollout, world_model
from muvo_jax.ops import camera, motion, range_view, reproject
from muvo_jax.types import Batch, LatentState

BATCH, FRAMES = 2, 4
GUESSED = ("image", "range_view", "occupancy")
SCANNED = ("range_view", "ego_motion")
VARIANTS = {"1d": {}, "1d-fc": {"fusion": "fc"}, "2d": {"latent": "2d", "latent.aligned_tokens": True}}


def config_of(variant="1d", kinematics="bicycle", memory_frames=2, **model):
    tiny = dataclasses.replace(presets.tiny(), contract=config_lib.ActionContract(kinematics=kinematics))
    small = {"first_guess": config_lib.LastSeen(memory_frames, (8, 8, 8)), "action_path": "recurrence",
             "heads": (*GUESSED, "action"), "route": False, **VARIANTS[variant], **model}
    return config_lib.override_all(tiny, {f"model.{name}": value for name, value in small.items()})


@functools.cache
def model_of(variant="1d", kinematics="bicycle", **model):
    return world_model.WorldModel(config_of(variant, kinematics, **model).model)


@functools.cache
def fresh(model):
    """A new model's variables; the average frame is grey, 20 m away and most likely empty."""
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    grey = {"image": 0.3, "range_view": 0.4, "occupancy": np.float32([0.0, -2.0])}
    average = {name: jax.tree.map(lambda leaf, head=head: jnp.asarray(np.full(leaf.shape, grey[head], np.float32)),
                                  variables["batch_stats"][name])
               for head in GUESSED if (name := f"first_guess_{head}") in variables["batch_stats"]}
    return {**variables, "batch_stats": {**variables["batch_stats"], **average}}


@functools.cache
def trained(model):
    """Variables that differ from fresh ones everywhere, as training leaves them."""
    random = np.random.default_rng(0)
    move = lambda leaf: leaf + 0.05 * random.normal(size=leaf.shape).astype(np.float32)
    return {**fresh(model), "params": jax.tree.map(move, fresh(model)["params"])}


def scans(config, lead):
    """Scans of an uneven room on flat ground, a few pixels of them open, float32 [*lead, Hr, Wr, 4]."""
    random, view = np.random.default_rng(1), config.range_view
    beams = range_view.beam_directions(view)
    bumps = random.uniform(0.0, 2 * np.pi, (*lead, 1, 1)) + np.linspace(0.0, 6 * np.pi, view.columns)[None]
    walls_m = (11.0 + 3.0 * np.sin(bumps)) / np.sqrt(1.0 - beams[..., 2] ** 2)
    road_m = view.position_m[2] / np.maximum(-beams[..., 2], 1e-3)
    range_m = np.minimum(walls_m, road_m)
    range_m = np.where(random.random(range_m.shape) < 0.1, np.nan, range_m)
    scan = np.concatenate([beams * range_m[..., None] + view.position_m, range_m[..., None]], axis=-1)
    return np.where(np.isnan(range_m)[..., None], [0.0, 0.0, 0.0, -1.0], scan).astype(np.float32)


def batch_of(config, batch_size=BATCH, frames=FRAMES, speed_mps=None, **fields):
    """Windows of a car that drives (at about `speed_mps`, standing still at 0) under random actions."""
    random, lead = np.random.default_rng(0), (batch_size, frames)
    standing = speed_mps == 0.0
    action = np.zeros((*lead, 2)) if standing else random.uniform(-1, 1, (*lead, 2))
    speed = np.full(lead, speed_mps) if speed_mps is not None else random.uniform(4, 10, lead)
    intrinsics = camera.intrinsics_from_fov(config.image_size[1], config.image_size[0], 1.4)
    return Batch(**{
        "action": action.astype(np.float32), "is_first": np.broadcast_to(np.arange(frames) == 0, lead).copy(),
        "image": random.integers(0, 256, (*lead, *config.image_size, 3), np.uint8), "range_view": scans(config, lead),
        "speed_mps": speed.astype(np.float32), "intrinsics": np.stack([intrinsics] * batch_size),
        "camera_to_ego": np.stack([camera.level_camera_to_ego((1.0, 0.0, 1.8))] * batch_size), **fields}).validate()


KEY = jax.random.key(5)
look = jax.jit(glimpse.look, static_argnums=(0, 4))


def observe(model, variables, batch, **options):
    return rollout.observe(model, variables, KEY, batch, **options)


def decode(model, variables, observed, states=None, heads=GUESSED, **options):
    states = observed.states if states is None else states
    predictions = rollout.decode(model, variables, states, heads, memory=observed.memory, **options)
    return {head: np.asarray(predictions[head]) for head in heads}


def assert_same(got, want, tolerance=2e-4):
    for head in want:
        near = tolerance * max(1.0, np.abs(want[head]).max())
        np.testing.assert_allclose(got[head], want[head], rtol=1e-3, atol=near, err_msg=head)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_fresh_model_predicts_what_was_last_seen_and_the_average_elsewhere(variant):
    model = model_of(variant)
    batch = batch_of(model.config, speed_mps=0.0)
    observed = observe(model, fresh(model), batch)
    decoded = decode(model, fresh(model), observed)
    np.testing.assert_allclose(decoded["image"][:, 0], 0.3, atol=1e-5)  # the first frame has nothing before it
    np.testing.assert_allclose(decoded["range_view"][:, 0, ..., 3], 20.0, rtol=1e-5)
    np.testing.assert_allclose(np.diff(decoded["occupancy"][:, 0])[..., 0], -2.0, atol=1e-5)
    # Standing still, the frame before is what is seen again.
    np.testing.assert_allclose(decoded["image"][:, 1:, 1:-1, 1:-1], batch.image[:, :-1, 1:-1, 1:-1] / 255.0, atol=5e-3)
    before = batch.range_view[:, :-1]
    returned = before[..., 3] > 0
    np.testing.assert_allclose(decoded["range_view"][:, 1:][returned], before[returned], rtol=1e-2, atol=1e-2)
    # The road is left to the average; above it voxels that were hit are occupied, those looked through are not.
    grid = model.config.voxels
    points_m = before[0, 0][returned[0, 0]][:, :3]
    cells = np.floor((points_m[points_m[:, 2] > 1.0] - grid.origin_m) / grid.voxel_size_m).astype(int)
    cells = cells[((cells >= 0) & (cells < grid.shape)).all(axis=1)]
    gained = np.diff(decoded["occupancy"][0, 1])[..., 0] + 2.0
    assert len(cells) > 50 and gained[tuple(cells.T)].min() > 2.9 and (gained < -2.9).sum() > 50
    road = int(-grid.origin_m[2] // grid.voxel_size_m)
    np.testing.assert_allclose(gained[..., :road + 1], 0.0, atol=1e-5)


def test_an_observation_is_hidden_from_its_own_state_and_shown_to_the_next():
    model = model_of()
    batch = batch_of(model.config)
    changed = batch.replace(image=batch.image.copy(), range_view=batch.range_view.copy())
    changed.image[:, 2], changed.range_view[:, 2] = 255 - batch.image[:, 2], scans(model.config, (BATCH, 9))[:, 8]
    one, other = (decode(model, fresh(model), observe(model, fresh(model), some)) for some in (batch, changed))
    for head in GUESSED:
        np.testing.assert_array_equal(one[head][:, :3], other[head][:, :3], err_msg=head)
        assert (one[head][:, 3] != other[head][:, 3]).any(), head


def test_nothing_is_remembered_across_a_cut():
    model = model_of()
    batch = batch_of(model.config)
    cut = batch.replace(is_first=batch.is_first | (np.arange(FRAMES) == 2)[None])
    decoded = decode(model, trained(model), observe(model, trained(model), cut, sampled=False))
    alone = batch.time_slice(2, FRAMES).replace(is_first=batch.is_first[:, :2])
    want = decode(model, trained(model), observe(model, trained(model), alone, sampled=False))
    assert_same({head: value[:, 2:] for head, value in decoded.items()}, want)
    image = decode(model, fresh(model), observe(model, fresh(model), cut))["image"]
    np.testing.assert_allclose(image[:, 2], 0.3, atol=1e-5)


def stream_of(model, variables, batch, extra=()):
    """LiveState after each observation."""
    stream = live.start_live(model, KEY, batch.batch_size)
    for t in range(batch.frames):
        seen = {name: getattr(batch, name) if name in ("intrinsics", "camera_to_ego") else getattr(batch, name)[:, t]
                for name in (*world_model.inputs(model.config), *extra)}
        stream = live.observe_step(model, variables, stream, seen, batch.action[:, max(t - 1, 0)])
        yield stream


@pytest.mark.parametrize("variant", ["1d", "2d"])
def test_a_stream_decodes_what_the_window_decodes(variant):
    """With fewer, as many and more frames than the two that are remembered."""
    model = model_of(variant)
    batch, variables = batch_of(model.config), trained(model)
    observed = observe(model, variables, batch)
    whole = decode(model, variables, observed)
    plan = np.random.default_rng(3).uniform(-1, 1, (BATCH, 2, 2)).astype(np.float32)
    dreamt = rollout.imagine(model, variables, KEY, observed.last, plan)
    for t, stream in enumerate(stream_of(model, variables, batch)):
        np.testing.assert_allclose(stream.latent.features, observed.states[:, t].features, atol=1e-4)
        assert_same(decode(model, variables, stream, stream.latent),
                    {head: value[:, t] for head, value in whole.items()})
    assert stream.memory.image.shape[1] == model.config.first_guess.memory_frames + 1
    dream = rollout.imagine(model, variables, KEY, stream.latent, plan)
    assert_same(decode(model, variables, stream, dream.states),
                decode(model, variables, observed, dreamt.states))


def test_branches_and_times_are_decoded_as_one_by_one():
    model = model_of()
    batch, variables = batch_of(model.config), trained(model)
    observed = observe(model, variables, batch)
    horizon, branches = 5, 3  # longer than any window
    plans = np.random.default_rng(3).uniform(-1, 1, (BATCH, branches, horizon, 2)).astype(np.float32)
    dream = rollout.imagine(model, variables, KEY, observed.last, plans, sampled=False)
    assert dream.states.vantage.steps[0, 0].tolist() == [1, 2, 3, 4, 5]
    whole = decode(model, variables, observed, dream.states)
    assert whole["image"].shape == (BATCH, branches, horizon, *model.config.image_size, 3)
    for step in range(horizon):
        one = decode(model, variables, observed, dream.states[:, 1, step])
        assert_same(one, {head: value[:, 1, step] for head, value in whole.items()})
    single = decode(model, variables, observed, dream.states[1, 2, 3], ("image",), rows=np.int32(1))
    assert_same(single, {"image": whole["image"][1, 2, 3]})
    # From every frame of a window: a dream from an earlier one looks at what was seen until then.
    early = rollout.imagine(model, variables, KEY, observed.states[:, 1], plans[:, 0], sampled=False)
    until = observe(model, variables, batch.time_slice(0, 2), sampled=False)
    same = rollout.imagine(model, variables, KEY, until.last, plans[:, 0], sampled=False)
    early, same = early.states[:, 1], same.states[:, 1]
    got, want = (look(model.config, seen.memory, jnp.arange(BATCH), states.vantage, GUESSED)[0]
                 for seen, states in ((observed, early), (until, same)))
    np.testing.assert_allclose(got["occupancy"].newest, want["occupancy"].newest, atol=1e-2)
    differs = np.abs(got["range_view"].newest_m - want["range_view"].newest_m) > 0.01
    assert differs.mean() < 0.01  # a point on the edge of two pixels may fall into either


def test_an_imagined_car_is_where_the_bicycle_brings_it_and_sees_the_memory_from_there():
    config = config_of()
    model, batch = model_of(), batch_of(config.model, speed_mps=5.0)
    observed = observe(model, fresh(model), batch)
    plan = np.tile(np.float32([1.0, -0.5]), (BATCH, 3, 1))
    dream = rollout.imagine(model, fresh(model), KEY, observed.last, plan)
    driven = motion.path(motion.at_rest_of_frame(jnp.full((BATCH,), 5.0)), jnp.asarray(plan), config.contract,
                         config.data.stride)
    np.testing.assert_allclose(dream.states.vantage.motion.pose, driven.pose, atol=1e-4)
    np.testing.assert_allclose(dream.states.vantage.motion.speed_mps, driven.speed_mps, rtol=1e-5)
    glimpse, numbers = look(model.config, observed.memory, jnp.arange(BATCH), dream.states[:, -1].vantage, GUESSED)
    view = model.config.range_view
    moved = reproject.onto_beams(reproject.move_range_view(batch.range_view[:, -1], driven.pose[:, -1], view), view)
    np.testing.assert_allclose(glimpse["range_view"].newest_m, moved[..., 3], atol=1e-3)
    np.testing.assert_allclose(np.asarray(numbers[:, :3]) * np.float32([10.0, 2.0, 0.3]), driven.pose[:, -1], atol=1e-4)
    assert (np.asarray(driven.pose[:, -1, 0]) > 2.0).all() and numbers[0, 3] > 0.0


@pytest.mark.parametrize("variant", ["1d", "2d"])
def test_every_guessed_head_answers_to_actions(variant):
    model = model_of(variant)
    batch, variables = batch_of(model.config), fresh(model)
    observed = observe(model, variables, batch)

    def decoded(plan, weights):
        dream = rollout.imagine(model, variables, KEY, observed.last, plan, sampled=False)
        predictions = rollout.decode(model, variables, dream.states[:, -1], GUESSED, memory=observed.memory)
        return sum(weight * jnp.square(predictions[head]).mean() for head, weight in zip(GUESSED, weights, strict=True))

    slope = jax.jit(jax.grad(decoded))
    for head, weights in zip(GUESSED, jnp.eye(3), strict=True):
        by_action = slope(0.3 * jnp.ones((BATCH, 2, 2)), list(weights))
        assert np.isfinite(by_action).all(), head
        assert (np.abs(by_action).max(axis=(0, 1)) > 0).all(), head  # the pedal and the wheel


def test_driving_out_of_everything_remembered_leaves_finite_predictions():
    model = model_of()
    batch = batch_of(model.config, speed_mps=3000.0)
    observed = observe(model, trained(model), batch)
    dream = rollout.imagine(model, trained(model), KEY, observed.last, np.ones((BATCH, 3, 2), np.float32))
    for value in (*decode(model, trained(model), observed).values(),
                  *decode(model, trained(model), observed, dream.states).values()):
        assert np.isfinite(value).all()
    voxels = decode(model, fresh(model), observed, dream.states)["occupancy"]
    assert np.diff(voxels).max() < -1.9  # nothing that was hit is here


def test_a_single_remembered_frame_is_enough():
    config = config_of(memory_frames=1).model
    batch = batch_of(config, speed_mps=0.0)
    states = model_of().initial_state(1)
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[None], (BATCH, FRAMES, *leaf.shape[1:])), states)
    states, kept = memory.of_window(config, batch, states, memory.measured(config, batch))
    glimpse, _ = look(config, kept, jnp.arange(BATCH), states[:, 2].vantage, GUESSED)
    np.testing.assert_allclose(glimpse["range_view"].newest_m, batch.range_view[:, 1, ..., 3], rtol=1e-2)
    np.testing.assert_array_equal(glimpse["occupancy"].older, 0.0)
    with pytest.raises(ValueError, match="memory_frames is 0"):
        config_of(memory_frames=0)


def test_without_a_camera_scans_are_moved_and_without_a_lidar_nothing():
    blind = model_of(camera="none", heads=("range_view", "image"))
    assert memory.guessed_heads(blind.config) == ("range_view",)
    batch = batch_of(blind.config, speed_mps=0.0)
    observed = observe(blind, fresh(blind), batch)
    assert observed.memory.image is None
    decoded = decode(blind, fresh(blind), observed, heads=("range_view", "image"))
    np.testing.assert_allclose(decoded["image"], 0.3, atol=1e-5)
    before_m, again_m = batch.range_view[:, :-1, ..., 3], decoded["range_view"][:, 1:, ..., 3]
    np.testing.assert_allclose(again_m[before_m > 0], before_m[before_m > 0], rtol=1e-2)
    picture = model_of(lidar="none", heads=("image", "action"))
    assert memory.guessed_heads(picture.config) == ()
    assert jax.eval_shape(lambda: observe(picture, picture.variable_shapes(), batch)).memory is None
    unmoved = model_of("1d", "none", lidar="none", heads=("image", "ego_motion"))
    assert not unmoved.config.tracks_motion


def test_without_kinematics_the_head_moves_the_memory_where_nothing_is_measured():
    model = model_of("1d", "none", heads=SCANNED)
    assert model.config.kinematics is None and model.config.tracks_motion
    variables = trained(model)
    batch = batch_of(model.config)
    observed = observe(model, variables, batch)
    said = np.asarray(model.ego_motion(variables, observed.states))
    poses = np.asarray(observed.states.vantage.motion.pose)
    np.testing.assert_allclose(motion.relative(poses[:, 2], poses[:, 1]), said[:, 2, :3], atol=1e-4)
    whole = decode(model, variables, observed, heads=SCANNED)
    for t, stream in enumerate(stream_of(model, variables, batch)):
        assert_same(decode(model, variables, stream, stream.latent, SCANNED),
                    {head: value[:, t] for head, value in whole.items()})
    dream = rollout.imagine(model, variables, KEY, observed.last, batch.action[:, :2], sampled=False)
    steps = np.asarray(model.ego_motion(variables, dream.states))
    np.testing.assert_allclose(dream.states.vantage.motion.pose[:, 0], steps[:, 0, :3], atol=1e-5)
    np.testing.assert_allclose(dream.states.vantage.motion.speed_mps, steps[..., 3], atol=1e-5)


def test_without_kinematics_measured_motion_counts():
    model = model_of("1d", "none", heads=SCANNED)
    variables = trained(model)
    ego_motion = np.random.default_rng(2).uniform(0.0, 1.0, (BATCH, FRAMES, 4)).astype(np.float32)
    batch = batch_of(model.config, ego_motion=ego_motion)
    observed = observe(model, variables, batch)
    poses = np.asarray(observed.states.vantage.motion.pose)
    np.testing.assert_allclose(motion.relative(poses[:, 2], poses[:, 1]), ego_motion[:, 2, :3], atol=1e-5)
    np.testing.assert_allclose(observed.last.vantage.motion.speed_mps, ego_motion[:, -1, 3])
    whole = decode(model, variables, observed, heads=SCANNED)
    for t, stream in enumerate(stream_of(model, variables, batch, ("ego_motion",))):
        assert_same(decode(model, variables, stream, stream.latent, SCANNED),
                    {head: value[:, t] for head, value in whole.items()})


def test_how_the_car_came_to_a_first_frame_may_be_anything():
    config = config_of("1d", "none", heads=SCANNED).model
    ego_motion = np.random.default_rng(2).uniform(0.0, 1.0, (BATCH, FRAMES, 4)).astype(np.float32)
    cut = np.broadcast_to(np.arange(FRAMES) % 2 == 0, (BATCH, FRAMES)).copy()
    unknown = ego_motion.copy()
    unknown[:, ::2, :3] = np.nan
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (BATCH, FRAMES, *leaf.shape[1:])),
                          model_of("1d", "none", heads=SCANNED).initial_state(BATCH))

    def poses(batch):
        seen, kept = memory.of_window(config, batch, states, memory.measured(config, batch))
        return seen.vantage.motion, kept.pose

    batch = batch_of(config, is_first=cut, ego_motion=unknown)
    moved, kept = jax.jit(poses)(batch)
    np.testing.assert_allclose(motion.relative(kept[:, 1], kept[:, 0]), ego_motion[:, 1, :3], atol=1e-5)
    np.testing.assert_allclose(moved.pose[:, 2], kept[:, 2])
    assert np.isfinite(kept).all() and np.isfinite(moved.pose).all()
    model, other = model_of("1d", "none", heads=SCANNED), model_of()
    checks.observation("observe", model, batch)
    for field in (0, 3):  # the motion to a frame that is not first, and a speed
        wrong = unknown.copy()
        wrong[0, 1 if field == 0 else 2, field] = np.inf
        with pytest.raises(ValueError, match=r"observe: ego_motion \[2, 4, 4\] holds 1 values that are not finite"):
            checks.observation("observe", model, batch.replace(ego_motion=wrong))
    checks.observation("observe", other, batch_of(other.config, ego_motion=wrong))  # which does not read it


def test_a_stream_takes_any_motion_to_its_first_frame_and_finite_motion_afterwards():
    model = model_of("1d", "none", heads=SCANNED)
    nowhere = np.full((BATCH, 2, 4), np.nan, np.float32)
    nowhere[:, 0, 3] = 5.0
    batch = batch_of(model.config, frames=2, ego_motion=nowhere)
    stream = stream_of(model, trained(model), batch, ("ego_motion",))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(dataclasses.replace(next(stream), keys=None)))
    with pytest.raises(ValueError, match=r"observe_step: ego_motion \[2, 4\] holds 8 values that are not finite"):
        next(stream)


def test_before_its_first_observation_a_stream_shows_the_average_frame():
    model = model_of()
    begun = live.start_live(model, KEY)
    zeros = jax.tree.map(jnp.zeros_like, (begun.latent, begun.memory))  # what a sealed model's consumer starts from

    @jax.jit
    def image(variables, latent, seen):
        of = lambda latent: rollout.decode(model, variables, latent, ("image",), memory=seen).image
        slopes = jax.grad(lambda motion: of(dataclasses.replace(
            latent, vantage=dataclasses.replace(latent.vantage, motion=motion))).sum())(latent.vantage.motion)
        return of(latent), slopes

    for latent, seen in ((begun.latent, begun.memory), zeros):
        shown, slopes = image(fresh(model), latent, seen)
        np.testing.assert_allclose(shown, 0.3, atol=1e-5)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_evidence_worked_out_once_says_nearly_the_same_and_only_of_what_is_imagined_from_the_newest_observation():
    model = model_of()
    batch = batch_of(model.config, speed_mps=6.0)
    observed = observe(model, trained(model), batch)
    ready = glimpse.with_evidence(model.config, observed.memory, observed.last.vantage)
    dream = rollout.imagine(model, trained(model), KEY, observed.last, np.zeros((BATCH, 2, 2), np.float32))
    of = lambda held, states: rollout.decode(model, trained(model), states, ("occupancy",), memory=held).occupancy
    exact, quick = (np.asarray(of(held, dream.states)) for held in (observed.memory, ready))
    assert np.corrcoef(exact.ravel(), quick.ravel())[0, 1] > 0.9
    with pytest.raises(ValueError, match=r"states \[0\] steps \(0: not imagined\) from observations \[3\]"):
        of(ready, observed.states[:, -1:])
    earlier = rollout.imagine(model, trained(model), KEY, observed.states[:, 1], np.zeros((BATCH, 2, 2), np.float32))
    with pytest.raises(ValueError, match=r"states \[1, 2\] steps .* from observations \[1\]"):
        of(ready, earlier.states)
    with pytest.raises(ValueError, match="not that of the memory's newest observation"):
        glimpse.with_evidence(model.config, observed.memory, observed.states[:, 1].vantage)
    with pytest.raises(ValueError, match=r"got a vantage \[2, 4\], expected \[2\]"):
        glimpse.with_evidence(model.config, observed.memory, observed.states.vantage)


def environment_of(model, observed, batch, **options):
    environment = environment_lib.Environment(model, periods=2, observation=("image",), **options)
    return environment, environment.params(trained(model), environment.starts(observed, batch, skip=1), 3)


def test_an_environment_sees_the_memory_of_its_start():
    model = model_of()
    batch = batch_of(model.config)
    observed = observe(model, trained(model), batch)
    environment, params = environment_of(model, observed, batch, reward_config=rewards.RewardConfig(occupancy_scale=2))
    assert params.bank.size == BATCH * (FRAMES - 1) and params.bank.row.tolist() == [0, 0, 0, 1, 1, 1]
    assert params.bank.memory is observed.memory
    params = dataclasses.replace(params, temperature=jnp.float32(0.0))
    keys = jax.random.split(jax.random.key(1), 6)
    seen, states = jax.jit(jax.vmap(environment.reset, (0, None)))(keys, params)
    whole = decode(model, trained(model), observed)["image"][:, 1:].reshape(-1, *model.config.image_size, 3)
    np.testing.assert_allclose(seen["image"], whole[states.start], atol=1e-3)
    assert len(np.unique(states.start)) > 2
    start = states[0] if hasattr(states, "__getitem__") else jax.tree.map(lambda leaf: leaf[0], states)
    plan = np.tile(np.float32([0.6, 0.3]), (3, 1))
    _, transitions = environment_lib.play(environment, params, jax.random.key(2), start, jnp.asarray(plan), 3)
    drive, frame = divmod(int(start.start), FRAMES - 1)
    dream = rollout.imagine(model, trained(model), KEY, observed.states[drive, frame + 1], plan, sampled=False)
    want = decode(model, trained(model), observed, dream.states, ("image",), rows=np.full(3, drive))
    np.testing.assert_allclose(transitions.observation["image"], want["image"], atol=1e-3)
    objective = planners.imagined_returns(environment, params, start, noises=1)
    returns = jax.jit(objective)(jax.random.key(3), jnp.stack([plan, -plan]))
    assert np.isfinite(returns).all() and returns[0] != returns[1]


def test_banks_without_their_memory_are_refused():
    model = model_of()
    batch = batch_of(model.config)
    observed = observe(model, trained(model), batch)
    forgetful = dataclasses.replace(observed, memory=None)
    with pytest.raises(ValueError, match="StartBank: it has no memory, but the heads image, range_view, occupancy"):
        environment_of(model, forgetful, batch)


def test_the_configuration_survives_json_and_pickling():
    config = config_of()
    assert config.model.kinematics == config_lib.Kinematics(config.contract, config.data.stride)
    assert config_lib.Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert pickle.loads(pickle.dumps(config)) == config and hash(config.model) == hash(config_of().model)
    assert not presets.paper().model.tracks_motion and presets.town().model.kinematics.periods == 2


def test_what_the_memory_needs_is_said():
    model = model_of()
    batch = batch_of(model.config)
    observed = observe(model, fresh(model), batch)
    states, last = observed.states, observed.memory
    blind = LatentState(states.deterministic, states.stochastic)
    smaller = last.replace(range_view=last.range_view[:, :, :16])
    shorter = last.replace(image=last.image[:, 1:])
    for arguments, message in [
            ((states.features, last), r"got features, but the heads image, range_view, occupancy"),
            ((blind, last), "states without a vantage"),
            ((states, None), r"states and no memory.*observed\.memory"),
            ((states, smaller), r"memory.range_view is \[2, 4, 16, 64, 4\], expected \[2, 4, 32, 64, 4\]"),
            ((states, shorter), r"memory.image is \[2, 3, 32, 64, 3\], expected \[2, 4, 32, 64, 3\]"),
            ((states, last.replace(image=None)), "memory.image is None"),
            ((states[0], last), r"states \[4, \.\.\.\] and a memory of 2 drives")]:
        with pytest.raises(ValueError, match=message):
            model.decode(fresh(model), arguments[0], GUESSED, arguments[1])
    with pytest.raises(ValueError, match=r"rows \[3\], expected \[4\]"):
        model.decode(fresh(model), states[0], GUESSED, last, np.zeros(3, np.int32))
    with pytest.raises(ValueError, match="it has no vantage"):
        rollout.imagine(model, fresh(model), KEY, blind[:, -1], batch.action)
    with pytest.raises(ValueError, match=r"Batch\.speed_mps is None"):
        observe(model, fresh(model), batch.replace(speed_mps=None))
    with pytest.raises(ValueError, match=r"Batch\.intrinsics is None"):
        observe(model, fresh(model), batch.replace(intrinsics=None))


def test_a_model_that_cannot_know_how_it_moves_is_refused():
    unmoved = "kinematics is not 'bicycle'.*image, range_view, occupancy, action.*--with-heads=ego_motion"
    with pytest.raises(ValueError, match=unmoved):
        config_of(kinematics="none")
    with pytest.raises(ValueError, match=unmoved):
        world_model.WorldModel(dataclasses.replace(presets.tiny().model, first_guess=config_lib.LastSeen()))
