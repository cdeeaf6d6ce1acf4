"""The same training in one process and spread over several over loopback: how far apart their losses are.

    python experiments/hosts/compare.py [--hosts=1,2,4] [--devices=4] [--steps=20] [--latent=2d] [--out=FOLDER]

What is trained is all that the town preset ships (2D latent or 1D, geometric memory, restarts, some frames decoded,
mirror and light) at the tiny preset's sizes, with dropout and prior dropout beside it, in micro-batches of four
windows, two an update, on the smallest town. All have as many virtual CPU devices together. The exit code is 1 where a
number of metrics.jsonl is further from that of the first than --tolerance, relatively.
"""

from __future__ import annotations

import argparse
import math
import os
import pathlib
import socket
import subprocess
import sys
import tempfile

from muvo_jax.training import run_folder

SIZES = ("model.image_size=[32,64]", "model.range_view.rows=32", "model.range_view.columns=64",
         "model.voxels.shape=[16,16,16]", "model.voxels.voxel_size_m=2.0", "model.voxels.origin_m=[-16.0,-16.0,-3.0]",
         "model.backbone_width=4", "model.decoder_channels=8", "model.occupancy_channels=8",
         "model.fusion.token_channels=12", "model.fusion.layers=1", "model.fusion.heads=2",
         "model.fusion.hidden_channels=16", "model.first_guess.guided_channels=[8,8,8]", "data.town_size=tiny",
         "data.stride=1", "data.frames=8", "data.context=4", "data.horizon=4", "train.observe_frames=4",
         "model.first_guess.memory_frames=4", "loss.chamfer_points=64")
RANDOM = ("model.fusion.dropout=0.2", "model.prior_dropout=0.3")
OFTEN = ("train.log_every=1", "train.validate_every=10", "train.checkpoint_every=10", "train.preview_every=0",
         "train.validation_windows=4", "evaluation.batch=2")


def train(out: pathlib.Path, hosts: int, options: argparse.Namespace) -> list[dict]:
    """What a training over that many processes logs; one that --out holds already is not repeated."""
    folder = out / f"hosts-{hosts}"
    if (folder / "checkpoints" / str(options.steps)).exists():
        return run_folder.reproducible_metrics(folder)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    flags = [f"--name=hosts-{hosts}", f"--runs-dir={out}", "--preset=town", f"--latent={options.latent}", "--batch=4",
             "--accumulate=2", f"--steps={options.steps}", "--no-evaluate", "--set", *SIZES, *RANDOM, *OFTEN]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu",
                   "XLA_FLAGS": f"--xla_force_host_platform_device_count={options.devices // hosts}"}
    running = []
    for host in range(hosts):
        who = [f"--hosts={hosts}", f"--host={host}", f"--coordinator=localhost:{port}"] if hosts > 1 else []
        with (out / f"hosts-{hosts}-{host}.log").open("w") as log:
            running.append(subprocess.Popen([sys.executable, "-m", "muvo_jax.train", *flags, *who], env=environment,
                                            stdout=log, stderr=subprocess.STDOUT))
    codes = [process.wait() for process in running]
    if any(codes):
        raise SystemExit(f"{hosts} hosts ended with {codes}: {out}/hosts-{hosts}-*.log")
    return run_folder.reproducible_metrics(folder)


def furthest(ours: list[dict], theirs: list[dict]) -> tuple[float, str]:
    """The largest relative distance of a number, and which one it is."""
    if [(one["kind"], one["step"]) for one in ours] != [(one["kind"], one["step"]) for one in theirs]:
        return math.inf, "other records"
    apart = [(abs(one[name] - value) / max(abs(value), 1e-6), f"{name} of {one['kind']} {one['step']}")
             for one, other in zip(ours, theirs, strict=True) for name, value in other.items()
             if isinstance(value, float)]
    return max(apart)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hosts", default="1,2,4")
    parser.add_argument("--devices", type=int, default=4)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--latent", default="2d")
    parser.add_argument("--tolerance", type=float, default=1e-3)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    out = options.out or pathlib.Path(tempfile.mkdtemp(prefix="hosts-"))
    out.mkdir(parents=True, exist_ok=True)
    counts = [int(count) for count in options.hosts.split(",")]
    first, worst = train(out, counts[0], options), 0.0
    for count in counts[1:]:
        records = train(out, count, options)
        distance, name = furthest(records, first)
        loss, which = furthest(*([{"kind": one["kind"], "step": one["step"], "total": one["total"]} for one in some]
                                 for some in (records, first)))
        print(f"{count} hosts against {counts[0]}, {options.latent}, {len(records)} records: losses {loss:.1e} apart "
              f"({which}), of all numbers {name} the most: {distance:.1e}", flush=True)
        worst = max(worst, distance)
    return int(not worst <= options.tolerance)


if __name__ == "__main__":
    sys.exit(main())
