"""What a training step costs before it runs: compiled for shapes alone, without data and without weights.

Memory is that of XLA's own plan for the step. Arithmetic is counted in the traced program, loops as often as they run
(XLA's cost analysis counts the body of a loop once). Time follows from what this machine's matrix product reaches.
"""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.objectives import perceptual
from muvo_jax.training import preparation

GEMM_SIDE = 2048
_GEMM_ROUNDS = 5


@dataclasses.dataclass(frozen=True)
class StepCost:
    """Of one compiled step, on each of its devices.

    Attributes:
      devices: in words, as parallel.Plan.describe.
      parameters: how many numbers the model has.
      state_bytes: parameters, statistics and the optimiser's moments.
      batch_bytes: of the windows of one update.
      working_bytes: gradients and all that lives between the first and the last operation.
      operations: floating-point operations of products and convolutions.
      compilation_s: on the wall, tracing included.
    """

    devices: str
    parameters: int
    state_bytes: int
    batch_bytes: int
    working_bytes: int
    operations: float
    compilation_s: float

    @property
    def total_bytes(self) -> int:
        """Of the device's memory: the step reuses the memory of the state that goes in for the one that comes out."""
        return self.state_bytes + self.batch_bytes + self.working_bytes


def of_step(config: config_lib.Config, batch_shapes: types.Batch,
            frozen: perceptual.FrozenEncoder | None = None) -> StepCost:
    """Traces and compiles the training step that `preparation.prepare` would.

    Args:
      config: of the run.
      batch_shapes: from preparation.expected_batch.
      frozen: the network of the perceptual term, where that is on.

    Raises:
      ValueError: where the batch cannot be split over the devices, or train.trainable does not fit the model.
    """
    start_s = time.perf_counter()
    planned = preparation.plan(config, batch_shapes, frozen)
    jitted: Any = planned.step.compiled
    traced = jitted.trace(planned.state, planned.batch)
    memory = traced.lower().compile().memory_analysis()
    own = lambda tree: sum(leaf.dtype.itemsize * math.prod(leaf.sharding.shard_shape(leaf.shape))
                           for leaf in jax.tree.leaves(tree))
    return StepCost(planned.step.plan.describe(), sum(leaf.size for leaf in jax.tree.leaves(planned.state.params)),
                    own(planned.state), own(planned.batch),
                    memory.temp_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes,
                    operations(traced.jaxpr.jaxpr), time.perf_counter() - start_s)


def operations_of(planned: preparation.Planned) -> float:
    """Floating-point operations of a step's products and convolutions, traced but not compiled."""
    jitted: Any = planned.step.compiled
    return operations(jitted.trace(planned.state, planned.batch).jaxpr.jaxpr)


def operations(jaxpr: Any) -> float:
    """Floating-point operations of all products and convolutions in a jaxpr, on each device, loops counted as often as
    they run; of branches the dearest, of the platforms' forms of a convolution that of this platform."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            sides = equation.invars[0].aval.shape
            total += 2.0 * math.prod(equation.outvars[0].aval.shape) * math.prod(sides[axis] for axis in contracted)
        elif equation.primitive.name == "conv_general_dilated":
            kernel = equation.invars[1].aval.shape
            outputs = kernel[equation.params["dimension_numbers"].rhs_spec[0]]
            between = math.prod(equation.params["lhs_dilation"])  # of so many inputs all but one are zeros put between
            total += 2.0 * math.prod(equation.outvars[0].aval.shape) * math.prod(kernel) / outputs / between
        elif equation.primitive.name == "cond":
            total += max(operations(branch.jaxpr) for branch in _taken(equation.params))
        else:
            times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
            total += times * sum(operations(inner) for inner in core.jaxprs_in_params(equation.params))
    return total


def _taken(params: Any) -> list[Any]:
    """Branches of a `cond` that may be taken here: one, where they are forms for platforms."""
    branches, platforms = params["branches"], params.get("branches_platforms")
    if platforms is None:
        return list(branches)
    here = {"gpu": {"cuda", "rocm"}}.get(jax.default_backend(), {jax.default_backend()})
    return [branch for branch, names in zip(branches, platforms, strict=True)
            if names is None or here.intersection(names)][:1] or list(branches)


def product_rate(dtype: Any = jnp.float32) -> float:
    """Floating-point operations a second of a large matrix product on this machine.

    On a CPU a second of a processor's time, which other programs disturb little; elsewhere one on the wall.
    """
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    matrix = jnp.ones((GEMM_SIDE, GEMM_SIDE), dtype)
    product = jax.jit(lambda matrix: matrix @ matrix)
    product(matrix).block_until_ready()
    seconds = []
    for _ in range(_GEMM_ROUNDS):
        start_s = clock()
        product(matrix).block_until_ready()
        seconds.append(clock() - start_s)
    return 2.0 * GEMM_SIDE**3 / min(seconds)


def largest_batch(small: tuple[int, StepCost], large: tuple[int, StepCost], available_bytes: float) -> int:
    """How many windows a micro-batch may have, by the costs at two sizes: what a window adds is the same for each."""
    (few, less), (many, more) = small, large
    each = max(more.total_bytes - less.total_bytes, 1) / (many - few)
    return max(0, few + math.floor((available_bytes - less.total_bytes) / each))
