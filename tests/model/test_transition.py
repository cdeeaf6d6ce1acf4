"""The recurrent state-space model: its cell by hand, its steps in a scan and in a loop, its resets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from windows import make_window

from muvo_jax import presets
from muvo_jax.model import latents, rollout, world_model
from muvo_jax.types import LatentState, StepNoise

pytestmark = pytest.mark.usefixtures("strict_dtypes")
CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
BATCH, FRAMES, CHANNELS = 3, 4, CONFIG.latent.stochastic_channels


@pytest.fixture(scope="module")
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


@pytest.fixture(scope="module")
def window():
    return make_window(BATCH, FRAMES, (CONFIG.latent.embedding_channels,), (CHANNELS,))


def test_gru_by_hand():
    sigmoid = lambda value: 1 / (1 + np.exp(-value))
    random = np.random.default_rng(0)
    draw = lambda *shape: random.normal(size=shape).astype(np.float32)
    params = {"input_kernel": draw(3, 6), "hidden_kernel": draw(2, 6), "input_bias": draw(6), "hidden_bias": draw(6)}
    state, x = draw(4, 2), draw(4, 3)
    from_input = x @ params["input_kernel"] + params["input_bias"]
    from_state = state @ params["hidden_kernel"] + params["hidden_bias"]
    reset = sigmoid(from_input[:, 0:2] + from_state[:, 0:2])
    update = sigmoid(from_input[:, 2:4] + from_state[:, 2:4])
    new = np.tanh(from_input[:, 4:6] + reset * from_state[:, 4:6])
    got = latents.GRUCell(2).apply({"params": params}, state, x)
    np.testing.assert_allclose(got, (1 - update) * new + update * state, rtol=1e-5, atol=1e-6)


def test_std_is_bounded_and_one_point_one_at_zero():
    head = latents.GaussianHead(2, 4, 0.01)
    shapes = jax.eval_shape(head.init, jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 2)))["params"]
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    x, action = jnp.ones((1, 3)), jnp.ones((1, 2))
    np.testing.assert_allclose(head.apply({"params": params}, x, action).std, [[1.1, 1.1]], rtol=1e-6)
    params["out"]["bias"] = jnp.float32([0, 0, -1e3, 1e3])
    np.testing.assert_allclose(head.apply({"params": params}, x, action).std, [[0.1, 2.1]], rtol=1e-6)


def test_scan_equals_a_loop_by_hand(variables, window):
    embedding, action, is_first, noise = window
    observed = rollout.filter_embeddings(MODEL, variables, embedding, action, is_first, noise)
    state = MODEL.initial_state(BATCH)
    for step in range(FRAMES):
        previous = action[:, step - 1] if step else jnp.zeros((BATCH, 2))
        state, (prior, posterior) = MODEL.observe_step(variables, noise[:, step], state, previous, embedding[:, step],
                                                       is_first[:, step])
        carried = np.where(noise.use_prior[:, step, None] & (step > 0), prior.sample(noise.prior[:, step]),
                           posterior.sample(noise.posterior[:, step]))
        np.testing.assert_allclose(state.stochastic, carried, atol=1e-6)
        for got, want in ((observed.states.deterministic, state.deterministic), (observed.prior.mean, prior.mean),
                          (observed.posterior.std, posterior.std),
                          (observed.states.stochastic, posterior.sample(noise.posterior[:, step]))):
            np.testing.assert_allclose(got[:, step], want, atol=1e-5)


def test_is_first_makes_a_fresh_start(variables, window):
    embedding, action, is_first, noise = window
    restart = is_first.at[:, 2].set(True)
    observed = rollout.filter_embeddings(MODEL, variables, embedding, action, restart, noise)
    later = rollout.filter_embeddings(MODEL, variables, embedding[:, 2:], action[:, 2:], is_first[:, :2], noise[:, 2:])
    jax.tree.map(lambda whole, part: np.testing.assert_allclose(whole[:, 2:], part, atol=1e-5), observed, later)
    uninterrupted = rollout.filter_embeddings(MODEL, variables, embedding, action, is_first, noise)
    assert not np.allclose(uninterrupted.posterior.mean[:, 2], observed.posterior.mean[:, 2], atol=1e-4)


def test_prior_dropout_never_changes_a_first_step(variables, window):
    embedding, action, _, noise = window
    always = StepNoise(noise.prior[:, 0], noise.posterior[:, 0], jnp.ones((BATCH,), bool))
    for is_first, kind in ((True, 1), (False, 0)):
        state, gaussians = MODEL.observe_step(variables, always, MODEL.initial_state(BATCH), action[:, 0],
                                              embedding[:, 0], jnp.full((BATCH,), is_first))
        expected = gaussians[kind].sample((always.prior, always.posterior)[kind])
        np.testing.assert_allclose(state.stochastic, expected, atol=1e-6)


def test_the_action_enters_the_latents_and_not_the_recurrence(variables):
    state = LatentState(jnp.full((1, CONFIG.latent.deterministic_channels), 0.3), jnp.full((1, CHANNELS), 0.2))
    silence = jnp.zeros((1, CHANNELS))
    left, prior_left = MODEL.imagine_step(variables, silence, state, jnp.float32([[0.0, -1.0]]))
    right, prior_right = MODEL.imagine_step(variables, silence, state, jnp.float32([[0.0, 1.0]]))
    np.testing.assert_array_equal(left.deterministic, right.deterministic)
    assert not np.allclose(prior_left.mean, prior_right.mean)


def test_reference_numerics_make_the_heads_affine(variables):
    silence = jnp.zeros((1, CHANNELS))

    def mean(numerics, scale):
        model = world_model.WorldModel(dataclasses.replace(CONFIG, numerics=numerics))
        action = scale * jnp.float32([[0.5, -0.5]])
        return model.imagine_step(variables, silence, MODEL.initial_state(1), action)[1].mean

    curvature = lambda numerics: np.abs(mean(numerics, 2.0) - 2 * mean(numerics, 0.0) + mean(numerics, -2.0)).max()
    assert curvature("reference") < 1e-5 < curvature("standard")
