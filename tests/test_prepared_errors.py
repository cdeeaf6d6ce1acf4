"""Errors that a user can do something about are one line on the screen; defects stay tracebacks."""

import jax
import pytest

from muvo_jax import command_line, train
from muvo_jax.data import processes


def run(monkeypatch, error):
    def work(options, show):
        raise error

    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    return command_line.run(train.Options, work, program="train", arguments=[])


@pytest.mark.parametrize(("error", "message"), [
    (processes.WorkerError("a packing process was killed (is memory short?)"),
     "error: a packing process was killed (is memory short?)\n"),
    (jax.errors.JaxRuntimeError("INTERNAL: here\nRESOURCE_EXHAUSTED: Out of memory allocating 5 bytes.\nmore"),
     "error: the device's memory ran out (RESOURCE_EXHAUSTED: Out of memory allocating 5 bytes.): take a smaller "
     "--batch, and for training --set train.remat=frames; python -m muvo_jax.estimate "),
])
def test_a_prepared_error_is_one_line(error, message, monkeypatch, capsys):
    assert run(monkeypatch, error) == 1
    said = capsys.readouterr().err
    assert said.startswith(message) and "Traceback" not in said and said.count("\n") == 2


def test_other_errors_of_jax_are_defects(monkeypatch):
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run(monkeypatch, jax.errors.JaxRuntimeError("INTERNAL: something else"))
