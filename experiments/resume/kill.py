"""Kills a training at random moments, goes on each time, and compares all that it logged with one that was left alone.

    python experiments/resume/kill.py [--kills=20] [--steps=60] [--seed=0] [--out=FOLDER] [FLAGS OF TRAIN]

A third of the moments lie before the first step after a start (imports, compilation, restoring), the others up to half
a second after a random step (steps, validation, saving). Every number but those of the clock must be equal bit for bit,
the parameters at the end too. Exit code 1 where one is not.
"""

from __future__ import annotations

import argparse
import pathlib
import random
import subprocess
import sys
import tempfile
import time

import jax
import numpy as np

from muvo_jax.training import checkpoint, run_folder

OFTEN = ("train.log_every=1", "train.checkpoint_every=3", "train.validate_every=8", "train.preview_every=0")


def start(out: pathlib.Path, name: str, flags: list[str]) -> subprocess.Popen:
    command = [sys.executable, "-m", "muvo_jax.train", f"--runs-dir={out}", f"--name={name}", "--no-evaluate", *flags]
    with (out / f"{name}.log").open("a") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def last_step(folder: pathlib.Path) -> int:
    return max((record["step"] for record in run_folder.read_metrics(folder) if record["kind"] == "train"), default=0)


def kill_at(process: subprocess.Popen, folder: pathlib.Path, step: int | None, delay_s: float) -> bool:
    """Kills once the run has logged a step (None: at once) and some time has passed; False where it ended before."""
    while step is not None and process.poll() is None and last_step(folder) < step:
        time.sleep(0.02)
    try:
        process.wait(delay_s)
        return False
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=pathlib.Path)
    options, flags = parser.parse_known_args()
    out = options.out or pathlib.Path(tempfile.mkdtemp(prefix="resume-"))
    out.mkdir(parents=True, exist_ok=True)
    flags = flags or ["--preset=tiny"]
    new = [*flags, f"--steps={options.steps}", "--set", *OFTEN]
    alone, killed, draw = out / "alone", out / "killed", random.Random(options.seed)

    if start(out, "alone", new).wait():
        raise SystemExit(f"the training that was to be left alone failed: {out}/alone.log")
    print(f"alone: {options.steps} steps", flush=True)
    kills, start_s, process = 0, 5.0, start(out, "killed", new)
    while kills < options.kills:
        before, begun_s = last_step(killed), time.perf_counter()
        ahead = max(2, 2 * (options.steps - before) // (options.kills - kills))
        step, delay_s = ((None, draw.uniform(0.0, start_s)) if draw.random() < 1 / 3 else
                         (before + draw.randint(1, ahead), draw.uniform(0.0, 0.5)))
        if not kill_at(process, killed, step, delay_s):
            break
        kills += 1
        if step is not None:
            start_s = 0.5 * start_s + 0.5 * (time.perf_counter() - begun_s)
        print(f"kill {kills}: {'while starting' if step is None else f'after step {last_step(killed)}'}", flush=True)
        made = (killed / run_folder.CONFIG_FILE).exists()
        process = start(out, "killed", ["--resume"] if made else new)
    if process.wait():
        raise SystemExit(f"the killed training did not go on: {out}/killed.log")

    ours, theirs = run_folder.reproducible_metrics(killed), run_folder.reproducible_metrics(alone)
    wrong = [index for index, (one, other) in enumerate(zip(ours, theirs, strict=False)) if one != other]
    final = [jax.tree.leaves(checkpoint.load_run(folder).variables) for folder in (killed, alone)]
    same = all(np.array_equal(one, other) for one, other in zip(*final, strict=True))
    print(f"{kills} kills; {len(ours)} records against {len(theirs)}, {len(wrong)} of them different; parameters "
          f"{'equal' if same else 'different'}")
    return int(len(ours) != len(theirs) or bool(wrong) or not same)


if __name__ == "__main__":
    sys.exit(main())
