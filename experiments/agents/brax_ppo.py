"""Brax's own PPO, trained in imagination, through the brax door.

    python experiments/agents/brax_ppo.py [--run=RUN] [--steps=...]

With a run it learns to drive: in futures that its policy imagined from recorded moments (agents/futures.py), a few
times anew; then the town judges it. Without one it shows that brax runs through the door.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import worlds
from brax.training.agents.ppo import train as ppo

from muvo_jax.agents.doors import brax_env

# Brax 0.14 calls a function that JAX 0.10 no longer has.
if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)


def train(env, steps, seed=0, restore=None, **options):
    """Brax's PPO; its make_policy and params, and how many steps it took: whole rounds of batches, at least `steps`."""
    taken = []

    def tell(step, metrics):
        taken.append(step)
        print(f"{step:7d} steps: return of an episode {metrics['eval/episode_reward']:.3f} "
              f"(length {metrics['eval/avg_episode_length']:.1f})", flush=True)

    make_policy, params, _ = ppo.train(
        environment=env, num_timesteps=steps, episode_length=env.episode_length, num_minibatches=4,
        num_updates_per_batch=4, num_evals=3, num_eval_envs=64, learning_rate=1e-3, entropy_cost=1e-3, discounting=0.97,
        normalize_observations=True, seed=seed, restore_params=restore, progress_fn=tell, **options)
    return make_policy, params, taken[-1]


def learn_to_drive(options):
    """Rounds of imagining futures under the policy and learning in them; then the policy drives in the town."""
    dreams, restore, taken, policy = worlds.Dreams(options.run), None, 0, jax.tree_util.Partial(noisy_coasting)
    for index in range(options.rounds + 1):
        imagined = dreams.futures(jax.random.fold_in(jax.random.key(0), index), policy)
        print(worlds.told(index, imagined, taken), flush=True)
        if index < options.rounds:
            env = brax_env.BraxImagination(dreams.core, dreams.core.params(imagined))
            make_policy, restore, more = train(
                env, options.steps // options.rounds, seed=index, restore=restore, num_envs=512, batch_size=512,
                unroll_length=12, reward_scaling=0.1, num_resets_per_eval=10)
            taken += more
            policy = jax.tree_util.Partial(functools.partial(act, make_policy, False), restore)
    policy = jax.tree_util.Partial(functools.partial(act, make_policy, True), restore)
    print(dreams.judge(policy, options.drives), flush=True)


def noisy_coasting(key, observation):
    return jnp.tanh(0.5 * jax.random.normal(key, (2,)))


def act(make_policy, deterministic, learned, key, observation):
    """What jax.tree_util.Partial holds as arrays is the learned alone: brax's functions are no pytrees."""
    return jnp.clip(make_policy(learned, deterministic=deterministic)(observation, key)[0], -1.0, 1.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run")
    parser.add_argument("--steps", type=int, help="20,000 without a run, else 600,000")
    parser.add_argument("--horizon", type=int, default=15, help="without a run")
    parser.add_argument("--rounds", type=int, default=3, help="of imagining and learning, with a run")
    parser.add_argument("--drives", type=int, default=16, help="that judge it, with a run")
    options = parser.parse_args()
    options.steps = options.steps or (600_000 if options.run else 20_000)
    if options.run:
        return learn_to_drive(options)
    train(brax_env.BraxImagination(*worlds.load(None, options.horizon)), options.steps, num_envs=64, batch_size=64,
          unroll_length=5, reward_scaling=1.0)


if __name__ == "__main__":
    main()
