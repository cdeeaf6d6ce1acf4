"""python -m muvo_jax.interop.export_torch RUN OUT: a run's weights as safetensors for the authors' PyTorch model."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import sys
from typing import Annotated

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    import jax

    from muvo_jax import config as config_lib
    from muvo_jax import safetensors_file
    from muvo_jax.interop import checkpoints, names
    from muvo_jax.training import run_folder


@dataclasses.dataclass(frozen=True)
class Options:
    """Writes a run's weights under the names of the authors' PyTorch code, as a safetensors file.

    Their model loads those of a run of the reference's network and sizes (--preset=reference, strict=False: counters
    and templates that no forward pass reads are not part of it). muvo_jax.convert reads those of any run back.
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File to write, such as weights.safetensors."""
    checkpoint: str = "latest"
    """latest, best (skill of imagined frames, docs/design.md) or a step."""


_EXAMPLES = """
python -m muvo_jax.interop.export_torch runs/paper-tr weights.safetensors
"""


def export(options: Options, show) -> None:
    """Does what the command line asks for.

    Raises:
      ValueError: if OUT is a folder, or lies in none.
      OSError: if OUT cannot be written.
    """
    if options.out.is_dir():
        raise ValueError(f"OUT: {options.out} is a folder; name a file, such as {options.out / 'weights.safetensors'}.")
    if not options.out.absolute().parent.is_dir():
        raise ValueError(f"OUT: there is no folder {options.out.parent} for {options.out.name}; make it, or name "
                         f"another.")
    run_folder.check_writable(options.out.absolute().parent, "OUT")
    loaded = command_line.load_run(options.run, options.checkpoint, show)
    variables = jax.tree.map(np.asarray, dict(loaded.variables))
    state_dict = names.reference_state_dict(variables, loaded.config.model)
    safetensors_file.save(options.out, state_dict, {
        "variant": loaded.config.model.variant, "latent": loaded.config.model.latent.kind,
        "numerics": loaded.config.model.numerics, "step": str(loaded.step),
        checkpoints.CONFIG: json.dumps(loaded.config.to_dict())})
    if theirs := _unlike_theirs(loaded.config.model):
        show.warn(f"the authors' code has no {theirs}: it will not take these weights, or make other numbers of them. "
                  f"They read back with python -m muvo_jax.convert.")
    show.line(f"wrote {options.out}: {len(state_dict)} tensors of {loaded.config.model.variant}, "
              f"numerics={loaded.config.model.numerics}")


def _unlike_theirs(model: config_lib.ModelConfig) -> str:
    """What of a network has no counterpart in the authors' code, sizes aside; "" for nothing."""
    found = [name for name, unlike in (
        (f"numerics={model.numerics}", model.numerics != "reference"),
        (f"first_guess={model.first_guess.kind}", not isinstance(model.first_guess, config_lib.ZeroGuess)),
        (f"action_path={model.action_path}", model.action_path == "recurrence")) if unlike]
    return ", ".join(found)


def main() -> int:
    return command_line.run(Options, export, program="interop.export_torch", examples=_EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
