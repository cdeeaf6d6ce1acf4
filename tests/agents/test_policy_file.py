"""A learned policy on disk: what was saved comes back, and an agent of another model is refused by name."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import MODEL, variables

from muvo_jax import config as config_lib
from muvo_jax import presets, safetensors_file
from muvo_jax import run as run_lib
from muvo_jax.agents import actor_critic, policy_file, road
from muvo_jax.model import world_model

SETTINGS = actor_critic.ActorCriticConfig(width=8, layers=1, horizon=5)
RUN = run_lib.Run(MODEL, variables(), presets.get("tiny"), step=7)


@pytest.fixture(scope="module")
def actor():
    shapes = actor_critic._actor(SETTINGS).init(jax.random.key(0), jnp.zeros(MODEL.policy_feature_channels))
    return jax.tree.map(lambda leaf: leaf + 0.1, shapes)  # a fresh actor drives straight on, whatever it sees


def test_an_agent_comes_back_as_it_was(actor, tmp_path):
    folder = policy_file.save(tmp_path / "a" / "agent", RUN, SETTINGS, actor, {"updates": 3})
    assert sorted(path.name for path in folder.iterdir()) == ["actor.safetensors", "agent.json"]
    agent = policy_file.load(folder, RUN)
    assert agent.config == SETTINGS and agent.training == {"updates": 3}
    seen = jax.random.normal(jax.random.key(1), (2, MODEL.policy_feature_channels))
    actions = agent.policy()(jax.random.key(0), seen)
    np.testing.assert_array_equal(actions, actor_critic.policy(SETTINGS, actor, sampled=False)(jax.random.key(0), seen))
    assert actions.shape == (2, 2) and np.abs(actions[0] - actions[1]).max() > 0
    assert agent.environment(RUN).observation == "features"


def test_an_agent_that_saw_the_road_gets_the_road(tmp_path):
    shapes = actor_critic._actor(SETTINGS).init(jax.random.key(0), jnp.zeros(road.CHANNELS))
    policy_file.save(tmp_path, RUN, SETTINGS, shapes, observation="road")
    assert policy_file.load(tmp_path, RUN).environment(RUN).observation_shapes.shape == (road.CHANNELS,)
    described = json.loads((tmp_path / "agent.json").read_text())
    for observation, message in (("features", "does not fit the settings"), ("smell", "observes 'smell', this")):
        (tmp_path / "agent.json").write_text(json.dumps(described | {"observation": observation}))
        with pytest.raises(ValueError, match=message):
            policy_file.load(tmp_path, RUN)


@pytest.mark.parametrize(("change", "message"), [
    ({"variables": {"params": {"x": np.ones(2, np.float32)}}, "step": 9}, r"weights '\w+' \(agent\).*checkpoint=7"),
    ({"config": dataclasses.replace(RUN.config, data=dataclasses.replace(RUN.config.data, stride=1))},
     r"learned in another model.*periods \d \(agent\) against 1 \(run\)\. Train an agent in this run\.$"),
    ({"config": dataclasses.replace(RUN.config, contract=dataclasses.replace(RUN.contract, steer_full_rad=0.3))},
     r"contract .*'steer_full_rad': 0.6"),
])
def test_an_agent_of_another_model_is_refused(change, message, actor, tmp_path):
    folder = policy_file.save(tmp_path, RUN, SETTINGS, actor)
    with pytest.raises(ValueError, match=message):
        policy_file.load(folder, dataclasses.replace(RUN, **change))


def test_what_is_no_agent_is_refused(actor, tmp_path):
    with pytest.raises(ValueError, match=r"holds no agent: it has no agent\.json and no actor\.safetensors"):
        policy_file.load(tmp_path, RUN)
    folder = policy_file.save(tmp_path, RUN, dataclasses.replace(SETTINGS, width=16), actor)
    with pytest.raises(ValueError, match=r"does not fit the settings in agent\.json \(width 16"):
        policy_file.load(folder, RUN)
    policy_file.save(folder, RUN, SETTINGS, jax.tree.map(lambda leaf: leaf * np.nan, actor))
    with pytest.raises(ValueError, match="are not finite"):
        policy_file.load(folder, RUN)
    described = json.loads((folder / "agent.json").read_text())
    described["actor_critic"]["widht"] = 3
    (folder / "agent.json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match="'widht' is unknown"):
        policy_file.load(folder, RUN)
    (folder / "agent.json").write_text("{")
    with pytest.raises(ValueError, match="cannot be read"):
        policy_file.load(folder, RUN)
    policy_file.save(folder, RUN, SETTINGS, actor)
    (folder / "actor.safetensors").write_bytes(b"nonsense")
    with pytest.raises(safetensors_file.SafetensorsError):
        policy_file.load(folder, RUN)


def test_an_agent_of_a_reward_of_ones_own_comes_back_where_no_path_is_known(actor, tmp_path):
    config = config_lib.override(presets.get("tiny"), "contract.kinematics", "none")
    run = run_lib.Run(world_model.WorldModel(config.model), variables(), config, step=7)
    policy_file.save(tmp_path, run, SETTINGS, actor, {"updates": 3})
    assert policy_file.load(tmp_path, run).environment(run).observation == "features"
