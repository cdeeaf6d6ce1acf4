"""One training step on one device or on many: the batch split over the devices, the state whole on each or shared out.

`pmap` and `shard_map` run the same body on the same state; `jax.pmap` gets the state by in_axes=None, so that it has no
device axis and a checkpoint does not know how many devices wrote it. The body is written per device: it sums over
`AXIS` before every ratio and averages gradients with `pmean`. That is right for pmap, and for shard_map with
check_vma=False, where the transpose of a sum over devices is again a sum; with check_vma=True the same code would scale
the gradients wrongly (Adam hides such a factor, so the tests compare raw gradients). The update follows the body, on
whole arrays: XLA spreads it as their shardings say.

With `share_state` each device keeps a share of every large array of the state, of parameters and of the optimiser's
moments alike (as in ZeRO and FSDP): a step gathers the parameters, and each device gets the mean of its share of the
gradients alone.

Several processes (jax.distributed) share a step through shard_map: each places the windows that it read itself, and
all of them call the step together.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from muvo_jax import types

AXIS = "data"
MODES = ("auto", "pmap", "shard_map")
LEAST_SHARED = 2**12  # numbers of an array that devices share: gathering a smaller one costs more than it frees
Body = Callable[[Any, types.Batch, str | None], Any]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which devices share a batch, and how.

    Attributes:
      mode: "single", "pmap" or "shard_map".
      devices: those that take part.
      share_state: whether each device keeps a share of the state; by shard_map alone.
    """

    mode: str
    devices: tuple[jax.Device, ...]
    share_state: bool = False

    @property
    def processes(self) -> int:
        """How many processes own these devices."""
        return len({device.process_index for device in self.devices})

    @property
    def mesh(self) -> Mesh:
        return Mesh(np.asarray(self.devices), (AXIS,), axis_types=(AxisType.Auto,))

    def describe(self) -> str:
        """Such as "shard_map over 8 cpu devices"."""
        if self.mode == "single":
            return f"one {self.devices[0].platform} device"
        hosts = f" of {self.processes} hosts" if self.processes > 1 else ""
        shared = ", which share the state" if self.share_state else ""
        return f"{self.mode} over {len(self.devices)} {self.devices[0].platform} devices{hosts}{shared}"

    @property
    def batch_sharding(self) -> NamedSharding:
        """Of what `place_batch` returns: micro-batch after micro-batch, each spread over the devices."""
        return NamedSharding(self.mesh, PartitionSpec(None, AXIS))

    def state_specs(self, state: Any) -> Any:
        """How each array of a state, or of a part of it, lies on the mesh: a tree of PartitionSpec."""
        def spec(leaf) -> PartitionSpec:
            axis = shared_axis(leaf.shape, len(self.devices)) if self.share_state else None
            return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)

        return jax.tree.map(spec, state)

    def state_shardings(self, state: Any) -> Any:
        """`state_specs` on this plan's mesh."""
        mesh = self.mesh
        if not self.share_state:
            whole = NamedSharding(mesh, PartitionSpec())
            return jax.tree.map(lambda _: whole, state)
        return jax.tree.map(lambda spec: NamedSharding(mesh, spec), self.state_specs(state))


def shared_axis(shape: Sequence[int], devices: int) -> int | None:
    """The longest axis that so many devices can share evenly; None where there is none, or where it is not worth it."""
    if math.prod(shape) < LEAST_SHARED:
        return None
    return max((axis for axis, size in enumerate(shape) if size % devices == 0), key=lambda axis: shape[axis],
               default=None)


def mean_gradients(gradients: Any, axis_name: str | None, share_state: bool) -> Any:
    """The mean over the devices of an axis; with `share_state` each device gets its share of it (Plan.state_specs)."""
    if axis_name is None:
        return gradients
    if not share_state:
        return jax.lax.pmean(gradients, axis_name)
    devices = jax.lax.axis_size(axis_name)

    def mean(leaf):
        axis = shared_axis(leaf.shape, devices)
        if axis is None:
            return jax.lax.pmean(leaf, axis_name)
        return jax.lax.psum_scatter(leaf, axis_name, scatter_dimension=axis, tiled=True) / devices

    return jax.tree.map(mean, gradients)


