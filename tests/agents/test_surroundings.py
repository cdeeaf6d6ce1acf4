"""Other people's surroundings: 64-bit JAX, forward mode, processes that fork or spawn, and numbers that are none."""

import dataclasses
import json
import multiprocessing
import os
import pathlib
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import Run, decode, imagine, imagine_step, observe, observe_step, presets, start_live
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import forks, planners, rewards
from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import Batch

ROOT = pathlib.Path(__file__).parents[2]
CONFIG = presets.get("tiny")
NAN = float("nan")


@pytest.fixture(scope="module")
def world():
    model = WorldModel(dataclasses.replace(CONFIG.model, lidar=None, heads=("image", "action")))
    variables = model.init(jax.random.key(0))
    environment = environment_lib.Environment.of_run(Run(model, variables, CONFIG),
                                                     reward_config=rewards.RewardConfig(collision=0.0))
    bank = environment_lib.StartBank(model.initial_state(2), jnp.ones(2, jnp.float32))
    return environment, environment.params(variables, bank, horizon=3)


def test_64_bit_jax_gives_the_same_numbers():
    """In a process of its own: imagination, environment, planners and actor-critic in float32, whatever the default."""
    program = """
import sys, jax, jax.numpy as jnp, numpy as np, json, dataclasses
from muvo_jax import Environment, Run, imagine, presets
from muvo_jax.agents import actor_critic, environment, planners, rewards
from muvo_jax.model.world_model import WorldModel
config = presets.get("tiny")
model = WorldModel(dataclasses.replace(config.model, heads=("action",)))
variables = model.init(jax.random.key(0))
start = model.initial_state(2)
world = Environment.of_run(Run(model, variables, config), reward_config=rewards.RewardConfig(collision=0.0))
params = world.params(variables, environment.StartBank(start, jnp.ones(2, jnp.float32)), horizon=3)
_, state = world.reset(jax.random.key(2), params)
dream = imagine(model, variables, jax.random.key(1), start, np.full((2, 3, 2), 0.25))
_, played = environment.play(world, params, jax.random.key(3), state, np.full((3, 2), 0.25), 3)
objective = planners.imagined_returns(world, params, state)
plan = planners.cem(objective, jax.random.key(0), np.zeros((2, 2)), planners.PlannerConfig(
    plans=4, elites=2, kept=1, iterations=2))
settings = actor_critic.ActorCriticConfig(starts=2, horizon=2, width=4, layers=1)
learner = actor_critic.init(jax.random.key(0), world, settings)
learner, metrics = actor_critic.update(world, settings, params, jax.random.key(1), learner)
found = {"dream": dream.features, "reward": played.reward, "plan": plan.actions, "loss": metrics["critic_loss"]}
assert {leaf.dtype for leaf in found.values()} == {np.dtype("float32")}, found
print(json.dumps({name: float(np.asarray(leaf, np.float64).sum()) for name, leaf in found.items()}))
"""
    sums = []
    for wide in ("0", "1"):
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=ROOT,
                              env=os.environ | {"JAX_ENABLE_X64": wide, "PYTHONPATH": str(ROOT)})
        assert done.returncode == 0, done.stderr[-2000:]
        sums.append(json.loads(done.stdout.splitlines()[-1]))
    assert sums[0] == pytest.approx(sums[1], rel=1e-4, abs=1e-4)


def test_forward_mode_is_refused_before_tracing_and_the_plain_form_has_it(world):
    environment, params = world
    model, variables = environment.model, params.variables
    start, actions = model.initial_state(1), jnp.zeros((1, 2, 2))

    def brightness(model):
        return lambda actions: decode(model, variables, imagine(model, variables, jax.random.key(1), start, actions),
                                      ("image",)).at_scale(4).image.mean()

    for derive in (lambda f: jax.jvp(f, (actions,), (actions,)), lambda f: jax.jacfwd(f)(actions),
                   lambda f: jax.jvp(jax.vmap(f), (actions[None],), (actions[None],))):
        with pytest.raises(TypeError, match=r"decode: forward-mode derivatives .*convolution=\"xla\""):
            derive(brightness(model))
    slope = jax.grad(brightness(model))(actions)
    plain = WorldModel(dataclasses.replace(model.config, convolution="xla"))
    np.testing.assert_allclose(jax.jacfwd(brightness(plain))(actions), slope, atol=1e-6)
    world_of_images = dataclasses.replace(environment, observation=("image",))
    _, state = environment.reset(jax.random.key(0), params)
    step = lambda action: world_of_images.step(jax.random.key(0), state, action, params)[1].reward
    with pytest.raises(TypeError, match=r"Environment.step: forward-mode"):
        jax.jvp(step, (jnp.zeros(2),), (jnp.ones(2),))


