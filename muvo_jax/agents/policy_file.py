"""A policy that was learned in a run's imagination, on disk: a folder with actor.safetensors and agent.json.

    policy_file.save(run.folder / policy_file.FOLDER, run, config, learner.actor, {"updates": 400})
    agent = policy_file.load(run.folder / policy_file.FOLDER, run)
    driver = closed_loop.policy_driver(simulator, agent.environment(run), run.variables, agent.policy())

A policy reads a latent state whose numbers mean something in one model alone, so agent.json says which one, down to a
checksum of its weights, and `load` refuses any other.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from muvo_jax import run as run_lib
from muvo_jax import safetensors_file
from muvo_jax.agents import actor_critic, fits
from muvo_jax.agents import environment as environment_lib
from muvo_jax.config import parsing
from muvo_jax.types import Variables

FOLDER = "agent"  # of a run, unless another place is named
WEIGHTS, DESCRIPTION = "actor.safetensors", "agent.json"
SCHEMA_VERSION = 2


@dataclasses.dataclass(frozen=True)
class StoredPolicy:
    """An agent as it was learned.

    Attributes:
      config: its networks and how they learned.
      actor: its parameters, float32.
      training: what its training says of itself, JSON types.
      observation: what it observes, "features" or "road" (Environment.observation).
    """

    config: actor_critic.ActorCriticConfig
    actor: Any
    training: Mapping[str, Any]
    observation: str = "features"

    def environment(self, run: run_lib.Run) -> environment_lib.Environment:
        """The environment whose observations it reads; rewards are not those in which it learned."""
        return _environment(run, self.observation)

    def policy(self, *, sampled: bool = False) -> jax.tree_util.Partial:
        """As actor_critic.policy; the mode of its actions unless sampled."""
        return actor_critic.policy(self.config, self.actor, sampled=sampled)


def save(folder: str | os.PathLike, run: run_lib.Run, config: actor_critic.ActorCriticConfig, actor: Any,
         training: Mapping[str, Any] | None = None, *, observation: str = "features") -> pathlib.Path:
    """Writes an agent; what stood there is replaced, the description last.

    Args:
      folder: made where it is missing.
      run: in whose imagination it learned.
      config, actor: settings and parameters of the actor (Learner.actor).
      training: what else agent.json should say, JSON types.
      observation: of the environment in which it learned.

    Returns:
      the folder.
    """
    folder = pathlib.Path(folder).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    flat = traverse_util.flatten_dict(jax.device_get(actor), sep="/")
    described = {"schema_version": SCHEMA_VERSION, "world_model": identity(run), "observation": observation,
                 "actor_critic": dataclasses.asdict(config), "training": dict(training or {})}
    partial = folder / f"{DESCRIPTION}.part"
    try:
        partial.write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
        safetensors_file.save(folder / WEIGHTS, {name: np.asarray(value) for name, value in flat.items()})
        partial.replace(folder / DESCRIPTION)
    finally:
        partial.unlink(missing_ok=True)
    return folder


def load(folder: str | os.PathLike, run: run_lib.Run) -> StoredPolicy:
    """Reads an agent of this run.

    Raises:
      ValueError: where the folder holds none, for one that learned in another model, with other actions or steps, and
        for damaged files; the message says which.
    """
    folder = pathlib.Path(folder).expanduser()
    missing = [name for name in (DESCRIPTION, WEIGHTS) if not (folder / name).is_file()]
    if missing:
        raise ValueError(f"{folder} holds no agent: it has no {' and no '.join(missing)}. Expected the folder that "
                         f"training an agent in the imagination of {run.folder} wrote.")
    path = folder / DESCRIPTION
    try:
        described = json.loads(path.read_text(encoding="utf-8"))
        version, learned_in, training, observation = (
            described[name] for name in ("schema_version", "world_model", "training", "observation"))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be read ({type(error).__name__}: {error}); train the agent anew.") from error
    if version != SCHEMA_VERSION:
        raise ValueError(f"{path} has schema {version}, this version reads {SCHEMA_VERSION}; train the agent anew.")
    if not isinstance(learned_in, Mapping):
        raise ValueError(f"{folder / DESCRIPTION}: world_model is {str(learned_in)[:80]}, expected a table of what the "
                         f"agent learned in. Train it again: python -m muvo_jax.train_agent.")
    _check_identity(learned_in, identity(run), folder, run)
    config = parsing.parse(actor_critic.ActorCriticConfig, described.get("actor_critic"), f"{path}: actor_critic")
    actor = traverse_util.unflatten_dict(
        {name: jnp.asarray(value) for name, value in safetensors_file.load(folder / WEIGHTS).items()}, sep="/")
    if observation not in fits.OBSERVATIONS:
        raise ValueError(f"{path}: the agent observes {observation!r}, this version knows "
                         f"{', '.join(fits.OBSERVATIONS)}.")
    stored = StoredPolicy(config, actor, training, observation)
    _check_network(stored, run, folder)
    return stored


def identity(run: run_lib.Run) -> dict[str, Any]:
    """What a policy depends on: the model, down to its weights, and what actions and steps mean."""
    return {"variant": run.model.config.variant, "latent": run.model.config.latent.kind,
            "features": run.model.policy_feature_channels, "periods": run.config.data.stride,
            "contract": dataclasses.asdict(run.contract), "update": run.step, "weights": fingerprint(run.variables)}


def fingerprint(variables: Variables) -> str:
    """16 hexadecimal digits that tell variables apart: of the SHA-256 of their paths and bytes."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.device_get(variables)):
        digest.update(f"{jax.tree_util.keystr(path)} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:16]


def _check_identity(learned_in: Mapping[str, Any], here: Mapping[str, Any], folder: pathlib.Path,
                    run: run_lib.Run) -> None:
    different = [f"{name} {learned_in.get(name)!r} (agent) against {here[name]!r} (run)" for name in here
                 if learned_in.get(name) != here[name]]
    if different:
        mend = "Train an agent in this run"
        if set(here) - {"update", "weights"} <= {name for name in here if learned_in.get(name) == here[name]}:
            mend += f", or load the weights in which it learned (--checkpoint={learned_in.get('update')})"
        raise ValueError(f"{folder}: this agent learned in another model than that of {run.folder}: "
                         f"{'; '.join(different)}. {mend}.")


def _environment(run, observation):
    """For what a policy observes. It rewards nothing: models would need heads that the policy does not look at."""
    return environment_lib.Environment.of_run(run, observation=observation, reward_function=_no_reward, reward_heads=())


def _no_reward(moment):
    del moment
    return 0.0, False, {}


def _check_network(stored: StoredPolicy, run: run_lib.Run, folder: pathlib.Path) -> None:
    """Raises ValueError where the parameters are not those of the network that the settings describe."""
    shape = stored.environment(run).observation_shapes.shape
    observation = jax.ShapeDtypeStruct((1, *shape), jnp.float32)
    wrong = [name for name, leaf in traverse_util.flatten_dict(stored.actor, sep="/").items()
             if not np.isfinite(np.asarray(leaf)).all()]
    if wrong:
        raise ValueError(f"{folder}: the parameters {', '.join(wrong)} are not finite; train the agent anew.")
    try:
        jax.eval_shape(lambda seen: stored.policy()(jax.random.key(0), seen), observation)
    except Exception as error:  # flax has many
        raise ValueError(f"{folder}: {WEIGHTS} does not fit the settings in {DESCRIPTION} (width "
                         f"{stored.config.width}, {stored.config.layers} layers): {error}") from error
