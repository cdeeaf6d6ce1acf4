"""A trained model as it is, for another recording: python experiments/transfer/zero_shot.py RUN DATA OUT [NAME=VALUE]

Writes the run OUT, which `python -m muvo_jax.evaluate OUT` judges: the weights of RUN, of which nothing is trained;
what it knows of inputs that DATA lacks is left out, average frames are those of DATA's training frames.
"""

import pathlib
import sys

import muvo_jax
from muvo_jax import command_line, recordings
from muvo_jax import config as config_lib
from muvo_jax.data import fitting, pipeline
from muvo_jax.training import checkpoint, opening, run_folder, transfer


def main(run: str, data: str, out: str, *settings: str) -> None:
    loaded = muvo_jax.load(run)
    chosen = {"data.path": str(pathlib.Path(data).resolve())} | command_line.parse_settings(settings)
    config = config_lib.override_all(loaded.config, chosen)
    recording = recordings.open_configured(config)
    config = fitting.adapt(config, recording, keep=(*chosen, *fitting.OF_TRAINED)).config
    wanted = muvo_jax.WorldModel(config.model).variable_shapes()
    variables = transfer.to_recording(loaded, config, wanted, pipeline.Frames(recording, config))
    folder = pathlib.Path(out)
    checkpoint.save_variables(folder, 0, variables, config=config, provenance=opening.provenance(recording, config))
    run_folder.write_config(folder, config)
    print(f"wrote {folder}")


if __name__ == "__main__":
    main(*sys.argv[1:])
