"""What the heads reward and ego_motion know of imagined frames: python experiments/agents/learned_heads.py RUN

RUN was trained with --with-heads=reward,ego_motion (and continue). Of windows that validate the first frames are
observed, the others imagined under the recorded actions and compared with the recording.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import muvo_jax
from muvo_jax.ops import motion as motion_ops


def path(steps):
    """Poses [B, H, 3] that steps [B, H, 4] lead to."""
    motion = motion_ops.at_rest_of_frame(jnp.zeros(steps.shape[0]))
    poses = []
    for index in range(steps.shape[1]):
        motion = motion_ops.moved(motion, steps[:, index])
        poses.append(motion.pose)
    return np.stack(poses, axis=1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--windows", type=int, default=32)
    options = parser.parse_args()
    run = muvo_jax.load(options.run)
    context = run.config.data.context
    batch = muvo_jax.windows(run, count=options.windows)
    seen = batch.time_slice(0, context)
    observed = muvo_jax.observe(run.model, run.variables, jax.random.key(0), seen, sampled=False)
    dream = muvo_jax.imagine(run.model, run.variables, jax.random.key(0), observed.last,
                             batch.action[:, context - 1:-1], sampled=False)
    learned = muvo_jax.decode(run.model, run.variables, dream.states, heads=("reward", "ego_motion"))

    reward = batch.reward[:, context:]
    error = lambda value: np.abs(value - reward).mean()
    print(f"reward of {reward.size} imagined frames, mean absolute error: "
          f"head {error(learned.reward[..., 0]):.3f}, "
          f"the last observed reward {error(batch.reward[:, context - 1:context]):.3f}, "
          f"their mean {error(reward.mean()):.3f}")
    last, steps = batch.ego_motion[:, context - 1], batch.ego_motion[:, context:]
    paths = {"head": path(learned.ego_motion),
             "the last observed motion going on": path(np.repeat(last[:, None], steps.shape[1], axis=1))}
    if run.config.contract.kinematics == "bicycle":
        motion = motion_ops.at_rest_of_frame(jnp.asarray(last[:, 3]))
        paths["bicycle"] = motion_ops.path(motion, jnp.asarray(batch.action[:, context - 1:-1]), run.config.contract,
                                           run.config.data.stride).pose
    truth = path(steps)
    away = {name: np.linalg.norm(poses[:, -1, :2] - truth[:, -1, :2], axis=-1).mean() for name, poses in paths.items()}
    print(f"place after {steps.shape[1]} imagined steps ({np.linalg.norm(truth[:, -1, :2], axis=-1).mean():.1f} m on), "
          f"mean error in m: " + ", ".join(f"{name} {value:.2f}" for name, value in away.items()))


if __name__ == "__main__":
    main()
