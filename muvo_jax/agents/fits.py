"""Whether an environment, its model and its starts fit each other: said by name, before anything is compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from muvo_jax.agents import episodes, rewards
from muvo_jax.model import memory as memory_lib

if TYPE_CHECKING:
    from muvo_jax.agents.environment import Environment

OBSERVATIONS = ("features", "road")  # beside tuples of decoded heads


def settings(environment: Environment) -> None:
    """Raises ValueError for settings of an environment that contradict each other or its model."""
    config, observation = environment.model.config, environment.observation
    if not observation or (isinstance(observation, str) and observation not in OBSERVATIONS):
        raise ValueError(f"Environment: observation is {observation!r}, expected \"features\", \"road\" or a tuple of "
                         f"decoded heads such as (\"image\",).")
    missing = [head for head in environment.decoded_heads if head not in config.heads]
    if missing:
        names = ", ".join(missing)
        raise ValueError(f"Environment: reward or observation read the head {names}, but this run trained "
                         f"{', '.join(config.heads)}. Train it (--with-heads={','.join(missing)}); for a reward "
                         f"without occupancy pass reward_config=RewardConfig(collision=0.0).")
    if environment.tests_collisions and "occupancy" not in environment.rewarded_heads:
        raise ValueError(f"Environment: the driving reward seeks collisions in occupancy, which is not among "
                         f"reward_heads={environment.reward_heads}; leave reward_heads out, or pass "
                         f"reward_config=RewardConfig(collision=0.0).")
    if environment.ego_path is None and environment.reward_function is None:
        raise ValueError(f"Environment: the driving reward needs the ego path, contract.kinematics is "
                         f"{environment.contract.kinematics!r}, and this run trained no head ego_motion. Train it "
                         f"(--with-heads=ego_motion), or pass a reward_function of your own.")
    if environment.caution.branches > 1 and "occupancy" not in environment.rewarded_heads:
        raise ValueError(f"Environment: caution.branches is {environment.caution.branches}, but the reward reads no "
                         f"occupancy in which branches could differ; expected 1, or a reward with collisions.")
    if environment.reads_obstacles:
        grid, scale = config.voxels, environment.reward_config.occupancy_scale
        rewards.obstacle_layers(grid.shape[2] // scale, grid, environment.reward_config.box, pooled=environment.pooled)


def starts(environment: Environment, bank: episodes.StartBank) -> None:
    """Raises ValueError for starts of another model or recording, none, or ones without a memory that is needed."""
    episodes.check(environment.model, bank)
    guessed = memory_lib.guessed_heads(environment.model.config)
    if not set(guessed).isdisjoint(environment.decoded_heads) and (bank.memory is None or bank.row is None):
        raise ValueError(f"StartBank: it has no memory, but the heads {', '.join(guessed)} of this model look at what "
                         f"was seen of late; make it of what `observe` returned (Environment.starts).")
