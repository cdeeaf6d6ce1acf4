"""python -m muvo_jax.convert CKPT --out=runs/NAME: a checkpoint of the authors' PyTorch code becomes a run."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import pathlib
import shutil
import sys
import tempfile
from typing import Annotated, Any

import numpy as np
import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax import config as config_lib
    from muvo_jax import presets
    from muvo_jax.interop import checkpoints, names
    from muvo_jax.training import checkpoint, run_folder, screen

REPORT_FILE = "conversion.json"


@dataclasses.dataclass(frozen=True)
class Options:
    """Reads a checkpoint of the authors' PyTorch code, without torch, and writes a run.

    evaluate, dream, train --init and muvo_jax.load take the run. Which model it is follows from the checkpoint's keys
    and shapes. RUN/conversion.json lists what became of every key.
    """

    checkpoint: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="CKPT")]
    """A Lightning .ckpt, or a state_dict (.pth, .pt, .safetensors)."""
    out: Annotated[pathlib.Path, tyro.conf.arg(metavar="RUN")]
    """Folder of the new run."""


EXAMPLES = """
python -m muvo_jax.convert RV_WOB_TR_1d_Voxel.ckpt --out=runs/authors-1d
python -m muvo_jax.evaluate runs/authors-1d --data=/data/muvo
"""


def convert(options: Options, show: screen.Screen) -> checkpoints.Stored:
    """Does what the command line asks for.

    Raises:
      FileExistsError: where the run's folder is not empty.
      OSError: where the run cannot be written.
      ValueError: where the run's folder is the current one; where the file cannot be read, is of another project, or
        does not fit; no folder is left behind.
    """
    options = dataclasses.replace(options, out=options.out.expanduser().resolve())
    if options.out in (here := pathlib.Path.cwd(), *here.parents):
        raise ValueError(f"--out is {options.out}, the current folder or one around it; expected a folder of the run's "
                         f"own, such as --out=runs/NAME.")
    if options.out.exists() and not (options.out.is_dir() and not any(options.out.iterdir())):
        raise FileExistsError(f"{options.out} exists already: choose another --out.")
    stored = checkpoints.read(options.checkpoint)
    model = checkpoints.recognise(stored)
    match = names.match_state_dict(stored.state_dict, model)
    what = checkpoints.published_name(model)
    described = f"{model.variant}, {model.latent.kind} latent, heads {', '.join(model.heads)}"
    if problems := match.problems():
        raise checkpoints.CheckpointMismatch(
            f"{options.checkpoint}: expected the keys of {described}, to judge by its shapes; found {problems}.")
    show.line(f"{options.checkpoint.name}: {described}" + (f"; the released {what}" if what else ""))
    preset = presets.get("paper-occupancy" if "occupancy" in model.heads else "paper")
    config = stored.config or config_lib.override(dataclasses.replace(preset, model=model), "data.town_size", "tiny")
    step = stored.facts.get("global_step", 0)
    step = step if type(step) is int and 0 <= step < 2**63 else 0
    ignored = dict(stored.beside) | match.ignored
    report = {"source": str(options.checkpoint.resolve()), "recognised": what, "variant": model.variant,
              "latent": model.latent.kind, "facts": dict(stored.facts), "mapped": match.mapped, "ignored": ignored,
              "missing": match.missing, "unexpected": match.unexpected, "wrong_shape": match.misshapen}
    _write(options.out, step, names.convert_state_dict(stored.state_dict, model), config, report)
    if broken := [key for key in match.mapped if not np.isfinite(stored.state_dict[key]).all()]:
        show.warn(f"{options.checkpoint}: {len(broken)} of its weights hold NaN or infinity, such as {broken[0]}.")
    show.line(f"{len(match.mapped)} keys mapped, {len(ignored)} ignored (why: {options.out / REPORT_FILE})")
    show.line(f"wrote {options.out}, numerics={model.numerics}")
    return stored


def _write(out: pathlib.Path, step: int, variables: Any, config: config_lib.Config, report: dict[str, Any]) -> None:
    """Writes the run beside its place first, so that half a run is never left in it.

    Raises:
      OSError: where it cannot be written; folders that were made for it are gone again.
    """
    absent = [parent for parent in out.parents if not parent.exists()]  # innermost first
    try:
        _write_whole(out, step, variables, config, report)
    except Exception as error:  # Orbax and TensorStore raise OSError, ValueError or RuntimeError for a full disk
        with contextlib.suppress(OSError):
            for parent in absent:
                parent.rmdir()
        raise OSError(f"the run could not be written to {out}: {screen.said(error)}."
                      + (" Is the disk full?" if _of_disk(error) else "") + " Nothing was left behind.") from error


def _of_disk(error: Exception) -> bool:
    """Whether there was no room: TensorStore tells it in words alone."""
    full = (errno.ENOSPC, errno.EDQUOT)
    return getattr(error, "errno", None) in full or any(os.strerror(code) in str(error) for code in full)


def _write_whole(out: pathlib.Path, step: int, variables: Any, config: config_lib.Config,
                 report: dict[str, Any]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = pathlib.Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        run_folder.write_config(partial, config)
        (partial / REPORT_FILE).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        checkpoint.save_variables(partial, step, variables, config=config,
                                  provenance={"converted_from": report["source"], "recognised": report["recognised"]})
        if out.exists():
            out.rmdir()  # empty, as checked before
        partial.chmod(0o755)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def main() -> int:
    return command_line.run(Options, convert, program="convert", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
