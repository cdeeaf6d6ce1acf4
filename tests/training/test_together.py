"""Processes that train together: how they are told, what they say when the others do not come, when they stop."""

import os
import pathlib
import signal
import subprocess
import sys

import jax
import orbax.checkpoint as ocp
import pytest

from muvo_jax.training import screen, together

ROOT = pathlib.Path(__file__).parents[2]
ALONE = """
from muvo_jax.training import screen, together
together.WAIT_S, show = 1.0, screen.Screen()
try:
    together.join(together.Launch(), show)
except ValueError as error:
    print(error)
together.join(together.launch_of("2", 1, "localhost:1"), show)
"""


def test_flags_say_who_one_is():
    assert together.launch_of(None, None, None) is None
    assert together.launch_of("1", 0, "a:1") is None
    assert together.launch_of("auto", None, None) == together.Launch()
    assert together.launch_of("4", 3, "10.0.0.1:1234") == together.Launch(4, 3, "10.0.0.1:1234")


@pytest.mark.parametrize("flags", [
    ("2", None, None), ("2", 0, None), ("2", 2, "a:1"), ("two", 0, "a:1"), ("2", 0, "a"), ("2", 0, ":1"),
    ("0", 0, "a:1"),
    ("auto", 1, None), (None, 1, None), (None, None, "a:1")])
def test_flags_that_do_not_go_together_are_told_with_those_that_do(flags):
    with pytest.raises(ValueError, match=r"expected --hosts=auto in a job of SLURM.*or all three: --hosts=COUNT"):
        together.launch_of(*flags)


def test_no_cluster_and_no_coordinator_are_told_in_words():
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "OMPI_"))}
    done = subprocess.run([sys.executable, "-c", ALONE], env=variables | {"PYTHONPATH": str(ROOT)}, timeout=300,
                          capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "--hosts=auto: JAX recognises no job of SLURM" in done.stdout
    assert done.stderr.strip().splitlines()[-1].startswith(
        "error: host 1 of 2: nobody answers at localhost:1 after 1 s. Is host 0 started")


def test_a_second_sigterm_lets_a_run_save_and_a_second_ctrl_c_interrupts_it():
    with together.StopRequest() as stop:
        assert not stop.after(1)
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert stop.after(2)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


class _Client:
    """The store of jax.distributed, as one host alone has it."""

    def __init__(self):
        self.values = {}

    def key_value_set(self, key, value):
        assert key not in self.values
        self.values[key] = value

    def key_value_dir_get(self, folder):
        return [(key, value) for key, value in self.values.items() if key.startswith(f"{folder}/")]


def test_who_comes_to_the_barrier_of_saving_with_an_error_ends_it_for_all(monkeypatch):
    client, barrier = _Client(), together.SavingBarrier()
    monkeypatch.setattr(ocp.multihost, "get_jax_distributed_client", lambda: client)
    for _ in range(2):
        barrier(key="written", timeout_ms=1000)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(TimeoutError, match="not all 2 hosts have saved"):
        barrier(key="written", timeout_ms=100)
    with pytest.raises(OSError, match="host 0: OSError: no space"):
        try:
            raise OSError("no space")
        finally:
            barrier(key="committed", timeout_ms=1000)
    with pytest.raises(OSError, match=r"host 0: OSError: no space$"):  # and no other save may begin
        barrier(key="written", timeout_ms=1000)


def test_one_process_is_all_of_them():
    assert together.is_first() and together.gather({"a": 1}) == [{"a": 1}] and not together.any_of(False)
    together.wait_for_all("nobody")
    together.check_same({"settings": 1})


@pytest.mark.parametrize("port", ["0", "65536", "99999"])
def test_a_port_is_one(port):
    with pytest.raises(ValueError, match="--coordinator=ADDRESS:PORT"):
        together.launch_of("2", 0, f"localhost:{port}")


def test_a_coordinator_whose_port_is_taken_is_told(monkeypatch):
    def taken(*_, **__):
        raise jax.errors.JaxRuntimeError("UNKNOWN: Failed to start RPC server")

    monkeypatch.setattr(jax.distributed, "initialize", taken)
    with pytest.raises(OSError, match=r"host 0 of 2 cannot take part at localhost:80: is that port taken\?"):
        together.join(together.Launch(2, 0, "localhost:80"), screen.Screen())
