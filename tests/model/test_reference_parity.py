"""Whole models at the paper's size against numbers of the authors' PyTorch code (slow; skipped without the files).

The folder with the files p4 and p5 is the one that the environment variable MUVO_GOLDEN names, or lies beside the
repository. `python -m muvo_jax.interop.parity FOLDER` runs the same checks, and those of the small files.
"""


import jax
import pytest
import recording_samples as samples
import torch_writer

import muvo_jax
from muvo_jax import convert
from muvo_jax.interop import weights_rule
from muvo_jax.interop.parity import cases, full_models, golden, registry, runner
from muvo_jax.training import screen

FOLDER = samples.GOLDEN
WHOLE = FOLDER is not None and (FOLDER / "p4_full" / "1d_RV_WOB_TR_voxel.npz").is_file()
pytestmark = [pytest.mark.slow,
              pytest.mark.skipif(not WHOLE, reason="no files of whole models here; name their folder by MUVO_GOLDEN")]


@pytest.mark.parametrize("kind", ["p4", "p4_backbone", "p5_step"])
def test_every_entry_of_every_file(kind):
    lines = []
    report = runner.run_folder(FOLDER, [checks for checks in registry.FILES if checks.name == kind],
                               only=[kind], write=lines.append)
    assert report.ok, "\n".join([line for line in lines if "FAIL" in line] + report.lines())


def test_a_converted_checkpoint_of_full_size_gives_the_authors_numbers(tmp_path):
    name = "1d_RV_WOB_TR_voxel"
    state_dict = {f"model.{key}": weights_rule.make_param(key, shape) for key, shape in golden.manifest(name).items()}
    torch_writer.write_zip(tmp_path / "full.ckpt", {"state_dict": torch_writer.tensors(state_dict)})
    del state_dict
    convert.convert(convert.Options(tmp_path / "full.ckpt", tmp_path / "run"), screen.Screen())
    (tmp_path / "full.ckpt").unlink()
    run = muvo_jax.load(tmp_path / "run")
    context = cases.Context(golden.File(FOLDER / "p4_full" / f"{name}.npz"), golden.Settings(FOLDER))
    checks = cases.FileChecks("converted", (rf"{name}\.npz",),
                              (lambda context: full_models.model_checks(context, run.config.model, run.variables),))
    report, lines = runner.Report(), []
    runner.run_file(checks, context, report, lines.append)
    jax.clear_caches()
    assert report.ok, "\n".join([line for line in lines if "FAIL" in line] + report.lines())
