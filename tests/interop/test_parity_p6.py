"""The reader of the MUVO layout against what the authors' dataset class reads (skipped where there is no pack)."""

import json
import pathlib
import shutil
import sys

import numpy as np
import pytest

from muvo_jax.interop import parity_p6

sys.path.append(str(pathlib.Path(__file__).parents[1] / "data"))
import recording_samples as samples

pytestmark = pytest.mark.skipif(
    samples.MUVO_LAYOUT is None or samples.GOLDEN is None or not (samples.GOLDEN / "p6_pointers.json").is_file(),
    reason="no pack P6 with its recordings here; name them by MUVO_GOLDEN and MUVO_LAYOUT")


def test_pointers_filters_and_batches_agree():
    results = parity_p6.check(samples.GOLDEN, samples.MUVO_LAYOUT)
    assert len(results) > 60
    assert [result for result in results if not result.passed] == []


def test_what_differs_is_found(tmp_path):
    """Another pointer, another pixel and another voxel each fail their own line and no other."""
    for name in (parity_p6.POINTERS_FILE, parity_p6.ARRAYS_FILE):
        shutil.copy(samples.GOLDEN / name, tmp_path / name)
        (tmp_path / name).chmod(0o644)
    expected = json.loads((tmp_path / parity_p6.POINTERS_FILE).read_text())
    expected["splits"]["train"]["pointers"][0][1][0] += 1
    expected["batches"] = {"b0": expected["batches"]["b0"]}
    (tmp_path / parity_p6.POINTERS_FILE).write_text(json.dumps(expected))
    with np.load(tmp_path / parity_p6.ARRAYS_FILE) as arrays:
        changed = dict(arrays)
    changed["b0/voxel::crc32"] = changed["b0/voxel::crc32"] + 1
    changed["b0/steering"] = changed["b0/steering"] + np.float32(1e-3)
    np.savez(tmp_path / parity_p6.ARRAYS_FILE, **changed)
    failed = {result.name for result in parity_p6.check(tmp_path, samples.MUVO_LAYOUT) if not result.passed}
    assert failed == {"train/pointers", "b0/voxel", "b0/steering"}
