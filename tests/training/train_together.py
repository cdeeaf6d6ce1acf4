"""One of several processes that train together; test_multi_process.py starts them.

    python train_together.py RECORDING OUT.json PROCESS PROCESSES PORT
"""

import dataclasses
import json
import os
import pathlib
import sys

DEVICES, STEPS, ACCUMULATE = 4, 3, 2


def main(recording_path: str, out: str, process: int, processes: int, port: int) -> None:
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={DEVICES // processes}"
    import jax

    if processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"localhost:{port}", num_processes=processes, process_id=process,
                                   heartbeat_timeout_seconds=600)
    pathlib.Path(out).write_text(json.dumps(train(recording_path)))


def train(recording_path: str) -> dict:
    """Trains a few steps; returns what this process read and what the step said."""
    import jax
    import numpy as np
    import small_world

    from muvo_jax.data import fitting, pipeline
    from muvo_jax.data.plain import reader as plain_reader
    from muvo_jax.training import loop, parallel, state
    from muvo_jax.training import optimizer as optimizer_lib
    from muvo_jax.training import step as step_lib

    recording = plain_reader.PlainRecording(recording_path)
    config = small_world.make_config(ACCUMULATE, heads=("image", "action"))
    # Nobody labelled instances in this recording.
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, image_instance=0.0))
    config = fitting.adapt(config, recording, keep=("data.frames",)).config
    source = pipeline.TrainBatches(pipeline.Frames(recording, config), seed=0, batch=loop.windows_per_step(config),
                                   process=jax.process_index(), processes=jax.process_count(), accumulate=ACCUMULATE)
    model = small_world.SmallWorld(config.model)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    step = step_lib.make_train_step(model, config)
    current = parallel.place_state(step.plan, state.create(model.init(), optimizer, jax.random.key(1)))
    report: dict = {"processes": step.plan.processes, "windows": [], "metrics": []}
    for _ in range(STEPS):
        batch = next(source)
        report["windows"].append(np.asarray(batch.image)[:, 0, 0, 0, 0].tolist())  # grey is the first frame's number
        current, metrics = step(current, batch)
        report["metrics"].append({name: float(metrics[name]) for name in ("total", "gradient_norm", "parameter_norm")})
    return report


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
