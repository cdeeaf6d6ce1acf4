"""python -m muvo_jax.estimate: what a training would cost in memory, arithmetic and time, without data or weights."""

from __future__ import annotations

import dataclasses
import math
import os
import sys
from typing import Annotated

from muvo_jax import command_line, late, train

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax.town import settings as town
    from muvo_jax.training import cost, host, loop, preparation, screen

GIB = 2**30
_SHARE = 0.5  # of the speed of a matrix product that steps of the presets reach on a CPU (docs/performance.md)
_BATCHES_AHEAD = 8  # read (pipeline.train_batches), on their way to the device, and in use
_REMATS = ("none", "heads", "frames")  # from fast to small


@dataclasses.dataclass(frozen=True)
class Options(train.Options):
    """Says what a training would need: memory, arithmetic and time of a step, by compiling it for shapes alone.

    Takes the flags of muvo_jax.train, so that its command line can be copied, but for those of several hosts. No data
    is opened: sizes are those of the preset and its flags. What is compiled here need not be compiled again by a
    training with the same flags.
    """

    memory_gib: Annotated[float | None, command_line.shown("GIB", "only say what is needed")] = None
    """Of one device (of the machine, where that is a CPU): suggests batch, remat and accumulation that fit."""
    share: Annotated[float, command_line.shown("SHARE", str(_SHARE))] = _SHARE
    """Of the speed of a matrix product that the step is expected to reach."""


_EXAMPLES = """
python -m muvo_jax.estimate
python -m muvo_jax.estimate --preset=paper-occupancy --accumulate=1
python -m muvo_jax.estimate --preset=paper-occupancy --latent=2d --memory-gib=24
python -m muvo_jax.estimate --preset=paper-occupancy --accumulate=1 --set train.remat=none
"""


def estimate(options: Options, show: screen.Screen) -> None:
    """Compiles the step and says what it needs; with --memory-gib, looks for settings that fit.

    Raises:
      ValueError: for flags that it cannot follow, before anything is compiled; where nothing fits.
    """
    if not 0 < options.share <= 1:
        raise ValueError(f"--share is {options.share:g}; expected a share of the speed of a matrix product, above 0 "
                         f"and at most 1.")
    hosts = [f"--{flag}={value}" for flag in ("hosts", "host", "coordinator")
             if (value := getattr(options, flag)) is not None]
    if hosts:
        raise ValueError(f"{' '.join(hosts)}: what one process needs is estimated, without the others. Leave these "
                         f"flags out and give this process's share of the windows with --batch: that of all, divided "
                         f"by the number of processes.")
    config, chosen, _ = train.configure(options)
    preparation.check_trainable(config)
    rate = cost.product_rate(config.model.compute_dtype)
    show.field("model", f"{config.model.variant} ({config.model.latent.kind}), heads {', '.join(config.model.heads)}")
    step = of_config(config)
    process_bytes = of_process(config)
    show.field("step", _words(config))
    show.field("compiled", f"in {step.compilation_s:.1f} s, for {step.devices}")
    _say(show, step, process_bytes)
    _say_time(show, step, rate, options.share)
    if options.memory_gib is None:
        return
    found = suggest(config, options.memory_gib * GIB - process_bytes, fixed="train.remat" in chosen)
    if found is None:
        raise ValueError(f"--memory-gib={options.memory_gib:g}: not even one window at a time fits. Try shorter "
                         f"windows (--frames), fewer heads or a smaller model; leave train.remat open where it is set.")
    show.field("fits", f"{options.memory_gib:g} GiB: {_flags(config, found)}")
    if found != config:
        again = of_config(found)
        show.field("step", _words(found))
        _say(show, again, process_bytes)
        _say_time(show, again, rate, options.share)


def of_config(config: config_lib.Config) -> cost.StepCost:
    """The cost of the step of a config, as if its data had the sizes of the config."""
    return cost.of_step(config, _shapes(config), train.frozen_encoder(config))


