"""Work in several processes: results, errors as they are, killed workers; and the lock of a folder."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from muvo_jax.data import files, processes, schema


def halved(minuend, number):
    """What the workers do here."""
    if number == 13:
        raise schema.DataError("thirteen cannot be halved")
    if number == 99:
        os.kill(os.getpid(), signal.SIGKILL)
    return minuend - number / 2


def spread(numbers):
    return sorted(processes.spread(halved, numbers, shared=(100,), workers=2, doing="halving"))


def test_results_come_from_all_tasks():
    assert spread(range(4)) == [98.5, 99.0, 99.5, 100.0]


def test_an_error_keeps_its_type_and_words():
    with pytest.raises(schema.DataError, match=r"^thirteen cannot be halved$"):
        spread([13])


def test_a_killed_worker_is_told():
    with pytest.raises(processes.WorkerError, match="a halving process was killed") as told:
        spread([99, 1])
    assert isinstance(told.value, OSError) and isinstance(told.value, RuntimeError)  # commands expect the first


def test_a_lock_refuses_or_waits(tmp_path):
    path, order = tmp_path / ".lock", []

    def later():
        with processes.locked(path, "packing", wait=True):
            order.append("second")

    with processes.locked(path, "packing"):
        with (pytest.raises(BlockingIOError, match="another process is packing here now"),
              processes.locked(path, "packing")):
            pass
        thread = threading.Thread(target=later)
        thread.start()
        thread.join(timeout=0.2)
        order.append("first")
    thread.join(timeout=10)
    assert order == ["first", "second"]


def test_two_machines_of_one_process_id_may_write_one_file(tmp_path, monkeypatch):
    path, replace = tmp_path / "plan.json", os.replace

    def replace_after_the_other(draft, target):
        monkeypatch.setattr(os, "replace", replace)
        files.write_atomically(path, "theirs")
        replace(draft, target)

    monkeypatch.setattr(os, "replace", replace_after_the_other)
    files.write_atomically(path, "ours")
    assert path.read_text() == "ours" and list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_written_leaves_no_draft(tmp_path, monkeypatch):
    def full(draft, target):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        files.write_atomically(tmp_path / "plan.json", "ours")
    assert not list(tmp_path.iterdir())


def test_workers_that_cannot_start_are_told_from_killed_ones():
    script = """
from muvo_jax.data import processes
try:
    list(processes.spread(abs, [1, 2], shared=(), workers=2, doing="halving"))
except processes.WorkerError as error:
    print("told:", error)
"""
    done = subprocess.run([sys.executable, "-"], input=script, capture_output=True, text=True, timeout=120, check=False)
    assert "told: no halving process could start." in done.stdout and "workers=1" in done.stdout
