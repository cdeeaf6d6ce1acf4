"""python -m muvo_jax.train with the small model on a recording without files, for tests that start and kill processes.

    python small_run.py [FLAGS OF TRAIN]

$KILL_AT names a moment at which the process kills itself: step, evaluation or save, and how many of these it survives:
"save:1". $STOP_AT=3 sends SIGTERM after that step, twice.
"""

import os
import signal
import sys
import time

import jax
import test_loop

from muvo_jax import recordings, train
from muvo_jax.model import world_model
from muvo_jax.training import integrity, parallel, run_folder, validation
from muvo_jax.training import step as step_lib

FLAGS = ("--preset=tiny", "--data=/memory", "--heads=image,action", "--frames=3", "--stride=1", "--context=2",
         "--horizon=2", "--batch=4", "--no-evaluate", "--set", "train.log_every=1", "train.validate_every=3",
         "train.checkpoint_every=2", "train.preview_every=0", "model.prior_dropout=0.5", "model.fusion.dropout=0.2")


class Recording(test_loop.MemoryRecording):
    """Named like the folder, of which there is none."""


def dying(function, moment):
    """`function`, before which the process kills itself where $KILL_AT says so."""
    name, _, survived = os.environ.get("KILL_AT", "").partition(":")
    calls = []

    def called(*arguments, **options):
        calls.append(None)
        if name == moment and len(calls) > int(survived or 0):
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)

    return called


def stopping(log):
    """RunFolder.log, which sends SIGTERM twice at the record of a step."""
    def logged(self, record):
        log(self, record)
        if record["kind"] == "train" and record["step"] == int(os.environ.get("STOP_AT", "0")):
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGTERM)
            if jax.process_count() > 1:
                time.sleep(2.0)  # JAX looks for the signal every second

    return logged


if __name__ == "__main__":
    world_model.WorldModel = test_loop.SmallWorld
    recordings.open_configured = lambda config, progress=None, split=None: Recording()
    train.draw_preview = train.draw_curves = lambda *_: None
    parallel.LEAST_SHARED = 64  # of a small model's arrays
    step_lib.SpreadFunction.__call__ = dying(step_lib.SpreadFunction.__call__, "step")
    validation.Validator.run = dying(validation.Validator.run, "evaluation")
    integrity.seal = dying(integrity.seal, "save")
    run_folder.RunFolder.log = stopping(run_folder.RunFolder.log)
    sys.argv[1:] = [*FLAGS, *sys.argv[1:]]
    sys.exit(train.main())
