"""Work spread over processes, and a lock that keeps a second command out of a folder."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pathlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import process
from multiprocessing.synchronize import Event
from typing import Any, TypeVar

import filelock

_Result = TypeVar("_Result")
_shared: tuple = ()  # of a worker: what all of its tasks need


class WorkerError(ChildProcessError, RuntimeError):
    """A worker process was killed or has failed; the message says what to do. An OSError: commands expect these."""


def processors() -> int:
    """How many processors this process may use: what a number of workers is where none is asked for."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def spread(work: Callable[..., _Result], tasks: Iterable[Any], *, shared: tuple, workers: int,
           doing: str) -> Iterator[_Result]:
    """Runs `work(*shared, task)` for each task in that many processes; yields results as they come, in any order.

    Args:
      work: a function of a module, so that a fresh process finds it.
      tasks: picklable, one at a time.
      shared: arguments for all tasks, picklable; each process gets them once.
      doing: such as "packing", for messages.

    Raises:
      Exception: what `work` raises, as it is; tasks that have not begun are given up.
      WorkerError: where a process is killed, or none can start.
    """
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    pool = futures.ProcessPoolExecutor(workers, context, _begin, (shared, begun))
    try:
        for future in futures.as_completed([pool.submit(_run, work, task) for task in tasks]):
            yield future.result()
    except process.BrokenProcessPool as error:
        if not begun.is_set():  # a fresh process runs the caller's script once more, up to this call
            raise WorkerError(f"no {doing} process could start. In a script, call it below if __name__ == "
                              f"\"__main__\"; in code that comes from stdin, with workers=1.") from error
        raise WorkerError(f"a {doing} process was killed (is memory short?); run again, what is complete is "
                          f"kept.") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(shared: tuple, begun: Event) -> None:
    global _shared
    _shared = shared
    begun.set()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command's own process tells the others to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Where the command is killed, nobody would hold its lock for us."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(work: Callable[..., _Result], task: Any) -> _Result:
    return work(*_shared, task)


@contextlib.contextmanager
def locked(path: pathlib.Path, doing: str, *, wait: bool = False) -> Iterator[None]:
    """Keeps a second process out that locks the same file; the lock falls with the process, however it ends.

    Args:
      wait: for the other process, instead of an error.

    Raises:
      BlockingIOError: where another process holds the lock now.
    """
    try:
        with filelock.FileLock(path, blocking=wait):
            yield
    except filelock.Timeout as error:
        raise BlockingIOError(f"{path.parent}: another process is {doing} here now; wait for it, or choose another "
                              f"folder.") from error


def check_free(paths: Iterable[pathlib.Path], doing: str) -> None:
    """Raises BlockingIOError where another process holds the lock of one of these files, as far as they are there.

    Two that each hold their own and look at the other's both find it held.
    """
    for path in paths:
        if path.exists():
            with locked(path, doing):
                pass
