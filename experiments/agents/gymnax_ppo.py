"""PPO as one jitted program, after the pattern of PureJaxRL, through the gymnax door.

    python experiments/agents/gymnax_ppo.py [--run=RUN] [--steps=...]

With a run it learns to drive: in futures that its policy imagined from recorded moments (agents/futures.py), a few
times anew; then the town judges it. Without one it shows that such a program runs through the door.

Of the environment it knows gymnax's interface alone. Advantages bootstrap from `info["final_observation"]` where an
episode was truncated, and from nothing where it terminated.
"""

import argparse
import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
import worlds
from flax import linen

from muvo_jax.agents.doors import gymnax_env


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings, under the names of the field."""

    envs: int = 64
    unroll: int = 15
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 1e-3
    discount: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_weight: float = 0.5
    entropy_weight: float = 1e-3
    max_grad_norm: float = 0.5
    width: int = 64


class ActorCritic(linen.Module):
    """[..., F] -> mean [..., A], standard deviation [A], value [...]."""

    actions: int
    width: int

    @linen.compact
    def __call__(self, x):
        def head(outputs, scale):
            hidden = x
            for _ in range(2):
                hidden = jnp.tanh(linen.Dense(self.width, kernel_init=linen.initializers.orthogonal(2**0.5))(hidden))
            return linen.Dense(outputs, kernel_init=linen.initializers.orthogonal(scale))(hidden)

        std = jnp.exp(self.param("log_std", linen.initializers.constant(-0.5), (self.actions,)))
        return head(self.actions, 0.01), std, head(1, 1.0)[..., 0]


@flax.struct.dataclass
class Step:
    """One step of all cars, as PPO learns from it."""

    observation: Any
    action: Any
    log_probability: Any
    value: Any
    reward: Any
    terminated: Any
    done: Any
    final_value: Any  # of the observation before auto-reset
    finished_return: Any  # of the episode that ended here, else 0


def log_probability(mean, std, action):
    """Of a diagonal Gaussian, [...]."""
    return (-0.5 * ((action - mean) / std) ** 2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)).sum(axis=-1)


def advantages(steps: Step, config: PPOConfig):
    """Generalised advantage estimates [T, envs]."""
    def back(following, step):
        alive = 1.0 - step.terminated
        delta = step.reward + config.discount * alive * step.final_value - step.value
        here = delta + config.discount * config.gae_lambda * (1.0 - step.done) * following
        return here, here

    return jax.lax.scan(back, jnp.zeros_like(steps.value[0]), steps, reverse=True)[1]


def loss(network, config, params, data):
    steps, advantage = data
    mean, std, value = network.apply(params, steps.observation)
    ratio = jnp.exp(log_probability(mean, std, steps.action) - steps.log_probability)
    scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    policy = -jnp.minimum(ratio * scaled, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * scaled).mean()
    critic = 0.5 * ((value - (advantage + steps.value)) ** 2).mean()
    return policy + config.value_weight * critic - config.entropy_weight * jnp.log(std).sum()


def make_train(env, config: PPOConfig, updates: int):
    """(init(key) -> learner, train(learner, key, env_params) -> learner and the mean return [updates] of the episodes
    that ended in each update, nan where none did)."""
    network = ActorCritic(2, config.width)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate))
    reset = jax.vmap(env.reset, (0, None))
    advance = jax.vmap(env.step, (0, 0, 0, None))

    def act(params, env_params, carry, key):
        observation, state, so_far = carry
        key_action, key_step = jax.random.split(key)
        mean, std, value = network.apply(params, observation)
        action = mean + std * jax.random.normal(key_action, mean.shape)
        inside = jnp.clip(action, -1.0, 1.0)
        following, state, reward, terminated, truncated, info = advance(
            jax.random.split(key_step, config.envs), state, inside, env_params)
        done = (terminated | truncated).astype(jnp.float32)
        so_far = so_far + reward
        final_value = network.apply(params, info["final_observation"])[2]
        step = Step(observation, action, log_probability(mean, std, action), value, reward,
                    terminated.astype(jnp.float32), done, final_value, done * so_far)
        return (following, state, so_far * (1.0 - done)), step

    def epoch(carry, key, steps):
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (steps, advantages(steps, config)))
        order = jax.random.permutation(key, config.envs * config.unroll).reshape(config.minibatches, -1)

        def minibatch(carry, chosen):
            params, opt_state = carry
            data = jax.tree.map(lambda leaf: leaf[chosen], flat)
            gradient = jax.grad(functools.partial(loss, network, config))(params, data)
            change, opt_state = optimizer.update(gradient, opt_state)
            return (optax.apply_updates(params, change), opt_state), None

        return jax.lax.scan(minibatch, carry, order)[0], None

    def update(env_params, carry, key):
        learner, driving = carry
        key_act, key_learn = jax.random.split(key)
        driving, steps = jax.lax.scan(functools.partial(act, learner[0], env_params), driving,
                                      jax.random.split(key_act, config.unroll))
        learner, _ = jax.lax.scan(functools.partial(epoch, steps=steps), learner,
                                  jax.random.split(key_learn, config.epochs))
        return (learner, driving), steps.finished_return.sum() / steps.done.sum()

    def init(key):
        shape = env.observation_space(env.default_params).shape
        params = network.init(key, jnp.zeros((config.envs, *shape)))
        return params, optimizer.init(params)

    def train(learner, key, env_params):
        key_reset, key_train = jax.random.split(key)
        observation, state = reset(jax.random.split(key_reset, config.envs), env_params)
        carry = (learner, (observation, state, jnp.zeros(config.envs)))
        (learner, _), returns = jax.lax.scan(functools.partial(update, env_params), carry,
                                             jax.random.split(key_train, updates))
        return learner, returns

    return init, jax.jit(train)


def drawn(config, params, key, observation):
    """The policy that learns: a drawn action of one observation."""
    mean, std, _ = ActorCritic(2, config.width).apply(params, observation)
    return jnp.clip(mean + std * jax.random.normal(key, mean.shape), -1.0, 1.0)


def mode(config, params, key, observation):
    """The policy that is judged."""
    return jnp.clip(ActorCritic(2, config.width).apply(params, observation)[0], -1.0, 1.0)


def learn_to_drive(options):
    """Rounds of imagining futures under the policy and learning in them; then the policy drives in the town."""
    dreams, config = worlds.Dreams(options.run), PPOConfig(envs=512, unroll=12)
    per_round = options.steps // options.rounds
    updates = max(1, per_round // (config.envs * config.unroll))
    learner = train = None
    for index in range(options.rounds + 1):
        key_dream, key_learn = jax.random.split(jax.random.fold_in(jax.random.key(0), index))
        policy = jax.tree_util.Partial(functools.partial(drawn, config), learner[0] if learner else None)
        if learner is None:
            policy = jax.tree_util.Partial(lambda key, seen: jnp.tanh(0.5 * jax.random.normal(key, (2,))))
        imagined = dreams.futures(key_dream, policy)
        print(worlds.told(index, imagined, index * updates * config.envs * config.unroll), flush=True)
        if index == options.rounds:
            break
        env = gymnax_env.GymnaxImagination(dreams.core, dreams.core.params(imagined))
        if train is None:
            init, train = make_train(env, config, updates)
            learner = init(key_learn)
        learner, returns = train(learner, key_learn, env.default_params)
        print(f"return of an episode {returns[0]:.3f} to {returns[-1]:.3f}", flush=True)
    policy = jax.tree_util.Partial(functools.partial(mode, config), learner[0])
    print(dreams.judge(policy, options.drives), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run")
    parser.add_argument("--steps", type=int, help="50,000 without a run, else 600,000")
    parser.add_argument("--horizon", type=int, default=15, help="without a run")
    parser.add_argument("--rounds", type=int, default=4, help="of imagining and learning, with a run")
    parser.add_argument("--drives", type=int, default=16, help="that judge it, with a run")
    options = parser.parse_args()
    options.steps = options.steps or (600_000 if options.run else 50_000)
    if options.run:
        return learn_to_drive(options)
    config = PPOConfig()
    env = gymnax_env.GymnaxImagination(*worlds.load(None, options.horizon))
    updates = max(1, options.steps // (config.envs * config.unroll))
    init, train = make_train(env, config, updates)
    _, returns = train(init(jax.random.key(0)), jax.random.key(1), env.default_params)
    for index in sorted({round(share * (updates - 1)) for share in (0, 0.25, 0.5, 0.75, 1)}):
        print(f"{(index + 1) * config.envs * config.unroll:7d} steps: return of an episode {returns[index]:.3f}")


if __name__ == "__main__":
    main()
