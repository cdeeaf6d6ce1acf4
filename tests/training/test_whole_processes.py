"""Whole processes of `train` (small_run.py): killed at bad moments, stopped, two that train as one, one of two lost."""

import json
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from muvo_jax.training import timing

HERE = pathlib.Path(__file__).parent
ROOT = HERE.parents[1]
STEPS, DEVICES = 6, 2
MINUTES = 15
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Compiled once for all; most of the time is compilation, and the programs are compared with each other."""
    return {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT),
            "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",  # or the process would start itself once more
            "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}


@pytest.fixture(scope="module")
def start(environment, tmp_path_factory):
    """start(folder, *flags, hosts=1, KILL_AT={host: moment}, STOP_AT=..., FULL_AT=...) -> processes, ended with the
    test."""
    running = []

    def begin(folder, *flags, hosts=1, **moments):
        with socket.socket() as free:
            free.bind(("localhost", 0))
            port = free.getsockname()[1]
        processes = []
        for host in range(hosts):
            devices = max(1, DEVICES // hosts)
            variables = environment | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
            variables |= {name: of_hosts[host] for name, of_hosts in moments.items() if host in of_hosts}
            together = (f"--hosts={hosts}", f"--host={host}", f"--coordinator=localhost:{port}") if hosts > 1 else ()
            processes.append(subprocess.Popen(
                [sys.executable, str(HERE / "small_run.py"), f"--runs-dir={folder.parent}", f"--name={folder.name}",
                 *together, *flags], env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        running.extend(processes)
        return processes

    yield begin
    for process in running:
        process.kill()


def ended(processes):
    """Their exit codes and what they printed."""
    texts = [process.communicate(timeout=60 * MINUTES)[0] for process in processes]
    return [process.returncode for process in processes], texts


def others_end(processes, first):
    """`ended`, once that one is gone; the others must be within a minute."""
    processes[first].wait(60 * MINUTES)
    gone_s = time.monotonic()
    result = ended(processes)
    assert time.monotonic() - gone_s < 60.0
    return result


def logged(folder):
    """All records that do not tell the time, oldest first."""
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in record.items() if name not in timing.OF_THE_CLOCK}
            for record in records if record["kind"] != "time"]


def assert_close(ours, theirs):
    """The same records, up to the rounding of float32."""
    assert [(one["kind"], one["step"]) for one in ours] == [(one["kind"], one["step"]) for one in theirs]
    for one, other in zip(ours, theirs, strict=True):
        for name, value in other.items():
            if isinstance(value, float):
                np.testing.assert_allclose(one[name], value, rtol=2e-5, err_msg=f"{name} of {other['step']}")


@pytest.fixture(scope="module")
def alone(start, tmp_path_factory):
    """What one process with two devices logs when it is left alone."""
    folder = tmp_path_factory.mktemp("runs") / "alone"
    codes, texts = ended(start(folder, f"--steps={STEPS}"))
    assert codes == [0], texts
    return logged(folder)


def test_a_run_killed_at_every_bad_moment_and_stopped_twice_logs_what_one_left_alone_does(start, alone, tmp_path):
    folder = tmp_path / "run"
    dead = -signal.SIGKILL
    assert ended(start(folder, f"--steps={STEPS}", KILL_AT={0: "step"}))[0] == [dead]  # the first one
    assert not list((folder / "checkpoints").iterdir())
    codes, texts = ended(start(folder, "--resume", STOP_AT={0: "1"}))  # SIGTERM, and again while it saves
    assert codes == [0] and "stopped at step 1 of 6; saved" in texts[0], texts
    assert ended(start(folder, "--resume", KILL_AT={0: "evaluation"}))[0] == [dead]
    assert {record["step"] for record in logged(folder)} == {1, 2, 3}
    codes, texts = ended(start(folder, "--resume", KILL_AT={0: "save"}))  # of the next checkpoint, before its checksums
    whole = 2 if "from step 2" in texts[0] else 1  # of step 2 it may have been written when the process was killed
    assert codes == [dead] and f"from step {whole}" in texts[0], texts
    assert (folder / "checkpoints" / {1: "2", 2: "4"}[whole]).is_dir()
    codes, texts = ended(start(folder, "--resume"))
    assert codes == [0] and "saving was interrupted" in texts[0] and f"from step {whole}" in texts[0], texts
    assert logged(folder) == alone


@pytest.mark.parametrize("share", [False, True], ids=["whole", "shared"])
def test_two_hosts_train_as_one_stop_together_and_one_goes_on_without_the_other(start, alone, tmp_path, share):
    folder, sharing = tmp_path / "run", ["--set=train.share_state=true"] if share else []
    codes, texts = ended(start(folder, f"--steps={STEPS}", *sharing, hosts=2, STOP_AT={1: "1"}))
    assert codes == [0, 0], texts
    assert "over 2 cpu devices of 2 hosts" in texts[0] and "steps" not in texts[1]
    assert ("which share the state" in texts[0]) == share
    stopped_at = max(record["step"] for record in logged(folder))
    assert stopped_at < 4 and f"stopped at step {stopped_at} of 6; saved" in texts[0], texts
    assert_close(logged(folder), alone[:len(logged(folder))])

    codes, texts = others_end(start(folder, "--resume", hosts=2, KILL_AT={1: "step:1"}), first=1)
    assert codes == [1, -signal.SIGKILL]
    assert "most likely another host has ended" in texts[0] and "--resume" in texts[0], texts

    codes, texts = ended(start(folder, "--resume"))
    assert codes == [0], texts
    assert_close(logged(folder), alone)


def test_of_four_hosts_one_is_killed_and_another_has_a_full_disk_and_two_go_on(start, alone, tmp_path):
    folder = tmp_path / "run"
    codes, texts = others_end(start(folder, f"--steps={STEPS}", hosts=4, KILL_AT={2: "step:4"}), first=2)
    assert codes == [1, 1, -signal.SIGKILL, 1], texts
    assert all("most likely another host has ended" in texts[host] and "--resume" in texts[host] for host in (0, 1, 3))

    processes = start(folder, "--resume", hosts=4, FULL_AT={3: "0"})
    codes, texts = others_end(processes, first=3)
    assert codes == [1] * 4, texts
    assert all(re.search(r"could not be written to .*: host 3: .*File too large.* Is the disk full", text)
               for text in texts), texts
    assert not list((folder / "checkpoints").glob("*orbax*"))

    codes, texts = ended(start(folder, "--resume", hosts=2))
    assert codes == [0, 0], texts
    assert_close(logged(folder), alone)
