"""Several processes, on one machine or on many, that train one run together (jax.distributed).

All of them compute every step; the first one writes what a run leaves, beside the checkpoints, which all write.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import hashlib
import json
import os
import pickle
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

from muvo_jax.training import screen

WAIT_S = 45.0  # for a coordinator, before a host says that there is none
WAIT_FOR_ALL_S = 300.0  # for hosts that start late, as where images are still pulled
_HEARTBEAT_S = 45  # a host that is silent for so long is lost; a starved machine may well be for 30
_DAY_S = 24 * 3600  # hosts wait so long at the end for the first one, which evaluates
_LAST_WORDS_S = 5.0  # the others end as soon as host 0 has, whatever they were about to say
_AUTO = "auto"
_LOSS = re.compile("Gloo|NCCL|RCCL|coordination service|UNAVAILABLE|DEADLINE_EXCEEDED|ABORTED")
_Value = TypeVar("_Value")


class LostHostError(OSError):
    """A step of several hosts failed, most likely since one of them has ended; the message says how to go on."""


@dataclasses.dataclass(frozen=True)
class Launch:
    """How this process was started beside others; every field is None where the cluster says it (JAX recognises it).

    Attributes:
      hosts: how many processes train together.
      host: number of this one, from 0.
      coordinator: "ADDRESS:PORT" of process 0, free there and seen by all.
    """

    hosts: int | None = None
    host: int | None = None
    coordinator: str | None = None


def launch_of(hosts: str | None, host: int | None, coordinator: str | None) -> Launch | None:
    """What --hosts, --host and --coordinator say; None for a process that trains alone.

    Raises:
      ValueError: where they do not go together.
    """
    if hosts == _AUTO and (host, coordinator) == (None, None):
        return Launch()
    if hosts is None and (host, coordinator) == (None, None):
        return None
    if hosts == "1" and host in (None, 0):
        return None
    if (hosts is None or not hosts.isdecimal() or host is None or host >= int(hosts) or coordinator is None
            or not coordinator.rpartition(":")[0] or not _is_port(coordinator.rpartition(":")[2])):
        raise ValueError(f"--hosts={hosts} --host={host} --coordinator={coordinator}: expected --hosts=auto in a job "
                         f"of SLURM, Kubernetes, Open MPI or Cloud TPU, or all three: --hosts=COUNT, --host=INDEX from "
                         f"0 to COUNT - 1, and --coordinator=ADDRESS:PORT of host 0, the same for all "
                         f"(docs/cluster.md).")
    return Launch(int(hosts), host, coordinator)


def _is_port(text: str) -> bool:
    return text.isdecimal() and 0 < int(text) < 2**16


def join(launch: Launch, show: screen.Screen) -> None:
    """Meets the other processes; to be called before anything is computed. All but the first one fall silent.

    Ends the process, with a message, where nobody answers at the coordinator's address for WAIT_S, or where not all
    hosts have come after WAIT_FOR_ALL_S: JAX would end it without ours.

    Raises:
      ValueError: where JAX recognises no cluster.
      OSError: where host 0 cannot listen at its address.
    """
    joined = threading.Event()
    threading.Thread(target=_lose_patience, args=(launch, joined), daemon=True).start()
    try:
        jax.distributed.initialize(
            launch.coordinator, launch.hosts, launch.host,
            cluster_detection_method=None if launch.hosts is None else "deactivate",
            initialization_timeout=int(WAIT_FOR_ALL_S) + 60, heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_DAY_S)
    except ValueError as error:
        raise ValueError(f"--hosts=auto: JAX recognises no job of SLURM, Kubernetes, Open MPI or Cloud TPU here "
                         f"({error}) Say it with --hosts=COUNT --host=INDEX --coordinator=ADDRESS:PORT.") from error
    except jax.errors.JaxRuntimeError as error:
        raise OSError(f"host {launch.host} of {launch.hosts} cannot take part at {launch.coordinator}: is that port "
                      f"taken? Choose a free one for all hosts. ({screen.said(error)})") from error
    finally:
        joined.set()
    show.console.quiet = not is_first()
    show.field("hosts", f"{jax.process_count()}, with {jax.device_count()} devices; this is host {jax.process_index()}")


def _lose_patience(launch: Launch, joined: threading.Event) -> None:
    if joined.wait(WAIT_S):
        return
    if launch.coordinator is not None and not _answers(launch.coordinator):
        _end(f"host {launch.host} of {launch.hosts}: nobody answers at {launch.coordinator} after {WAIT_S:.0f} s. Is "
             f"host 0 started, with the same --coordinator, at an address and port that this machine may reach?")
    of_all = "all" if launch.hosts is None else f"all {launch.hosts}"
    print(f"warning: not {of_all} hosts have started after {WAIT_S:.0f} s; waiting.", file=sys.stderr, flush=True)
    if not joined.wait(WAIT_FOR_ALL_S - WAIT_S):
        _end(f"not {of_all} hosts have started after {WAIT_FOR_ALL_S:.0f} s. Start each with the same command, --host "
             f"aside.")


def _answers(coordinator: str) -> bool:
    address, _, port = coordinator.rpartition(":")
    try:
        socket.create_connection((address.strip("[]"), int(port)), timeout=5.0).close()
    except OSError:
        return False
    return True


def _end(text: str) -> NoReturn:
    print(f"error: {text}", file=sys.stderr, flush=True)
    os._exit(1)


def leave(code: int) -> int:
    """To be called at the end with the exit code. A host that failed ends at once, so that the others notice; else it
    would wait for them to end well."""
    if code and jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        time.sleep(_LAST_WORDS_S if is_first() else 0.0)
        os._exit(code)
    return code


def is_first() -> bool:
    """Whether this process writes what only one may write."""
    return jax.process_index() == 0


def wait_for_all(reason: str) -> None:
    """Goes on once all processes are here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(reason)


