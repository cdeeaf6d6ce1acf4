"""Work spread over processes, and a lock that keeps a second command out of a folder."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence

try:
    import fcntl
except ImportError:  # Windows: there it is up to the user not to work on one folder twice at once
    fcntl = None  # type: ignore[assignment]


def processors() -> int:
    """How many processors this process may use: what a number of workers is where none is asked for."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def stream(work: Callable[..., Iterable], shares: Sequence[tuple], doing: str) -> Iterator:
    """Runs `work(*share)` in a process for each share; yields what they yield, as it comes.

    Args:
      work: a function of a module, so that a fresh process finds it.
      shares: its arguments, picklable.
      doing: such as "packing", for messages.

    Raises:
      RuntimeError: where a process ends with a ValueError or OSError (its message is told), or is killed.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    lock = context.Lock()
    processes = [context.Process(target=_work, args=(work, share, sender, lock, os.getpid()), daemon=True)
                 for share in shares]
    for process in processes:
        process.start()
    sender.close()  # then the end of the last worker ends the stream
    try:
        while True:
            value, fault = receiver.recv()
            if fault is not None:
                raise RuntimeError(f"a {doing} process failed: {fault}")
            yield value
    except EOFError:  # all is told; on a busy machine the workers may take a while to leave
        for process in processes:
            process.join()
    finally:
        for process in processes:
            if process.is_alive() and process.exitcode is None:
                process.join(timeout=1.0)
                process.terminate()
            process.join()
    codes = [process.exitcode for process in processes if process.exitcode]
    if codes:
        raise RuntimeError(f"{len(codes)} of {len(shares)} {doing} processes ended with exit code {codes[0]}; run "
                           f"again, what is complete is kept.")


def _work(work: Callable[..., Iterable], share: tuple, sender, lock, parent: int) -> None:
    try:
        for value in work(*share):
            if os.getppid() != parent:  # killed: nobody would hold the lock for us
                os._exit(1)
            with lock:
                sender.send((value, None))
    except (ValueError, OSError) as error:
        with lock:
            sender.send((None, str(error)))


@contextlib.contextmanager
def locked(path: pathlib.Path, doing: str) -> Iterator[None]:
    """Keeps a second process out that locks the same file; the lock falls with the process, however it ends.

    Raises:
      BlockingIOError: where another process holds the lock now.
    """
    with path.open("w") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise BlockingIOError(f"{path.parent}: another process is {doing} here now; wait for it, or choose "
                                      f"another folder.") from error
        yield