def window(model, **changes):
    fields = {"image": np.zeros((1, 2, *model.config.image_size, 3), np.uint8),
              "speed_mps": np.zeros((1, 2), np.float32), "route_map": np.zeros((1, 2, 64, 64), np.uint8),
              "action": np.zeros((1, 2, 2), np.float32)}
    return Batch(is_first=np.array([[True, False]]), **fields | changes)


def test_nan_is_refused_at_every_door(world):
    environment, params = world
    model, variables, key = environment.model, params.variables, jax.random.key(0)
    state = model.initial_state(1)
    lost = jax.tree.map(lambda leaf: leaf.at[..., 0].set(NAN), state)
    with pytest.raises(ValueError, match=r"observe: speed_mps \[1, 2\] holds 2 values that are not finite"):
        observe(model, variables, key, window(model, speed_mps=np.full((1, 2), NAN, np.float32)))
    with pytest.raises(ValueError, match=r"observe: action \[1, 2, 2\] holds 4 values"):
        observe(model, variables, key, window(model, action=np.full((1, 2, 2), NAN, np.float32)))
    seen = window(model)
    observation = {name: getattr(seen, name)[:, 0] for name in ("image", "route_map", "speed_mps")}
    with pytest.raises(ValueError, match=r"observe_step: 1 values of the actions .* are not finite"):
        observe_step(model, variables, start_live(model, key), observation, np.array([[NAN, 0.0]]))
    with pytest.raises(ValueError, match=r"observe_step: speed_mps"):
        observe_step(model, variables, start_live(model, key), observation | {"speed_mps": np.float32([np.inf])},
                     np.zeros((1, 2)))
    with pytest.raises(ValueError, match="imagine: state"):
        imagine(model, variables, key, lost, np.zeros((1, 2, 2)))
    with pytest.raises(ValueError, match="imagine_step: state"):
        imagine_step(model, variables, key, jax.device_get(lost), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="imagine: temperature"):
        imagine(model, variables, key, state, np.zeros((1, 2, 2)), temperature=NAN)
    _, started = environment.reset(key, params)
    with pytest.raises(ValueError, match=r"Environment.step: 1 values of the actions"):
        environment.step(key, started, np.array([NAN, 0.0]), params)
    with pytest.raises(ValueError, match="play: 2 values of the actions"):
        environment_lib.play(environment, params, key, started, np.array([[NAN, NAN]]), 1)
    with pytest.raises(ValueError, match=r"StartBank: speed_mps"):
        environment.params(variables, environment_lib.StartBank(state, jnp.full(1, NAN)), 3)
    for planner in planners.PLANNERS.values():
        with pytest.raises(ValueError, match=r"planner: start \[2, 2\] holds 4 values"):
            planner(lambda key, plans: plans.sum(axis=(1, 2)), key, np.full((2, 2), NAN))


@pytest.mark.parametrize("horizon", [2.5, True, "3"])
def test_horizons_are_whole_numbers(world, horizon):
    environment, params = world
    with pytest.raises(ValueError, match=f"horizon is {horizon!r}; expected a whole number"):
        environment.params(params.variables, params.bank, horizon=horizon)


def test_environments_can_be_pickled(world):
    environment, params = world
    again, packed = pickle.loads(pickle.dumps((environment, jax.device_get(params))))
    assert again == environment and hash(again) == hash(environment)
    state = environment.reset(jax.random.key(1), params)[1]
    for chosen, given in ((environment, params), (again, packed)):
        _, transition = chosen.step(jax.random.key(2), state, np.zeros(2), given)
        assert float(transition.reward) == pytest.approx(float(environment.step(
            jax.random.key(2), state, np.zeros(2), params)[1].reward))


def _reset_in_a_child(environment, params, answers):
    try:
        environment.reset(jax.random.key(0), params)
        answers.put("went on")
    except RuntimeError as error:
        answers.put(str(error))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_is_told_instead_of_waiting_for_ever(world):
    environment, params = world
    forks.check("here")  # this process was not forked
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    child = context.Process(target=_reset_in_a_child, args=(environment, params, answers))
    child.start()
    assert "context=\"spawn\"" in answers.get(timeout=60)
    child.join()


def test_gymnasium_environments_travel_and_refuse_nan(world):
    pytest.importorskip("gymnasium")
    from muvo_jax.agents.doors import gymnasium_env

    door = gymnasium_env.GymnasiumImagination(*world)
    door.reset(seed=0)
    with pytest.raises(ValueError, match=r"Imagination.step: at step 0 of the episode the action is \[nan, 0.0\]"):
        door.step(np.array([NAN, 0.0]))
    again = pickle.loads(pickle.dumps(door))
    for action in (np.zeros(2), np.array([3.0, -3.0])):  # what is outside [-1, 1] is clipped
        (observation, reward, *_), (other, other_reward, *_) = door.step(action), again.step(action)
        np.testing.assert_allclose(observation, other)
        assert reward == pytest.approx(other_reward) and np.isfinite(reward)
