"""What a study costs at the paper's sizes, before anything starts: the arithmetic of one traced training step."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

import tyro

from experiments.studies import queue, tables
from muvo_jax import train
from muvo_jax.training import cost, loop, preparation

DEVICE_TFLOPS = 20  # sustained, for the hours: about a third of the float32 peak of one large accelerator


def told(study: tables.Study, planned: Sequence[queue.Job], folder: pathlib.Path, extra: Sequence[str]) -> list[str]:
    """Lines: runs, updates and windows; arithmetic of the first arm's update, times all of them."""
    options = tyro.cli(train.Options, args=queue.flags(study, "paper", planned[0], folder, extra))
    config, _, _ = train.configure(options)
    windows, steps = loop.windows_per_step(config), config.train.steps
    tera = cost.operations_of(preparation.plan(config, preparation.expected_batch(config, windows))) / 1e12
    hours = tera * steps * len(planned) / DEVICE_TFLOPS / 3600.0
    return [f"{len(planned)} runs of {steps} updates, {windows} windows of {config.data.frames} frames an update: "
            f"{steps * len(planned) * windows / 1e6:.1f} million windows in all.",
            f"An update of {planned[0].label} is {tera:.1f} TFLOP: about {hours:.0f} hours in all of a device that "
            f"sustains {DEVICE_TFLOPS} TFLOP a second, evaluation and reading not counted."]
