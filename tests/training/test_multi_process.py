"""Two processes with two devices each train as one process with four: each reads its own windows, the losses agree."""

import json
import os
import pathlib
import socket
import subprocess
import sys

import numpy as np
import pytest

HERE = pathlib.Path(__file__).parent
MINUTES = 15
# Most of the time is compilation, and the programs are compared with each other.
ENVIRONMENT = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
               "PYTHONPATH": os.pathsep.join(map(str, (HERE, HERE.parent / "data", HERE.parents[1])))}
WRITE = """
import pathlib, sys, recording_writers
recording_writers.write_plain(pathlib.Path(sys.argv[1]), {"train/a": 14, "val_rl/b": 8})
"""


def train_together(recording, folder, processes):
    """The reports of all processes."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    outs = [folder / f"{index}_of_{processes}.json" for index in range(processes)]
    running = [subprocess.Popen([sys.executable, str(HERE / "train_together.py"), str(recording), str(out), str(index),
                                 str(processes), str(port)], env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
               for index, out in enumerate(outs)]
    try:
        for process in running:
            _, errors = process.communicate(timeout=60 * MINUTES)
            assert process.returncode == 0, errors[-3000:]
    finally:
        for process in running:
            process.kill()
    return [json.loads(out.read_text()) for out in outs]


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path):
    recording = tmp_path / "recording"
    subprocess.run([sys.executable, "-c", WRITE, str(recording)], env=ENVIRONMENT, check=True)
    (alone,) = train_together(recording, tmp_path, 1)
    together = train_together(recording, tmp_path, 2)
    assert alone["processes"] == 1 and all(report["processes"] == 2 for report in together)
    for index, windows in enumerate(alone["windows"]):
        first, second = (report["windows"][index] for report in together)
        # Two micro-batches of four windows: each process reads two of the first and two of the second.
        assert first + second == windows[:2] + windows[4:6] + windows[2:4] + windows[6:]
    for report in together:
        for ours, theirs in zip(report["metrics"], alone["metrics"], strict=True):
            for name, value in theirs.items():
                np.testing.assert_allclose(ours[name], value, rtol=2e-5, err_msg=name)
    assert alone["metrics"][0] != alone["metrics"][1]
