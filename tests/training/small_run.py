"""python -m muvo_jax.train with the small model on a recording without files, for tests that start and kill processes.

    python small_run.py [FLAGS OF TRAIN]

$KILL_AT names a moment at which the process kills itself: step, evaluation or save, and how many of these it survives:
"save:1". $STOP_AT=3 sends SIGTERM after that step, twice. $FULL_AT=1: from the second save on its disk is full.
"""

import itertools
import os
import resource
import signal
import sys
import time

import jax
import test_loop

from muvo_jax import recordings, train
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint, integrity, parallel, run_folder, validation
from muvo_jax.training import step as step_lib

FLAGS = ("--preset=tiny", "--data=/memory", "--heads=image,action", "--frames=3", "--stride=1", "--context=2",
         "--horizon=2", "--batch=4", "--no-evaluate", "--set", "train.log_every=1", "train.validate_every=3",
         "train.checkpoint_every=2", "train.preview_every=0", "model.prior_dropout=0.5", "model.fusion.dropout=0.2")


class Recording(test_loop.MemoryRecording):
    """Named like the folder, of which there is none."""


def failing(function, fault, survived):
    """`function`, before which `fault()` happens from the call on that follows `survived` others (None: never)."""
    calls = itertools.count()

    def called(*arguments, **options):
        if survived is not None and next(calls) >= survived:
            fault()
        return function(*arguments, **options)

    return called


def killed():
    os.kill(os.getpid(), signal.SIGKILL)


def disk_full():
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))


def dying(function, moment):
    name, _, survived = os.environ.get("KILL_AT", "").partition(":")
    return failing(function, killed, int(survived or 0) if name == moment else None)


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
    full_at = int(os.environ.get("FULL_AT", "1000"))
    checkpoint.Checkpoints.save = failing(checkpoint.Checkpoints.save, disk_full, full_at)
    run_folder.RunFolder.log = stopping(run_folder.RunFolder.log)
    sys.argv[1:] = [*FLAGS, *sys.argv[1:]]
    sys.exit(train.main())
