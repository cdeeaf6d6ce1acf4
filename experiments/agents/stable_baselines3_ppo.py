"""Stable-baselines3's PPO, trained in imagination through the Gymnasium door.

    pip install -r experiments/agents/requirements-sb3.txt -e '.[gymnasium]'     (brings torch; a venv of its own)
    python experiments/agents/stable_baselines3_ppo.py [--run=runs/town-tr] [--steps=8192]

Its own checker looks at the environment first.
"""

import argparse

import worlds
from stable_baselines3 import PPO
from stable_baselines3.common import env_checker, evaluation, monitor

from muvo_jax.agents.doors import gymnasium_env


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run")
    parser.add_argument("--steps", type=int, default=8192)
    parser.add_argument("--horizon", type=int, default=15)
    options = parser.parse_args()
    env = gymnasium_env.GymnasiumImagination(*worlds.load(options.run, options.horizon), render_mode="rgb_array")
    env_checker.check_env(env, skip_render_check=False)
    print("check_env: passed", flush=True)
    env = monitor.Monitor(env)
    agent = PPO("MlpPolicy", env, n_steps=512, batch_size=64, gamma=0.97, learning_rate=1e-3, seed=0, device="cpu")
    evaluate = lambda: evaluation.evaluate_policy(agent, env, n_eval_episodes=50)[0]
    before = evaluate()
    agent.learn(options.steps)
    print(f"return of an episode {before:.3f} before, {evaluate():.3f} after {options.steps} steps")


if __name__ == "__main__":
    main()