def make_plan(parallel: str, batch_size: int, devices: Sequence[jax.Device] | None = None, *,
              share_state: bool = False) -> Plan:
    """Chooses devices for micro-batches of `batch_size` windows.

    "auto" takes shard_map over as many devices as divide the batch, and no wrapper where that is one. "pmap" and
    "shard_map" take all devices, and so does "auto" where they belong to several processes.

    Raises:
      ValueError: for an unknown mode, or where all devices have to share the batch and cannot split it evenly; for pmap
        with several processes or with `share_state`.
    """
    devices = tuple(jax.devices() if devices is None else devices)
    if parallel not in MODES:
        raise ValueError(f"parallel: got {parallel!r}, expected one of {', '.join(MODES)}.")
    if share_state and parallel == "pmap":
        raise ValueError("train.share_state needs parallel=shard_map or auto: under pmap every device holds the state "
                         "whole.")
    if len({device.process_index for device in devices}) > 1:
        if parallel == "pmap":
            raise ValueError("parallel=pmap works within one process; use parallel=shard_map (or auto) with several "
                             "hosts.")
        parallel = "shard_map"
    if parallel == "auto":
        count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
        return Plan("single", devices[:1]) if count == 1 else Plan("shard_map", devices[:count], share_state)
    if batch_size % len(devices):
        raise ValueError(f"parallel={parallel}: {batch_size} windows cannot be split over {len(devices)} devices. "
                         f"Set train.batch to a multiple of {len(devices)}, or, within one process, use "
                         f"parallel=auto.")
    return Plan(parallel, devices, share_state)


def place_state(plan: Plan, state: Any) -> Any:
    """The state on the devices of the plan, whole or shared out (the same arrays where they are there already).

    Several processes must all pass the same numbers.
    """
    shardings = plan.state_shardings(state)
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(shardings), strict=True)
    if all(isinstance(leaf, jax.Array) and leaf.sharding == sharding for leaf, sharding in pairs):
        return state  # device_put looks at the leaves one by one, in every step
    if plan.processes == 1:
        return jax.device_put(state, shardings)
    return jax.tree.map(_on_all_processes, state, shardings)


def _on_all_processes(leaf: types.ArrayLike, sharding: NamedSharding) -> jax.Array:
    if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:  # it is there
        return leaf
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _on_all_processes(jax.random.key_data(leaf), sharding)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    whole = np.asarray(leaf)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def on_device(state: Any, device: jax.Device) -> Any:
    """The state, or a part of it, on one device of this process. Where several processes share it they all call this.
    """
    def own(leaf):
        if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable:
            return leaf
        return (leaf if leaf.is_fully_replicated else _gathered(leaf)).addressable_data(0)

    return jax.device_put(jax.tree.map(own, state), device)


def _gathered(leaf: jax.Array) -> jax.Array:
    whole = NamedSharding(leaf.sharding.mesh, PartitionSpec())  # type: ignore[attr-defined]
    return jax.jit(lambda shares: shares, out_shardings=whole)(leaf)


