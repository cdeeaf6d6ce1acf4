"""What a study costs at the paper's sizes, before anything starts: the arithmetic of one traced training step."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import tyro

from experiments.studies import queue, tables
from muvo_jax import config as config_lib
from muvo_jax import train
from muvo_jax.model import world_model
from muvo_jax.training import loop, optimizer, preparation, state, step

DEVICE_TFLOPS = 20  # sustained, for the hours: about a third of the float32 peak of one large accelerator


def told(study: tables.Study, planned: Sequence[queue.Job], folder: pathlib.Path, extra: Sequence[str]) -> list[str]:
    """Lines: runs, updates and windows; arithmetic of the first arm's update, times all of them."""
    options = tyro.cli(train.Options, args=queue.flags(study, "paper", planned[0], folder, extra))
    config, _, _ = train.configure(options)
    windows, steps = loop.windows_per_step(config), config.train.steps
    model = world_model.WorldModel(config.model)
    rule = optimizer.make_optimizer(config.optimizer, steps)
    shapes: Any = jax.eval_shape(
        lambda variables, key: state.create(variables, rule, key, config.train.trainable),
        model.variable_shapes(), jax.eval_shape(lambda: jax.random.key(0)))
    single = config_lib.override(config, "optimizer.accumulate", 1)  # what a loop repeats is counted once
    batch = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype),
                         preparation.expected_batch(single, single.train.batch))
    jitted: Any = step.make_train_step(model, single).compiled
    found = jitted.lower(shapes, batch).cost_analysis() or {}
    tera = config.optimizer.accumulate * found.get("flops", 0.0) / 1e12
    hours = tera * steps * len(planned) / DEVICE_TFLOPS / 3600.0
    return [f"{len(planned)} runs of {steps} updates, {windows} windows of {config.data.frames} frames an update: "
            f"{steps * len(planned) * windows / 1e6:.1f} million windows in all.",
            f"An update of {planned[0].label} is {tera:.1f} TFLOP: about {hours:.0f} hours in all of a device that "
            f"sustains {DEVICE_TFLOPS} TFLOP a second, evaluation and reading not counted."]