def gather(value: _Value) -> list[_Value]:
    """The values of all processes, in their order; to be called by all of them."""
    if jax.process_count() == 1:
        return [value]
    data = np.frombuffer(pickle.dumps(value), np.uint8)
    sizes = multihost_utils.process_allgather(np.int32(data.size))
    rows = multihost_utils.process_allgather(np.pad(data, (0, int(sizes.max()) - data.size)))
    return [pickle.loads(row[:size].tobytes()) for row, size in zip(rows, sizes, strict=True)]


def any_of(flag: bool) -> bool:
    """Whether the flag is set in any process; to be called by all of them."""
    return any(gather(flag))


class SavingBarrier:
    """Where hosts that save together wait for each other (ocp.options.BarrierSyncFn).

    A host that comes here with an error on its way, its disk being full, says so, and all the others fail with it.
    Orbax's own barrier would let everybody wait, that host too, for twenty minutes.
    """

    _FOLDER, _FAILED, _LOOK_S = "muvo_jax_saves", "muvo_jax_failed_saves", 0.05

    def __init__(self):
        self._visits: collections.Counter[str] = collections.Counter()

    def __call__(self, *, key: str, timeout_ms: int) -> None:
        """Returns once all hosts have called it as often with this key.

        Raises:
          OSError: where the saving of one has failed, naming it and its reason.
          TimeoutError: where not all have come in time.
        """
        client, host = ocp.multihost.get_jax_distributed_client(), jax.process_index()
        error = sys.exc_info()[1]  # Orbax comes here in `finally`
        if error is not None and not client.key_value_dir_get(self._FAILED):
            client.key_value_set(f"{self._FAILED}/{host}", f"host {host}: {screen.said(error)}")
        self._visits[key] += 1
        place, end_s = f"{self._FOLDER}/{key}/{self._visits[key]}", time.monotonic() + timeout_ms / 1000.0
        client.key_value_set(f"{place}/{host}", "here")
        while len(client.key_value_dir_get(place)) < jax.process_count():
            if failed := client.key_value_dir_get(self._FAILED):
                raise OSError("; ".join(reason for _, reason in failed))
            if time.monotonic() > end_s:
                raise TimeoutError(f"not all {jax.process_count()} hosts have saved after {timeout_ms / 1000.0:.0f} s")
            time.sleep(self._LOOK_S)


def check_same(facts: Mapping[str, Any]) -> None:
    """Raises ValueError, in all processes, naming the facts (JSON types) that are not the same in all of them."""
    digests = {name: hashlib.sha256(json.dumps(fact, sort_keys=True, default=str).encode()).hexdigest()
               for name, fact in facts.items()}
    everywhere = gather(digests)
    differing = [name for name in facts if len({other[name] for other in everywhere}) > 1]
    if differing:
        raise ValueError(f"the {len(everywhere)} hosts do not see the same {', '.join(differing)}. Start all of them "
                         f"with the same command (--host aside), version and data, and a runs folder that all share.")


def is_loss(error: BaseException) -> bool:
    """Whether it looks as if another process was missing. JAX gives such errors no type of their own."""
    return jax.process_count() > 1 and _LOSS.search(str(error)) is not None


@contextlib.contextmanager
def noticing_losses(resume_command: str) -> Iterator[None]:
    """Turns the error of a step that a host is missing from into a LostHostError."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        if not is_loss(error):
            raise
        raise LostHostError(
            f"host {jax.process_index()}: what all {jax.process_count()} hosts compute together failed; most likely "
            f"another host has ended ({str(error).splitlines()[0][:200]}). Its own message, if any, says why. Go on "
            f"from the newest checkpoint with as many hosts as there are:  {resume_command}") from error


class StopRequest:
    """Turns the first SIGINT or SIGTERM into a wish that the loop sees between two steps.

    A second SIGINT interrupts. A second SIGTERM does not: schedulers send several before they kill, and it would
    interrupt the saving that the first one asked for.

    Several processes stop after the same step, whichever was asked: then JAX catches SIGTERM, and makes them agree.
    """

    def __init__(self):
        self.requested = self._asked = False
        self._several = jax.process_count() > 1
        self._before: dict = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            numbers = (signal.SIGINT,) if self._several else (signal.SIGINT, signal.SIGTERM)
            self._before = {number: signal.signal(number, self._handle) for number in numbers}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def after(self, step: int) -> bool:
        """Whether to stop after that many steps; every process asks after each."""
        if self._several and not self.requested:
            self.requested = multihost_utils.reached_preemption_sync_point(step)
        return self.requested

    def _handle(self, number: int, _) -> None:
        if self._asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._asked = True
        if self._several:
            signal.raise_signal(signal.SIGTERM)
        else:
            self.requested = True
