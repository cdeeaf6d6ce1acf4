"""Rewards that count as far as imagination is trusted, and obstacles sought in several branches, wherever plans are
judged: environment, one future for all plans, and futures that are driven again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import futures as futures_lib
from muvo_jax.agents import planners, uncertainty
from muvo_jax.types import LatentState, Motion

HORIZON, TRUST = 4, (1.0, 0.5, 0.25)
KEY = jax.random.key(1)
CAREFUL = uncertainty.Caution(TRUST, branches=6)


@dataclasses.dataclass(frozen=True)
class FoggyModel(worlds.WallModel):
    """The wall is somewhere about where it should be, in every draw elsewhere."""

    def imagine_step(self, variables, noise, state, action):
        after, prior = super().imagine_step(variables, noise, state, action)
        return LatentState(after.deterministic, 3.0 * noise), prior

    def decode(self, variables, states, heads=None, memory=None, rows=None):
        seen = states.deterministic.at[..., 0].add(states.stochastic[..., 0])
        return super().decode(variables, dataclasses.replace(states, deterministic=seen), heads)


def world(caution, temperature=0.0):
    plain, params = worlds.before_a_wall(9.0, 4.0, HORIZON, terminal_collision=1.0)
    foggy = dataclasses.replace(plain, model=FoggyModel(plain.model.config), caution=caution, observation="road")
    return foggy, foggy.params({}, params.bank, HORIZON, temperature)


@pytest.fixture(scope="module")
def played():
    """caution -> (environment, params, state, Transitions of coasting)."""
    found = {}
    for caution in (uncertainty.Caution(), CAREFUL):
        environment, params = world(caution)
        state = environment.state_at(jnp.int32(0), params)
        _, transitions = environment_lib.play(environment, params, jax.random.split(KEY, 1)[0], state,
                                              jnp.zeros((HORIZON, 2)), HORIZON)
        found[caution] = environment, params, state, transitions
    return found


def test_branches_frighten_and_the_drive_is_the_same(played):
    (*_, plain), (*_, careful) = played.values()
    assert (careful.terms["collision"] >= plain.terms["collision"]).all()
    assert (careful.terms["collision"] > plain.terms["collision"] + 0.3).any()
    np.testing.assert_array_equal(careful.observation, plain.observation)
    np.testing.assert_array_equal(careful.terms["progress_m"], plain.terms["progress_m"])


def test_late_rewards_count_as_far_as_they_are_trusted(played):
    environment, params, state, careful = played[CAREFUL]
    trusting = dataclasses.replace(environment, caution=dataclasses.replace(CAREFUL, trust=()))
    _, full = environment_lib.play(trusting, params, jax.random.split(KEY, 1)[0], state, jnp.zeros((HORIZON, 2)),
                                   HORIZON)
    np.testing.assert_allclose(careful.reward, full.reward * jnp.array([1.0, 0.5, 0.25, 0.25]), rtol=1e-6)


def test_one_future_for_all_plans_and_futures_driven_again_are_as_careful(played):
    environment, params, state, transitions = played[CAREFUL]
    shared = jax.jit(planners.shared_future_returns(environment, params, state))(KEY, jnp.zeros((1, HORIZON, 2)))
    np.testing.assert_allclose(shared[0], (transitions.reward * 0.98 ** np.arange(HORIZON)).sum(), rtol=1e-5)
    coast = jax.tree_util.Partial(lambda key, observation: jnp.zeros(2))
    futures = futures_lib.imagine(environment, params, KEY, jnp.zeros(2, jnp.int32), coast, HORIZON)
    start = Motion(jnp.zeros((2, 3)), futures.speed_mps)
    reward = jax.jit(lambda start: futures_lib.drive(environment, futures, start, lambda seen, step: (
        jnp.zeros((2, 2)), ()))[1])(start)
    np.testing.assert_allclose(reward.T, futures.reward, atol=2e-4)
    more = futures.feared - futures.obstacles[:, 1:]
    assert (more >= -1e-6).all() and (more > 0.3).any()


def test_caution_by_hand():
    caution = uncertainty.Caution((0.8, 0.6), branches=3, quantile=0.5)
    np.testing.assert_allclose(caution.believed(jnp.full(4, 10.0), jnp.arange(4) + 1), [8, 6, 6, 6])
    logits = jnp.array([[[0.0, 1.0]], [[0.0, 3.0]], [[1.0, 0.0]]])  # branches, one voxel
    np.testing.assert_allclose(caution.feared(logits), [[0.0, 1.0]])
    np.testing.assert_allclose(dataclasses.replace(caution, quantile=1.0).feared(logits), [[0.0, 3.0]])
    assert uncertainty.Caution().believed(jnp.float32(2.0), jnp.int32(9)) == 2.0


def test_caution_that_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"trust is \[1.0, 1.2\]; expected a share in \[0, 1\] for each step"):
        uncertainty.Caution((1.0, 1.2))
    with pytest.raises(ValueError, match="branches"):
        uncertainty.Caution(branches=0)
    with pytest.raises(ValueError, match=r"caution.branches is 4, but the reward reads no occupancy"):
        worlds.make(caution=uncertainty.Caution(branches=4))
