"""The 2D latent: token groups, the cell by hand, steps in a scan and in a loop, resets, dropout, what heads read."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from windows import make_window

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import latents, rollout, tokens, world_model
from muvo_jax.types import LatentState

pytestmark = pytest.mark.usefixtures("strict_dtypes")
TINY = config_lib.override(presets.get("tiny"), "model.latent", "2d")
CONFIG = TINY.model
MODEL = world_model.WorldModel(CONFIG)
BATCH, FRAMES, OBSERVED_TOKENS = 3, 3, 7
CHANNELS = CONFIG.fusion.token_channels
SHAPE = (tokens.count(CONFIG), CHANNELS)


@pytest.fixture(scope="module")
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


@pytest.fixture(scope="module")
def window():
    return make_window(BATCH, FRAMES, (OBSERVED_TOKENS, CHANNELS), SHAPE, dropout=True)


@pytest.fixture(scope="module")
def state():
    draw = lambda seed: jax.random.normal(jax.random.key(seed), (BATCH, *SHAPE))
    return LatentState(jnp.tanh(draw(4)), draw(5))


filter_window = jax.jit(lambda variables, *window: rollout.filter_embeddings(MODEL, variables, *window))


def assert_close(first, second, tolerance=2e-5):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=tolerance, rtol=1e-4), first, second)


def test_the_papers_sizes_give_1093_tokens():
    paper = config_lib.ModelConfig(latent=config_lib.TokenLatent())
    assert tokens.groups(paper) == {"image": (10, 26), "range_view": (4, 64), "occupancy": (12, 12, 4), "action": ()}
    assert tokens.count(paper) == 1093
    assert MODEL.feature_shape == (19, 24) and MODEL.policy_feature_channels == 4 * 24


def test_heads_read_their_own_tokens_and_the_reference_s_alone():
    features = jnp.arange(19 * 24, dtype=jnp.float32).reshape(19, 24)
    view = tokens.read(features, "range_view", CONFIG)
    assert view.shape == (2, 4, 24)
    np.testing.assert_array_equal(view[1, 0], features[2 + 4])  # after two tokens of the image and a row of four
    reference = dataclasses.replace(CONFIG, numerics="reference")
    np.testing.assert_array_equal(tokens.read(features, "action", reference), features[18, 12:])
    pooled = MODEL.policy_features(features)
    np.testing.assert_allclose(pooled[:24], features[:2].mean(0))
    np.testing.assert_allclose(pooled[-24:], features[18])


def test_the_cells_of_a_sensor_keep_their_places_and_the_rest_gets_the_mean():
    alone = lambda count, setting, value: np.asarray(tokens.of_observation(
        jnp.arange(1.0, count * 12 + 1).reshape(1, count, 12), config_lib.override(TINY, setting, value).model))
    mean = lambda count: np.broadcast_to(np.arange(1.0, count * 12 + 1).reshape(count, 12).mean(axis=0), (19, 12))
    image = alone(7, "model.lidar", "pp")[0]  # 2 cells of the image, 3 of a lidar, route, speed
    np.testing.assert_array_equal(image[:2], np.arange(1.0, 25).reshape(2, 12))
    np.testing.assert_allclose(image[2:], mean(7)[2:], rtol=1e-6)
    lidar = alone(13, "model.camera", "bev")[0]  # 3 cells of a bird's-eye view, 8 of the range view, route, speed
    np.testing.assert_array_equal(lidar[2:10], np.arange(1.0, 157).reshape(13, 12)[3:11])
    np.testing.assert_allclose(np.delete(lidar, slice(2, 10), 0), np.delete(mean(13), slice(2, 10), 0), rtol=1e-6)
    np.testing.assert_allclose(alone(13, "model.fusion.many_tokens", True)[0], mean(13), rtol=1e-6)


def test_aligned_tokens_start_where_they_stand():
    model = world_model.WorldModel(config_lib.override(TINY, "model.latent.aligned_tokens", True).model)
    variables = jax.tree.map(jnp.asarray, model.init(jax.random.key(0)))
    cells = tokens.count(CONFIG) - 8 - 1  # of image and range view, which the observation has too
    window = make_window(BATCH, FRAMES, (cells + 2, CHANNELS), SHAPE)
    aligned = jax.jit(lambda variables: rollout.filter_embeddings(model, variables, *window))
    of_queries = jax.jit(lambda variables: rollout.filter_embeddings(MODEL, variables, *window))
    transition = variables["params"]["transition"]
    silent = {name: jax.tree.map(jnp.zeros_like, part) if name.endswith(("_own", "_seen")) else part
              for name, part in transition.items()}
    silenced = variables | {"params": variables["params"] | {"transition": silent}}
    assert_close(aligned(silenced).posterior.mean, of_queries(variables).posterior.mean)
    moved = jnp.abs(aligned(variables).posterior.mean - of_queries(variables).posterior.mean).max(axis=(0, 1, 3))
    assert (moved > 1e-3).all()


def test_gru_by_hand():
    sigmoid = lambda value: 1 / (1 + np.exp(-value))
    random = np.random.default_rng(0)
    draw = lambda *shape: random.normal(size=shape).astype(np.float32)
    names = ("update", "update_shared", "reset", "reset_shared", "new", "new_shared")
    params = {name: {"kernel": draw(4, 2), "bias": draw(2)} for name in names} | {
        "gate": {"kernel": draw(4, 4), "bias": draw(4)}}
    state, x = draw(1, 3, 2), draw(1, 3, 2)
    dense = lambda name, value: value @ params[name]["kernel"] + params[name]["bias"]
    joined = np.concatenate([state, x], -1)[0]
    shared = np.mean(sigmoid(dense("gate", joined)) * joined, axis=0, keepdims=True)
    update = sigmoid(dense("update", joined) + dense("update_shared", shared))
    reset = sigmoid(dense("reset", joined) + dense("reset_shared", shared))
    moved = np.concatenate([reset * state[0], x[0]], -1)
    new = np.tanh(dense("new", moved) + dense("new_shared", shared))
    got = latents.TokenGRU(2).apply({"params": params}, state, x)[0]
    np.testing.assert_allclose(got, (1 - update) * state[0] + update * new, rtol=1e-5, atol=1e-6)


def test_scan_equals_a_loop_by_hand(variables, window):
    embedding, action, is_first, noise = window
    observed = filter_window(variables, *window)
    step = jax.jit(MODEL.observe_step)
    state = MODEL.initial_state(BATCH)
    for index in range(FRAMES):
        previous = action[:, index - 1] if index else jnp.zeros((BATCH, 2))
        state, (prior, posterior) = step(variables, noise[:, index], state, previous, embedding[:, index],
                                         is_first[:, index])
        coin = noise.use_prior[:, index, None, None] & (index > 0)
        carried = np.where(coin, prior.sample(noise.prior[:, index]), posterior.sample(noise.posterior[:, index]))
        assert_close(state.stochastic, carried)
        assert_close(observed[:, index], observed[:, index].replace(
            states=LatentState(state.deterministic, posterior.sample(noise.posterior[:, index])), prior=prior,
            posterior=posterior))


def test_is_first_makes_a_fresh_start(variables, window):
    embedding, action, is_first, noise = window
    restart = is_first.at[:, 1].set(True)
    observed = filter_window(variables, embedding, action, restart, noise)
    shift = lambda leaf: jnp.concatenate([leaf[:, 1:], leaf[:, :1]], axis=1)
    later = filter_window(variables, shift(embedding), shift(action), is_first, jax.tree.map(shift, noise))
    assert_close(observed[:, 1:], later[:, :-1])
    assert not np.allclose(filter_window(variables, *window).posterior.mean[:, 1], observed.posterior.mean[:, 1],
                           atol=1e-4)


def test_dropout_follows_each_samples_key_and_is_off_without(variables, window):
    embedding, action, is_first, noise = window
    swapped = filter_window(variables, *jax.tree.map(lambda leaf: leaf[::-1], window))
    with_dropout = filter_window(variables, *window)
    assert_close(swapped[::-1], with_dropout)
    without = filter_window(variables, embedding, action, is_first, noise.replace(dropout=None))
    assert not np.allclose(without.posterior.mean, with_dropout.posterior.mean, atol=1e-3)
    assert not np.allclose(without.prior.mean, with_dropout.prior.mean, atol=1e-3)


def test_imagining_a_batch_is_imagining_each_alone(variables, state):
    keys, actions = jax.random.split(jax.random.key(6), BATCH), jnp.linspace(-1, 1, BATCH * 8).reshape(BATCH, 4, 2)
    whole = rollout.imagine(MODEL, variables, keys, state, actions)
    assert whole.states.stochastic.shape == (BATCH, 4, *SHAPE)
    for index in range(BATCH):
        one = slice(index, index + 1)
        assert_close(rollout.imagine(MODEL, variables, keys[one], state[one], actions[one]), whole[one])
    assert not np.allclose(whole.states.stochastic[0, -1], whole.states.stochastic[1, -1], atol=1e-2)


def test_branches_and_policies_work_as_with_vectors(variables, state):
    steer = lambda key, features: jnp.tanh(MODEL.policy_features(features)[:2])
    dream = rollout.imagine(MODEL, variables, jax.random.key(2), state, steer, horizon=2, branches=2)
    first = jnp.tanh(MODEL.policy_features(state.features)[:, :2])
    np.testing.assert_allclose(dream.actions[:, 1, 0], first, atol=1e-6)
    assert not np.allclose(dream.features[:, 0], dream.features[:, 1])
    cloned = rollout.imagine(MODEL, variables, jax.random.key(2), state, rollout.learned_policy(MODEL, variables),
                             horizon=2)
    decoded = rollout.decode(MODEL, variables, state, ("action",)).action
    np.testing.assert_allclose(cloned.actions[:, 0], decoded, atol=1e-6)
    with pytest.raises(ValueError, match=r"got features \[3, 24\], expected \[..., 19, 24\] for the 2d latent"):
        MODEL.decode(variables, jnp.ones((3, 24)))


def test_gradients_reach_actions_and_the_start_state(variables, state):
    def target(actions, state):
        return jnp.square(rollout.imagine(MODEL, variables, jax.random.key(3), state, actions).features[:, -1]).sum()

    by_action, by_state = jax.grad(target, argnums=(0, 1))(jnp.full((BATCH, 3, 2), 0.1), state)
    assert (np.abs(by_action).max(axis=(0, 2)) > 0).all()
    assert all(np.abs(leaf).max(axis=(0, 2)).min() > 0 for leaf in jax.tree.leaves(by_state))  # every token


def test_the_posterior_of_the_reference_does_not_mark_its_memory(variables, window):
    """Moving the state's type embedding moves both Gaussians here, in the reference the prior alone."""
    embedding, action, is_first, noise = (jax.tree.map(lambda leaf: leaf[:, 0], part) for part in window)
    noise = noise.replace(dropout=None)
    moved = jax.tree.map(lambda leaf: leaf, variables)
    table = moved["params"]["transition"]["type_embedding"]
    moved["params"]["transition"]["type_embedding"] = table.at[1].add(jnp.linspace(-1, 1, CHANNELS))
    start = MODEL.initial_state(BATCH)
    for numerics, expected in (("standard", [True, True]), ("reference", [True, False])):
        # The transition alone: the decoders of the other numerics have other shapes.
        module = latents.TokenTransition(dataclasses.replace(CONFIG, numerics=numerics))
        step = jax.jit(lambda params, module=module: module.apply(
            {"params": params["params"]["transition"]}, noise, start, action, embedding, is_first,
            method="observe_step")[1])
        differs = [bool(np.abs(a.mean - b.mean).max() > 1e-4) for a, b in
                   zip(step(variables), step(moved), strict=True)]
        assert differs == expected
