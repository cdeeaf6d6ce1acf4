"""Everything that can be done before the first batch is there: initial state, training step, compilation.

The shapes of a batch follow from the config, so that the step is compiled while the data is still being made.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection
from typing import Any

import jax
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.model import world_model
from muvo_jax.objectives import perceptual
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib
from muvo_jax.training import trainable


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A run that only lacks data.

    Attributes:
      config: it was made for.
      model: what is trained.
      state: at step 0, placed on the devices.
      step: function(state, placed batch) -> (state, metrics), compiled for `batch_shapes`.
      batch_shapes: what it was compiled for.
      initialisation_s, compilation_s: how long these two took.
    """

    config: config_lib.Config
    model: world_model.WorldModel
    state: state_lib.TrainState
    step: step_lib.SpreadFunction
    batch_shapes: types.Batch
    initialisation_s: float
    compilation_s: float

    @property
    def parameters(self) -> int:
        """How many numbers the model has, frozen ones included."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.state.params))

    def with_variables(self, variables: types.Variables, config: config_lib.Config) -> state_lib.TrainState:
        """`state` with other variables of the same shapes and a fresh optimiser."""
        optimizer = optimizer_lib.of_config(config)
        state = state_lib.create(variables, optimizer, self.state.key, config.train.trainable)
        return parallel_lib.place_state(self.step.plan, state)


@dataclasses.dataclass(frozen=True)
class Planned:
    """A step and the shapes that it will be compiled for, with their places on the devices; nothing is computed.

    Attributes:
      step: its function is still to be compiled.
      state, batch: of jax.ShapeDtypeStruct.
    """

    step: step_lib.SpreadFunction
    state: state_lib.TrainState
    batch: types.Batch


TOWN_RECORDS = frozenset({"reward", "is_terminal", "speed_mps"})


def expected_batch(config: config_lib.Config, windows: int, *,
                   recorded: Collection[str] = TOWN_RECORDS) -> types.Batch:
    """The shapes of a batch of `windows` training windows, as jax.ShapeDtypeStruct leaves.

    Args:
      config: adapted to the data, or a preset of the built-in town.
      recorded: what every frame of the recording has (sequences.in_every_frame); by default what the built-in town has
        of those that every batch brings along, whatever the model reads.
    """
    model, prefix, targets = config.model, (windows, config.data.frames), head_lib.targets(config)

    def shape(dtype, *sizes) -> Any:
        return jax.ShapeDtypeStruct((windows, *sizes), dtype)

    def timed(dtype, *shape) -> Any:
        return jax.ShapeDtypeStruct((*prefix, *shape), dtype)

    fields = {name: timed(types.BATCH_FIELDS[name][0], *sizes) for name, sizes in world_model.inputs(model).items()}
    if model.lidar is not None:
        fields["range_view"] = timed(np.float32, model.range_view.rows, model.range_view.columns, 4)
    if model.camera is not None or "image" in targets:
        fields |= {"intrinsics": shape(np.float32, 3, 3), "camera_to_ego": shape(np.float32, 4, 4)}
    fields |= {name: timed(types.BATCH_FIELDS[name][0], *sizes) for name, sizes in targets.items()}
    fields |= {name: timed(types.BATCH_FIELDS[name][0]) for name in sorted(TOWN_RECORDS.intersection(recorded))}
    fields["action"] = timed(np.float32, 2)
    return types.Batch(is_first=timed(np.bool_), **fields)


def check_trainable(config: config_lib.Config) -> None:
    """Raises ValueError where train.trainable does not fit the model, before anything takes long."""
    if config.train.trainable != trainable.EVERYTHING:
        params = world_model.WorldModel(config.model).variable_shapes()["params"]
        trainable.chosen(params, config.train.trainable)


def plan(config: config_lib.Config, batch_shapes: types.Batch,
         frozen: perceptual.FrozenEncoder | None = None) -> Planned:
    """What `prepare` compiles, without weights; arguments and errors as there."""
    model = world_model.WorldModel(config.model)
    step = step_lib.make_train_step(model, config, frozen=frozen)
    optimizer = optimizer_lib.of_config(config)
    fresh = lambda variables: state_lib.create(variables, optimizer, jax.random.key(0), config.train.trainable)
    state = jax.eval_shape(fresh, model.variable_shapes())
    return Planned(step, parallel_lib.placed_state_shapes(step.plan, state),
                   parallel_lib.placed_batch_shapes(step.plan, batch_shapes, config.optimizer.accumulate))


def prepare(config: config_lib.Config, batch_shapes: types.Batch,
            frozen: perceptual.FrozenEncoder | None = None) -> Prepared:
    """Initialises the model and compiles its training step.

    Args:
      config: of the run.
      batch_shapes: [train.batch * optimizer.accumulate, frames, ...]; of several processes the part that each reads.
      frozen: the network of the perceptual term, where that is on.

    Raises:
      ValueError: where the batch cannot be split over the devices, or train.trainable does not fit the model.
    """
    start_s = time.perf_counter()
    model = world_model.WorldModel(config.model)
    step = step_lib.make_train_step(model, config, frozen=frozen)
    run_key = jax.random.key(config.train.seed)
    example = jax.tree.map(lambda leaf: np.zeros((1, *leaf.shape[1:]), leaf.dtype), batch_shapes)
    variables = model.init(jax.random.fold_in(run_key, 0), example)
    optimizer = optimizer_lib.of_config(config)
    state = state_lib.create(variables, optimizer, jax.random.fold_in(run_key, 1), config.train.trainable)
    state = jax.block_until_ready(parallel_lib.place_state(step.plan, state))
    initialised_s = time.perf_counter()
    jitted: Any = step.compiled
    placed = parallel_lib.placed_batch_shapes(step.plan, batch_shapes, config.optimizer.accumulate)
    compiled = jitted.lower(state, placed).compile()
    return Prepared(config, model, state, dataclasses.replace(step, compiled=compiled), batch_shapes,
                    initialised_s - start_s, time.perf_counter() - initialised_s)


def recompile(prepared: Prepared, config: config_lib.Config, batch_shapes: types.Batch,
              frozen: perceptual.FrozenEncoder | None = None) -> Prepared:
    """`prepared` where it already fits, else a new one for what the data turned out to be."""
    on_this_data = dataclasses.replace(prepared.config, data=config.data, evaluation=config.evaluation)
    same = (prepared.batch_shapes == batch_shapes and on_this_data == config
            and prepared.config.data.route_map == config.data.route_map)  # which a mirrored window turns
    return prepared if same else prepare(config, batch_shapes, frozen)
