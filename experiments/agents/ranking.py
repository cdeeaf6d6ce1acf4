"""Does imagination rank policies as the town does? Returns of 24 policies from the same moments, in both.

    python experiments/agents/ranking.py RUN [--agent=RUN/agent] [--seeds=8] [--out=experiments/agents/ranking.md]

The policies are the learned agent, the same with noise, with pedal or steering moved or scaled, constant actions and
random ones. The expert drives to the takeover; from there each policy drives in the town, and in imagination from what
the model has filtered by then. Returns are sums of the driving reward; in the town a collision is a fact, and progress
the simulator's.
"""

import argparse
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import muvo_jax
from muvo_jax import town_drive
from muvo_jax.agents import actor_critic, closed_loop, environment, futures, policy_file, real_rewards, rewards
from muvo_jax.town import settings, simulator

HORIZON, HORIZONS, FIRST_SEED = 12, (3, 6, 9, 12), 8_000


def warped(change, key, observation):
    """The agent's action, scaled, moved and made noisy: change {"gain", "offset": [2], "noise", "random"}."""
    wanted = change["policy"](key, observation)
    noise = jax.random.normal(jax.random.fold_in(key, 1), wanted.shape)
    uniform = jax.random.uniform(jax.random.fold_in(key, 2), wanted.shape, minval=-1.0)
    lead = (1,) * (wanted.ndim - 1) + (2,)
    action = wanted * change["gain"].reshape(lead) + change["offset"].reshape(lead) + change["noise"] * noise
    return jnp.clip(jnp.where(change["random"], uniform, action), -1.0, 1.0)


def policies(agent):
    """Name -> policy(key, observation); all are one function with other numbers."""
    def make(gain=(1.0, 1.0), offset=(0.0, 0.0), noise=0.0, random=False):
        change = {"policy": agent, "gain": jnp.array(gain), "offset": jnp.array(offset), "noise": jnp.float32(noise),
                  "random": jnp.bool_(random)}
        return jax.tree_util.Partial(warped, change)

    named = {"agent": make(), "random": make(random=True)}
    named |= {f"agent, noise {noise}": make(noise=noise) for noise in (0.1, 0.2, 0.3, 0.5, 0.8)}
    named |= {f"agent, pedal {move:+}": make(offset=(move, 0.0)) for move in (-0.6, -0.4, -0.2, 0.2, 0.4, 0.6)}
    named |= {f"agent, steering {move:+}": make(offset=(0.0, move)) for move in (-0.3, -0.15, 0.15, 0.3)}
    named |= {f"agent, steering x {gain}": make(gain=(1.0, gain)) for gain in (0.0, 0.5, 2.0)}
    named |= {f"always {pedal:+}, {wheel:+}": make(gain=(0.0, 0.0), offset=(pedal, wheel))
              for pedal, wheel in ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.2, 0.1))}
    return named


def cumulative(reward, ended):
    """Sums up to each step [.., H]; nothing is earned after the step that ended the drive."""
    alive = np.concatenate([np.ones_like(ended[..., :1]), ~np.logical_or.accumulate(ended, -1)[..., :-1]], -1)
    return np.cumsum(reward * alive, -1)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run")
    parser.add_argument("--agent")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--out", default=pathlib.Path(__file__).with_suffix(".md"), type=pathlib.Path)
    options = parser.parse_args()
    run = muvo_jax.load(options.run)
    stored = policy_file.load(options.agent or pathlib.Path(options.run) / policy_file.FOLDER, run)
    world = environment.Environment.of_run(run, observation="road", reward_config=rewards.RewardConfig(
        speed_limit_mps=8.0))
    town = town_drive.town_simulator(simulator.Town(settings.from_config(run.config)), run.config)
    agent = actor_critic.policy(stored.config, stored.actor, sampled=False)
    real, imagined, bank = {}, {}, None
    for name, policy in policies(agent).items():
        driver = closed_loop.policy_driver(town, world, run.variables, policy)
        drives = [closed_loop.drive(town, driver, jax.random.key(seed), seed, HORIZON, context=run.config.data.context)
                  for seed in range(FIRST_SEED, FIRST_SEED + options.seeds)]
        if bank is None:  # the takeovers are the same whoever drives on
            memories = [drive.moments[0].memory for drive in drives]
            stack = lambda *leaves: jnp.concatenate(leaves)
            latent, memory, speed_mps, route_map = jax.tree.map(stack, *[
                (held.live.latent, held.live.memory, held.speed_mps, held.route_map) for held in memories])
            bank = environment.StartBank(latent, speed_mps, route_map, memory, jnp.arange(options.seeds))
            params = world.params(run.variables, bank, HORIZON, temperature=0.0)
        earned = [real_rewards.town_rewards(world, drive) for drive in drives]
        real[name] = np.mean([np.cumsum(np.pad(one, (0, HORIZON - one.size))) for one in earned], axis=0)
        found = futures.imagine(world, params, jax.random.key(0), jnp.arange(options.seeds), policy, HORIZON)
        imagined[name] = cumulative(np.asarray(found.reward), np.asarray(found.terminated)).mean(axis=0)
        print(f"{name}: town {real[name][-1]:.2f}, imagined {imagined[name][-1]:.2f}", flush=True)
    options.out.write_text(page(real, imagined, options, world.step_s), encoding="utf-8")


def page(real, imagined, options, step_s):
    """The result as Markdown."""
    names = sorted(real, key=lambda name: -real[name][-1])
    lines = ["# Does imagination rank policies as the town does?", "",
             f"`python experiments/agents/ranking.py {options.run} --seeds={options.seeds}`: {len(names)} policies, "
             f"{options.seeds} takeovers each (seeds {FIRST_SEED} to {FIRST_SEED + options.seeds - 1}), {step_s:g} s a "
             f"step; bias is imagined minus town.", "",
             "| steps | Spearman | bias of the return | of a step |", "|---:|---:|---:|---:|"]
    for steps in HORIZONS:
        town, dream = (np.array([found[name][steps - 1] for name in names]) for found in (real, imagined))
        lines.append(f"| {steps} | {stats.spearmanr(town, dream).statistic:.2f} | {(dream - town).mean():+.2f} | "
                     f"{(dream - town).mean() / steps:+.3f} |")
    lines += ["", "| policy | town | imagined |", "|---|---:|---:|"]
    lines += [f"| {name} | {real[name][-1]:.2f} | {imagined[name][-1]:.2f} |" for name in names]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
