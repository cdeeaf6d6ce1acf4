"""One training step on one device or on many: replicated state, batch split over the devices.

`pmap` and `shard_map` run the same body on the same state; `jax.pmap` gets the state by in_axes=None, so that it has no
device axis and a checkpoint does not know how many devices wrote it. The body is written per device: it sums over
`AXIS` before every ratio and averages gradients with `pmean`. That is right for pmap, and for shard_map with
check_vma=False, where the transpose of a sum over devices is again a sum; with check_vma=True the same code would scale
the gradients wrongly (Adam hides such a factor, so the tests compare raw gradients).

Several processes (jax.distributed) share a step through shard_map: each places the windows that it read itself, and
all of them call the step together.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from muvo_jax import types

AXIS = "data"
MODES = ("auto", "pmap", "shard_map")
Body = Callable[[Any, types.Batch, str | None], Any]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which devices share a batch, and how.

    Attributes:
      mode: "single", "pmap" or "shard_map".
      devices: those that take part.
    """

    mode: str
    devices: tuple[jax.Device, ...]

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
        return f"{self.mode} over {len(self.devices)} {self.devices[0].platform} devices{hosts}"

    @property
    def batch_sharding(self) -> NamedSharding:
        """Of what `place_batch` returns: micro-batch after micro-batch, each spread over the devices."""
        return NamedSharding(self.mesh, PartitionSpec(None, AXIS))


def make_plan(parallel: str, batch_size: int, devices: Sequence[jax.Device] | None = None) -> Plan:
    """Chooses devices for micro-batches of `batch_size` windows.

    "auto" takes shard_map over as many devices as divide the batch, and no wrapper where that is one. "pmap" and
    "shard_map" take all devices, and so does "auto" where they belong to several processes.

    Raises:
      ValueError: for an unknown mode, or where all devices have to share the batch and cannot split it evenly; for pmap
        with several processes.
    """
    devices = tuple(jax.devices() if devices is None else devices)
    if parallel not in MODES:
        raise ValueError(f"parallel: got {parallel!r}, expected one of {', '.join(MODES)}.")
    if len({device.process_index for device in devices}) > 1:
        if parallel == "pmap":
            raise ValueError("parallel=pmap works within one process; use parallel=shard_map (or auto) with several "
                             "hosts.")
        parallel = "shard_map"
    if parallel == "auto":
        count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
        return Plan("single" if count == 1 else "shard_map", devices[:count])
    if batch_size % len(devices):
        raise ValueError(f"parallel={parallel}: {batch_size} windows cannot be split over {len(devices)} devices. "
                         f"Set train.batch to a multiple of {len(devices)}, or, within one process, use "
                         f"parallel=auto.")
    return Plan(parallel, devices)


def place_state(plan: Plan, state: Any) -> Any:
    """A copy of the state on every device of the plan (the same arrays where they are there already).

    Several processes must all pass the same numbers.
    """
    sharding = NamedSharding(plan.mesh, PartitionSpec())
    if plan.processes == 1:
        return jax.device_put(state, sharding)
    return jax.tree.map(functools.partial(_on_all_processes, sharding), state)


def _on_all_processes(sharding: NamedSharding, leaf: types.ArrayLike) -> jax.Array:
    if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:  # it is there
        return leaf
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _on_all_processes(sharding, jax.random.key_data(leaf))
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    return jax.make_array_from_process_local_data(sharding, np.asarray(leaf))


def on_device(state: Any, device: jax.Device) -> Any:
    """The state on one device of this process, which has a copy of it."""
    own = lambda leaf: (leaf.addressable_data(0) if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable
                        else leaf)
    return jax.device_put(jax.tree.map(own, state), device)


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
    sharding = NamedSharding(plan.mesh, PartitionSpec())
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), state)


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


def spread(plan: Plan, body: Body, *, donate_state: bool = False) -> Callable[[Any, types.Batch], Any]:
    """Compiles `body(state, batch, axis_name)` for the plan.

    Args:
      plan: where it runs.
      body: computes for the local part of a batch, leaves [accumulate, b, ...]; what it returns must be equal on all
        devices (summed or averaged over `axis_name`, which is None on a single device).
      donate_state: whether the buffers of the state may be reused.

    Returns:
      function(placed state, placed batch) -> what the body returns, replicated.
    """
    donated = (0,) if donate_state else ()
    if plan.mode == "single":
        return jax.jit(lambda state, batch: body(state, batch, None), donate_argnums=donated)
    on_axis = lambda state, batch: body(state, batch, AXIS)
    if plan.mode == "pmap":
        return jax.pmap(on_axis, axis_name=AXIS, in_axes=(None, 1), out_axes=None, devices=plan.devices,
                        donate_argnums=donated)
    specs = (PartitionSpec(), PartitionSpec(None, AXIS))
    mapped = jax.shard_map(on_axis, mesh=plan.mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False)
    return jax.jit(mapped, donate_argnums=donated)
