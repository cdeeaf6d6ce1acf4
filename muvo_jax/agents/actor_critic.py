"""An actor-critic that learns in imagination alone, after DreamerV3 (Hafner et al. 2023), small enough to read.

`update` imagines `horizon` steps from a batch of start states under the actor, computes lambda returns from the critic,
and moves both: the critic towards the returns, the actor along the score function, with the returns' spread
(percentiles 5 to 95) as scale and entropy as bonus. Differs from DreamerV3: the critic regresses symlog returns by
squared error, not by two-hot classes, and the world model stays frozen.

`improve` does the same in futures that were imagined before (agents/futures.py), where a step costs a fraction and
where the car goes has a derivative: part of the actor's gradient is that of the return through the path (DreamerV1).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from flax import linen

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import futures as futures_lib
from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, above, check
from muvo_jax.ops import precision
from muvo_jax.types import Array

_GONE = 1e-3  # where less is left of a drive, what it earns is not divided by so little


@dataclasses.dataclass(frozen=True)
class ActorCriticConfig:
    """Settings; the names are those of the field.

    Attributes:
      starts, horizon: imagined drives per update and their steps.
      width, layers: of both perceptrons.
      target_rate: of the exponential average that gives bootstrap values.
      score: share of the score function in the actor's gradient in `improve`; the rest is the derivative of the return
        through the car's path, which steers well but hardly brakes: a probability that has risen to 1 has no slope.
    """

    starts: Annotated[int, COUNT] = 64
    horizon: Annotated[int, COUNT] = 12
    width: Annotated[int, COUNT] = 128
    layers: Annotated[int, COUNT] = 2
    discount: Annotated[float, SHARE] = 0.98
    lambda_: Annotated[float, SHARE] = 0.95
    entropy: Annotated[float, NOT_NEGATIVE] = 3e-3
    learning_rate: Annotated[float, above(0)] = 3e-4
    clip_norm: Annotated[float, above(0)] = 100.0
    target_rate: Annotated[float, SHARE] = 0.02
    scale_rate: Annotated[float, SHARE] = 0.01
    score: Annotated[float, SHARE] = 0.5

    def __post_init__(self):
        check(self)


@flax.struct.dataclass
class Learner:
    """All that learns: parameters of actor and critic, the critic's slow copy, the returns' scale, the optimiser."""

    actor: Any
    critic: Any
    slow_critic: Any
    scale: Array
    opt_state: Any
    step: Array


class Perceptron(linen.Module):
    """[..., F] -> [..., outputs]: dense layers with RMS norm and SiLU, the last one starting at zero."""

    width: int
    layers: int
    outputs: int

    @linen.compact
    def __call__(self, x: Array) -> Array:
        for _ in range(self.layers):
            x = linen.silu(linen.RMSNorm()(linen.Dense(self.width, precision=precision.PRODUCTS)(x)))
        return linen.Dense(self.outputs, kernel_init=linen.initializers.zeros, precision=precision.PRODUCTS)(x)


def symlog(x: Array) -> Array:
    """sign(x) log(1 + |x|)."""
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: Array) -> Array:
    """The inverse of symlog."""
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def lambda_returns(reward: Array, discount: Array, value: Array, lambda_: float,
                   truncated: Array | None = None) -> Array:
    """R_t = r_t + g_t ((1 - lambda) v_t+1 + lambda R_t+1), the last one, and truncated ones, bootstrapped from v_t+1.

    Args:
      reward, discount: [H, ...] of each step; a discount of 0 ends the drive.
      value: [H, ...] of the state AFTER each step.
      lambda_: in [0, 1].
      truncated: bool [H, ...], where a drive is cut off though its world goes on; None for nowhere before the end.

    Returns:
      [H, ...].
    """
    truncated = jnp.zeros(reward.shape, jnp.bool_) if truncated is None else truncated

    def step(following, inputs):
        reward, discount, value, truncated = inputs
        following = jnp.where(truncated, value, following)
        here = reward + discount * ((1.0 - lambda_) * value + lambda_ * following)
        return here, here

    _, returns = jax.lax.scan(step, value[-1], (reward, discount, value, truncated), reverse=True)
    return returns


def _actor(config):
    return Perceptron(config.width, config.layers, 2 * environment_lib.ACTION_CHANNELS)


def _critic(config):
    return Perceptron(config.width, config.layers, 1)


def _moments(config, actor, observation):
    """Mean and standard deviation of the Gaussian whose tanh is the action."""
    mean, raw = jnp.split(_actor(config).apply(actor, observation), 2, axis=-1)
    return mean, 0.1 + 0.9 * jax.nn.sigmoid(raw)


def _log_probability(mean, std, drawn):
    """Of tanh(drawn), the constant left out: the Gaussian's minus the logarithm of tanh's slope."""
    normal = -0.5 * ((drawn - mean) / std) ** 2 - jnp.log(std)
    return (normal - 2.0 * (jnp.log(2.0) - drawn - jax.nn.softplus(-2.0 * drawn))).sum(axis=-1)


def _value(config, critic, observation):
    return symexp(_critic(config).apply(critic, observation)[..., 0])


def policy(config: ActorCriticConfig, actor: Any, *, sampled: bool = True) -> jax.tree_util.Partial:
    """The actor as policy(key, observation) -> action for `environment.play`; its mode unless sampled.

    Policies of one config are one function with other weights: none compiles anew.
    """
    return jax.tree_util.Partial(_Act(config, sampled), actor)


@dataclasses.dataclass(frozen=True)
class _Act:
    """Compares by its fields, as a closure or functools.partial would not."""

    config: ActorCriticConfig
    sampled: bool

    def __call__(self, actor, key, observation):
        mean, std = _moments(self.config, actor, observation)
        return jnp.tanh(mean + std * jax.random.normal(key, mean.shape, jnp.float32) if self.sampled else mean)


def init(key: Array, environment: environment_lib.Environment, config: ActorCriticConfig) -> Learner:
    """A fresh learner for observations that are one vector, "features" or "road".

    Raises:
      ValueError: for an environment that observes decoded heads.
    """
    key_actor, key_critic = jax.random.split(key)
    shape = environment.observation_shapes
    if not hasattr(shape, "shape"):
        raise ValueError(f"actor_critic.init: the environment observes the heads {', '.join(shape)}; expected one "
                         f"vector, observation=\"features\" or \"road\".")
    observation = jnp.zeros(shape.shape, jnp.float32)
    actor, critic = _actor(config).init(key_actor, observation), _critic(config).init(key_critic, observation)
    return Learner(actor, critic, critic, jnp.float32(1.0), _optimizer(config).init((actor, critic)), jnp.int32(0))


def _optimizer(config):
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.adam(config.learning_rate))


def imagine(environment, config, params, key, actor):
    """Drives under the actor: observations [H + 1, N, F], pre-tanh actions [H, N, 2], transitions [H, N, ...]."""
    key_reset, key_play = jax.random.split(key)
    observation, state = jax.vmap(environment.reset, (0, None))(jax.random.split(key_reset, config.starts), params)

    def step(carry, key):
        observation, state = carry
        key_action, key_step = jax.random.split(key)
        mean, std = _moments(config, actor, observation)
        drawn = mean + std * jax.random.normal(key_action, mean.shape, jnp.float32)
        keys = jax.random.split(key_step, config.starts)
        state, transition = jax.vmap(environment.step, (0, 0, 0, None))(keys, state, jnp.tanh(drawn), params)
        return (transition.observation, state), (observation, drawn, transition)

    (last, _), (seen, drawn, transitions) = jax.lax.scan(step, (observation, state),
                                                         jax.random.split(key_play, config.horizon))
    return jnp.concatenate([seen, last[None]]), drawn, transitions


@functools.partial(jax.jit, static_argnames=("environment", "config"))
def update(environment: environment_lib.Environment, config: ActorCriticConfig, params: environment_lib.EnvParams,
           key: Array, learner: Learner) -> tuple[Learner, dict[str, Array]]:
    """One update; metrics: "return" and "reward" (means), "entropy", "critic_loss", "actor_loss", "terminated".

    Steps after the end of an episode (params.max_steps_in_episode, if it is less than config.horizon) do not count.
    """
    seen, drawn, transitions = jax.lax.stop_gradient(imagine(environment, config, params, key, learner.actor))
    unharmed = None if environment.reward_function else transitions.terms.get("unharmed")
    reward, ends = _to_an_unharmed_car(transitions.reward, transitions.terminated, unharmed)
    drives = lambda actor: (seen, drawn, reward, ends, transitions.truncated)
    return _learn(config, learner, drives, score=1.0)


@functools.partial(jax.jit, static_argnames=("environment", "config"))
def improve(environment: environment_lib.Environment, config: ActorCriticConfig, futures: futures_lib.Futures,
            key: Array, learner: Learner) -> tuple[Learner, dict[str, Array]]:
    """One update from drives through imagined futures, of their horizon, that start scattered; metrics as `update`.

    Raises:
      ValueError: as futures.check.
    """
    futures_lib.check(environment)
    key_start, key_act = jax.random.split(key)
    start = futures_lib.scattered(key_start, futures.speed_mps)
    noise = jax.random.normal(key_act, (futures.horizon, futures.count, environment_lib.ACTION_CHANNELS), jnp.float32)

    def drives(actor):
        def act(observation, step):
            mean, std = _moments(config, actor, observation)
            drawn = mean + std * noise[step]
            return jnp.tanh(drawn), drawn

        seen, reward, ends, drawn = futures_lib.drive_unharmed(environment, futures, start, act)
        return seen, drawn, reward, ends, None

    return _learn(config, learner, drives, score=config.score)


def _to_an_unharmed_car(reward, terminated, unharmed):
    """What steps are worth to a car that came to them unharmed, and how likely they end its drive, [H, N]; as they are
    where the reward does not say how unharmed it is after them. So values are those of unharmed cars."""
    ends = terminated.astype(jnp.float32)
    if unharmed is None:
        return reward, ends
    before = jnp.maximum(jnp.concatenate([jnp.ones_like(unharmed[:1]), unharmed[:-1]]), _GONE)
    return reward / before, 1.0 - (1.0 - ends) * unharmed / before


def _learn(config, learner, drives, score):
    """One step of the optimiser. drives: actor -> observations [H + 1, N, F], actions before tanh [H, N, 2], and
    rewards, ends (bool, or how likely) and truncations (or None) [H, N]."""
    hold = jax.lax.stop_gradient

    def loss(networks):
        actor, critic = networks
        seen, drawn, reward, ends, truncated = drives(actor)
        going_on = 1.0 - ends.astype(jnp.float32)
        values = _value(config, learner.slow_critic, seen)
        returns = lambda_returns(reward, config.discount * going_on, values[1:], config.lambda_, truncated)
        # Steps after a predicted collision, or after the end of an episode, do not count.
        alive = jnp.cumprod(going_on if truncated is None else going_on * ~truncated, axis=0)
        weight = hold(jnp.concatenate([jnp.ones_like(alive[:1]), alive[:-1]]))
        spread = hold(jnp.percentile(returns, 95) - jnp.percentile(returns, 5))
        scale = (1.0 - config.scale_rate) * learner.scale + config.scale_rate * spread
        unit = jnp.maximum(scale, 1.0)
        here = hold(seen[:-1])
        advantage = hold(returns - _value(config, critic, here)) / unit
        mean, std = _moments(config, actor, here)
        entropy = jnp.log(std).sum(axis=-1)
        gain = config.entropy * entropy + score * advantage * _log_probability(mean, std, hold(drawn))
        if score < 1.0:
            gain = gain + (1.0 - score) * returns / unit
        actor_loss = -(weight * gain).mean()
        predicted = _critic(config).apply(critic, here)[..., 0]
        critic_loss = (weight * (predicted - symlog(hold(returns))) ** 2).mean()
        return actor_loss + critic_loss, (scale, {
            "actor_loss": actor_loss, "critic_loss": critic_loss, "entropy": entropy.mean(),
            "return": returns[0].mean(), "reward": (weight * reward).mean(), "terminated": ends.mean()})

    gradients, (scale, metrics) = jax.grad(loss, has_aux=True)((learner.actor, learner.critic))
    updates, opt_state = _optimizer(config).update(gradients, learner.opt_state)
    actor, critic = optax.apply_updates((learner.actor, learner.critic), updates)
    slow_critic = optax.incremental_update(critic, learner.slow_critic, config.target_rate)
    return Learner(actor, critic, slow_critic, scale, opt_state, learner.step + 1), metrics
