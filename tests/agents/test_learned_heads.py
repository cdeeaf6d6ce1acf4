"""Heads that a world model may learn for agents: reward, continue, ego_motion; their losses and what reads them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import CONFIG, HORIZON, bank

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import rewards
from muvo_jax.model import rollout, world_model
from muvo_jax.objectives import total
from muvo_jax.ops import motion as motion_ops
from muvo_jax.run import Run

LEARNED = ("reward", "continue", "ego_motion")
MODEL = world_model.WorldModel(dataclasses.replace(CONFIG, heads=LEARNED))
CARLA = config_lib.Config(contract=config_lib.ActionContract(kinematics="none"), data=config_lib.DataConfig(stride=2))


@pytest.fixture(scope="module")
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


def test_their_loss_terms_by_hand():
    motion = jnp.array([[[9.0, 9.0, 9.0, 5.0], [1.0, 0.1, 0.05, 10.0]]])
    batch = types.Batch(jnp.zeros((1, 2, 2)), jnp.array([[True, False]]), reward=jnp.array([[0.5, -1.0]]),
                        is_terminal=jnp.array([[False, True]]), ego_motion=motion)
    predictions = types.Predictions({
        "reward": {1: jnp.array([[[0.0], [0.0]]])}, "continue": {1: jnp.array([[[0.0], [2.0]]])},
        "ego_motion": {1: jnp.zeros((1, 2, 4))}})
    values, loss = {}, config_lib.LossConfig()
    for head in LEARNED:
        total.check_head(head, predictions, batch, MODEL.config, loss)
        sums = head_lib.get(head).losses(head_lib.Learned(predictions.scales(head), batch, MODEL.config, loss,
                                                          jax.random.split(jax.random.key(0), 1)))
        values |= {name: float(value) for part, found in sums.items() for name, value in found.terms(part).items()}
    want = {"reward": (0.25 + 1.0) / 2, "continue": (np.log(2) + np.log1p(np.exp(2))) / 2,
            "ego_motion": 1.0 + 1.0 + 1.0, "ego_speed": (1.0 + 2.0) / 2}  # where a window begins there is no motion
    assert values == pytest.approx(want, rel=1e-5)
    assert set(values) <= set(total.term_weights(config_lib.LossConfig(), LEARNED))


def test_without_kinematics_the_path_is_the_heads(variables):
    world = environment_lib.Environment.of_run(Run(MODEL, {}, CARLA), learned_reward=True)
    assert world.ego_path == "ego_motion" and world.decoded_heads == LEARNED
    params = world.params(variables, bank(), HORIZON)
    _, state = world.reset(jax.random.key(0), params)
    plan = jnp.zeros((HORIZON, 2))
    states, transitions = environment_lib.play(world, params, jax.random.key(1), state, plan, HORIZON)
    decoded = rollout.decode(MODEL, variables, states.latent, LEARNED)
    motion = state.motion
    for step in decoded.ego_motion:
        motion = motion_ops.moved(motion, step)
    np.testing.assert_allclose(states.motion.pose[-1], motion.pose, atol=1e-5)
    np.testing.assert_allclose(states.motion.speed_mps[-1], motion.speed_mps, atol=1e-5)
    np.testing.assert_allclose(transitions.reward, decoded.reward[:, 0], atol=1e-5)
    np.testing.assert_array_equal(transitions.terminated, decoded["continue"][:, 0] < 0)


def test_a_step_of_the_head_is_composed_with_the_heading_of_the_car():
    motion = types.Motion(jnp.array([1.0, 2.0, jnp.pi / 2]), jnp.float32(3.0))
    after = motion_ops.moved(motion, jnp.array([2.0, 0.5, 0.1, 4.0]))
    np.testing.assert_allclose(after.pose, [0.5, 4.0, np.pi / 2 + 0.1], atol=1e-6)
    assert after.speed_mps == 4.0


def test_comfort_without_a_bicycle_is_that_of_the_motion():
    before = types.Motion(jnp.array([0.0, 0.0, 0.0]), jnp.float32(9.0))
    after = motion_ops.moved(before, jnp.array([2.0, 0.0, 0.03, 10.0]))
    moment = rewards.Moment(before, after, jnp.zeros(2), jnp.zeros(3), {})
    got = rewards.discomfort(moment, CARLA.contract, 0.2, rewards.RewardConfig(comfortable_mps2=3.0))
    np.testing.assert_allclose(got, ((1.0 / 0.2) ** 2 + (10.0 * 0.03 / 0.2) ** 2) / 9.0, rtol=1e-5)


@pytest.mark.parametrize("heads, options, message", [
    (("action",), {}, r"read the head occupancy.*\(--with-heads=occupancy\)"),
    (("action",), {"learned_reward": True}, r"read the head reward, continue, but this run trained action"),
    (("action",), {"reward_config": rewards.RewardConfig(collision=0.0)}, r"no head ego_motion.*=ego_motion"),
])
def test_a_head_that_the_run_did_not_train_is_named(heads, options, message):
    blind = world_model.WorldModel(dataclasses.replace(CONFIG, heads=heads))
    with pytest.raises(ValueError, match=message):
        environment_lib.Environment.of_run(Run(blind, {}, CARLA), **options)
