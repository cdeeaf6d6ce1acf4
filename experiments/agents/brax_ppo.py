"""Brax's own PPO, trained in imagination: python experiments/agents/brax_ppo.py [--run=runs/town-tr] [--steps=20000]"""

import argparse

import jax
import jax.numpy as jnp
import worlds
from brax.training.agents.ppo import train as ppo

from muvo_jax.agents.doors import brax_env

# Brax 0.14 calls a function that JAX 0.10 no longer has.
if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--horizon", type=int, default=15)
    options = parser.parse_args()
    env = brax_env.BraxImagination(*worlds.load(options.run, options.horizon))
    ppo.train(
        environment=env, num_timesteps=options.steps, episode_length=env.episode_length, num_envs=64, batch_size=64,
        num_minibatches=4, num_updates_per_batch=4, unroll_length=5, num_evals=3, num_eval_envs=64, learning_rate=1e-3,
        entropy_cost=1e-3, discounting=0.97, reward_scaling=1.0, normalize_observations=True, seed=0,
        progress_fn=lambda step, metrics: print(
            f"{step:7d} steps: return of an episode {metrics['eval/episode_reward']:.3f} "
            f"(length {metrics['eval/avg_episode_length']:.1f})", flush=True))


if __name__ == "__main__":
    main()