def of_process(config: config_lib.Config) -> float:
    """What a training process needs beside the step where the device is a CPU, bytes; call it after compiling.

    Libraries and the compiler, as this process has used them, the frames that are kept, and batches on their way. 0
    elsewhere: then it is not the device's memory.
    """
    if jax.default_backend() != "cpu":
        return 0.0
    shapes = _shapes(config)
    batch = sum(leaf.dtype.itemsize * math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    kept = config.data.cache_gib * GIB
    if config.data.path == "town":
        frames = sum(split.runs * split.frames for split in town.SIZES[config.data.town_size].values())
        kept = min(kept, batch / (shapes.batch_size * shapes.frames) * frames)
    return host.peak_memory_gib() * GIB + kept + _BATCHES_AHEAD * batch


def suggest(config: config_lib.Config, available_bytes: float, *, fixed: bool) -> config_lib.Config | None:
    """The config with a batch, accumulation and remat that fit, for the same windows an update; None where none does.

    Of the policies of train.remat that fit the first is taken, which computes least twice.

    Args:
      available_bytes: of each device, for the step.
      fixed: whether train.remat stays as it is.
    """
    windows = loop.windows_per_step(config)
    divisors = [size for size in range(1, windows + 1) if windows % size == 0]
    sizes = [size for size in divisors if size % jax.device_count() == 0] or divisors
    for remat in [config.train.remat] if fixed else _REMATS:
        sized = lambda batch, remat=remat: config_lib.override_all(config, {
            "train.remat": remat, "train.batch": batch, "optimizer.accumulate": windows // batch})
        least = of_config(sized(sizes[0]))
        if least.total_bytes > available_bytes:
            continue
        most = sizes[0] if len(sizes) == 1 else cost.largest_batch(
            (sizes[0], least), (sizes[1], of_config(sized(sizes[1]))), available_bytes)
        found = [size for size in sizes if size <= max(most, sizes[0])]
        # Of windows that the devices cannot share evenly, what one more costs is not the same for each.
        while found[-1] > sizes[0] and found[-1] % jax.device_count() and (
                of_config(sized(found[-1])).total_bytes > available_bytes):
            found.pop()
        return sized(found[-1])
    return None


def _shapes(config: config_lib.Config):
    return preparation.expected_batch(config, loop.windows_per_step(config))


def _words(config: config_lib.Config) -> str:
    train_, accumulate = config.train, config.optimizer.accumulate
    return (f"{train_.batch * accumulate} windows of {config.data.frames} frames an update, {train_.batch} at a time "
            f"(--batch={train_.batch} --accumulate={accumulate}), train.remat={train_.remat}")


def _flags(config: config_lib.Config, found: config_lib.Config) -> str:
    if found == config:
        return "as it is"
    return (f"--batch={found.train.batch} --accumulate={found.optimizer.accumulate} "
            f"--set train.remat={found.train.remat}")


def _say(show: screen.Screen, step: cost.StepCost, process_bytes: float) -> None:
    show.field("parameters", f"{step.parameters:,}")
    parts = (f"{step.state_bytes / GIB:.2f} parameters, statistics and moments, {step.batch_bytes / GIB:.2f} windows, "
             f"{step.working_bytes / GIB:.2f} while it runs")
    if process_bytes:
        parts += f", {process_bytes / GIB:.2f} the process beside it (libraries, kept frames, batches ahead)"
    show.field("memory", f"{(step.total_bytes + process_bytes) / GIB:.2f} GiB: {parts}")


def _say_time(show: screen.Screen, step: cost.StepCost, rate: float, share: float) -> None:
    show.field("arithmetic", f"{step.operations / 1e9:,.0f} GFLOP a step of products and convolutions, on each device")
    seconds = step.operations / (share * rate)
    clock = "processor seconds" if jax.default_backend() == "cpu" else "s"
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wall = f", {seconds / processors:.2f} s on {processors} idle cores" if jax.default_backend() == "cpu" else ""
    show.field("time", f"{seconds:.2f} {clock} a step{wall}, at {share:.0%} of the {rate / 1e9:,.0f} GFLOP a second of "
                       f"a product of {cost.GEMM_SIDE}x{cost.GEMM_SIDE} here")


def main() -> int:
    return command_line.run(Options, estimate, program="estimate", examples=_EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
