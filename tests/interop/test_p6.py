"""The reader of the MUVO layout against what the authors' dataset class reads (skipped where there is no file)."""

import json
import shutil

import numpy as np
import pytest
import recording_samples as samples

from muvo_jax.interop.parity import p6, registry, runner

pytestmark = pytest.mark.skipif(
    samples.MUVO_LAYOUT is None or samples.GOLDEN is None or not (samples.GOLDEN / p6.POINTERS_FILE).is_file(),
    reason="no file P6 with its recordings here; name them by MUVO_GOLDEN and MUVO_LAYOUT")
ARRAYS = "p6_dataset.npz"


def test_pointers_filters_and_batches_agree():
    report = runner.run_folder(samples.GOLDEN, registry.FILES, only=["p6"], recordings=samples.MUVO_LAYOUT,
                               write=lambda _: None)
    assert report.ok and report.passed > 100


def test_what_differs_is_found(tmp_path):
    """Another pointer, another voxel and another steering each fail their own line and no other."""
    for name in (p6.POINTERS_FILE, ARRAYS):
        shutil.copy(samples.GOLDEN / name, tmp_path / name)
        (tmp_path / name).chmod(0o644)
    expected = json.loads((tmp_path / p6.POINTERS_FILE).read_text())
    expected["splits"]["train"]["pointers"][0][1][0] += 1
    expected["batches"] = {"b0": expected["batches"]["b0"]}
    (tmp_path / p6.POINTERS_FILE).write_text(json.dumps(expected))
    with np.load(tmp_path / ARRAYS) as arrays:
        changed = {name: value for name, value in arrays.items() if name.startswith("b0/")}
    changed["b0/voxel::crc32"] = changed["b0/voxel::crc32"] + 1
    changed["b0/steering"] = changed["b0/steering"] + np.float32(1e-3)
    np.savez(tmp_path / ARRAYS, **changed)
    lines = []
    report = runner.run_folder(tmp_path, registry.FILES, only=["p6"], recordings=samples.MUVO_LAYOUT,
                               write=lines.append)
    bad = [line for line in lines if "FAIL" in line]
    assert report.failed == len(bad) == 3
    for name in ("train: pointers", "b0/voxel ", "b0/steering "):
        assert sum(name in line for line in bad) == 1


def test_recordings_of_another_drive_fail(tmp_path):
    """A file is not satisfied by just any recording."""
    run = "trainval/val0/Town03/0000"
    shutil.copytree(samples.MUVO_LAYOUT / run, tmp_path / run)
    report = runner.run_folder(samples.GOLDEN, registry.FILES, only=["p6"], recordings=tmp_path, write=lambda _: None)
    assert not report.ok and any("no run Town01/0000 in train" in line for line in report.stopped)