def place_batch(plan: Plan, batch: types.Batch, accumulate: int) -> types.Batch:
    """Splits a batch into micro-batches and spreads each of them over the devices.

    Args:
      plan: where to.
      batch: leaves [accumulate * B, ...]; windows m * B to (m + 1) * B - 1 are micro-batch m. With several processes
        the part of each micro-batch that this process read (data.pipeline.TrainBatches), B / processes windows.
      accumulate: how many micro-batches.

    Returns:
      Leaves [accumulate, B, ...]; under pmap [accumulate, devices, B / devices, ...].

    Raises:
      ValueError: where the windows cannot be split evenly.
    """
    leading = _split(plan, batch.batch_size, accumulate)
    split = jax.tree.map(lambda leaf: leaf.reshape(*leading, *leaf.shape[1:]), batch)
    if plan.processes == 1:
        return jax.device_put(split, plan.batch_sharding)
    upload = functools.partial(jax.make_array_from_process_local_data, plan.batch_sharding)
    return jax.tree.map(lambda leaf: upload(np.asarray(leaf)), split)


def placed_state_shapes(plan: Plan, state: Any) -> Any:
    """What `place_state` returns of a state of these shapes, as jax.ShapeDtypeStruct leaves."""
    return jax.tree.map(lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), state,
                        plan.state_shardings(state))


def placed_batch_shapes(plan: Plan, batch: types.Batch, accumulate: int) -> types.Batch:
    """What `place_batch` returns of a batch of these shapes, as jax.ShapeDtypeStruct leaves; arguments as there."""
    leading, sharding = _split(plan, batch.batch_size, accumulate), plan.batch_sharding
    leading = (leading[0], leading[1] * plan.processes, *leading[2:])  # each process has its share of a micro-batch
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape[1:]), leaf.dtype, sharding=sharding),
                        batch)


def _split(plan: Plan, windows: int, accumulate: int) -> tuple[int, ...]:
    devices = len(plan.devices) // plan.processes
    if windows % (accumulate * devices):
        raise ValueError(f"a batch of {windows} windows cannot be split into {accumulate} micro-batches over {devices} "
                         f"devices; expected a multiple of {accumulate * devices}.")
    each = windows // accumulate
    return (accumulate, devices, each // devices) if plan.mode == "pmap" else (accumulate, each)


def spread(plan: Plan, body: Body, *, then: Callable[[Any, Any], Any] | None = None,
           shared: Callable[[Any], Any] | None = None, donate_state: bool = False) -> Callable[[Any, types.Batch], Any]:
    """Compiles `body(state, batch, axis_name)` for the plan, and what follows it.

    Args:
      plan: where it runs.
      body: computes for the local part of a batch, leaves [accumulate, b, ...]; what it returns must be equal on all
        devices (summed or averaged over `axis_name`, which is None on a single device), `shared` aside.
      then: function(state, what the body returned) -> (state, more), on whole arrays; None returns what the body does.
      shared: function(state) -> a tree with the shapes of the first thing that the body returns, of which each device
        has its share where the plan shares the state (`mean_gradients`).
      donate_state: whether the buffers of the state may be reused.

    Returns:
      function(placed state, placed batch) -> what `then` returns, the state placed as before, all else replicated.
    """
    donated = (0,) if donate_state else ()
    follow = then or (lambda state, result: result)
    if plan.mode == "single":
        return jax.jit(lambda state, batch: follow(state, body(state, batch, None)), donate_argnums=donated)
    on_axis = lambda state, batch: body(state, batch, AXIS)
    if plan.mode == "pmap":
        return jax.pmap(lambda state, batch: follow(state, on_axis(state, batch)), axis_name=AXIS, in_axes=(None, 1),
                        out_axes=None, devices=plan.devices, donate_argnums=donated)

    def whole(state, batch):
        found: Any = PartitionSpec()
        if shared is not None and plan.share_state:
            found = (plan.state_specs(shared(state)), PartitionSpec(), PartitionSpec())
        mapped = jax.shard_map(on_axis, mesh=plan.mesh, in_specs=(PartitionSpec(), PartitionSpec(None, AXIS)),
                               out_specs=found, check_vma=False)
        result = follow(state, mapped(state, batch))
        if then is None:
            return result
        return jax.lax.with_sharding_constraint(result[0], plan.state_shardings(result[0])), result[1]

    return jax.jit(whole, donate_argnums=donated)
