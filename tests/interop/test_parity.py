"""The parity check: its rule, its reader, what it accepts and refuses, and the files that lie in tests/golden."""

import dataclasses
import json
import pathlib
import re
import subprocess
import sys
import zlib

import golden_rule
import numpy as np
import pytest

import muvo_jax
from muvo_jax.interop import reference_data, weights_rule
from muvo_jax.interop.parity import cases, geometry, golden, losses, modules_1d, modules_2d, pooling, registry, runner

SILENT = lambda line: None
# Only the losses that the made-up files hold: the others would be computed for nothing.
SMALL = (dataclasses.replace(registry.FILES[0], groups=(losses.divergence, losses.regressions, losses.spatial)),)
# CRC-32 of arrays that the rule must give on every machine.
WEIGHTS = {("rssm.prior.module.0.weight", (64, 64)): 107853824, ("a.bn1.weight", (16,)): 2935760857,
           ("a.bn1.bias", (16,)): 3539044924, ("a.bn1.running_var", (16,)): 2782270229,
           ("rgb_decoder.trans_conv1.0.weight", (8, 4, 6, 6)): 452346914, ("type_embedding", (1, 1, 8, 2)): 3970937600}
INPUTS = {("normal", (5, 7)): 2250587215, ("smooth", (2, 20, 30)): 1229600280, ("image_u8", (3, 20, 30)): 3182604029,
          ("route_u8", (3, 16, 16)): 2135944411, ("range_view", (4, 8, 32)): 2890411049,
          ("voxel2", (16, 16, 8)): 1804015266, ("voxel9_ign", (16, 16, 8)): 510834341,
          ("labels8", (12, 12)): 475118475, ("cloud", (200,)): 1815993543, ("depth_m", (20, 30)): 770451330,
          ("mask", (12, 12)): 39174248, ("sigma", (4,)): 878203011}


def checksum(array):
    return zlib.crc32(np.ascontiguousarray(array).tobytes())


def test_nothing_loads_the_harness_but_its_own_command():
    package = pathlib.Path(muvo_jax.__file__).parent
    for path in sorted(set(package.rglob("*.py")) - set((package / "interop" / "parity").rglob("*.py"))):
        imports = [line for line in path.read_text().splitlines() if re.match(r"\s*(from|import) ", line)]
        assert not [line for line in imports if re.search(r"interop\.parity|interop import .*\bparity\b", line)], path
    program = ("import sys, muvo_jax, muvo_jax.convert, muvo_jax.interop.export_torch; muvo_jax.imagine; "
               "print([name for name in sys.modules if name.startswith('muvo_jax.interop.parity')])")
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "[]"


def test_the_rule_draws_the_same_numbers_everywhere():
    assert {case: checksum(weights_rule.make_param(*case)) for case in WEIGHTS} == WEIGHTS
    assert {case: checksum(weights_rule.make_input("selftest", case[1], case[0], 3)) for case in INPUTS} == INPUTS


def test_rule_refuses_what_it_does_not_draw():
    with pytest.raises(ValueError, match="computed by the model"):
        weights_rule.make_param("frustum_pooling.bev_intrinsics", (3, 3))
    with pytest.raises(ValueError, match="kind 'blue'"):
        weights_rule.make_input("x", (3,), "blue")


def test_error_of_a_subsampled_entry_sees_what_was_not_stored(tmp_path):
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.savez(tmp_path / "p.npz", **{
        "whole": values, "part::sub": values.reshape(-1)[::5], "part::meta": np.array([5, 3, 4]),
        "part::stats": np.array([values.mean(), values.std(), 0, 11, np.sqrt((values ** 2).sum())])})
    file = golden.File(tmp_path / "p.npz")
    assert file.names == ["part", "whole"] and file.shape("part") == (3, 4)
    assert file.error("whole", values + 1.1) == pytest.approx(0.1)
    assert file.error("part", values) < 1e-6
    unseen = values.copy()
    unseen[2, 3] = 0.0  # flat index 11, which the stride of 5 skips
    assert file.error("part", unseen) > 0.05
    with pytest.raises(ValueError, match=r"got shape \[4, 3\], expected \[3, 4\]"):
        file.error("whole", values.T)


def write_folder(folder, entries, **settings):
    """A folder of files as the command takes it."""
    (folder / "pack.json").write_text(json.dumps({"format": 1, **settings}))
    np.savez(folder / "p1_losses_metrics.npz", **entries)
    return folder


def other_pack():
    """Entries of other seed and sizes, from float64 NumPy: means of absolute and squared errors, KL's value."""
    draw = lambda *case: weights_rule.make_input(*case, 5).astype(np.float64)
    error = draw("act_pred", (3, 4, 1), "pm1") - draw("act_tgt", (3, 4, 1), "pm1")
    plane = draw("sp_pred", (2, 2, 3, 10, 14), "normal") - draw("sp_tgt", (2, 2, 3, 10, 14), "normal")
    mask = weights_rule.make_input("sp_imask", (2, 2, 1, 10, 14), "mask", 5)
    shape = (1, 5, 6)
    moments = {f"{side}_{moment}": draw(f"kl_1d_{side}_{moment}", shape, kind) for side in ("prior", "posterior")
               for moment, kind in (("mu", "normal"), ("sigma", "sigma"))}
    prior_mean = np.concatenate([np.zeros((1, 1, 6)), moments["prior_mu"][:, 1:]], 1)
    prior_std = np.concatenate([np.ones((1, 1, 6)), moments["prior_sigma"][:, 1:]], 1)
    std = moments["posterior_sigma"][:, [1, 1, 2, 3, 4]]
    divergence = (np.log(prior_std / std) - 0.5
                  + (std ** 2 + (moments["posterior_mu"] - prior_mean) ** 2) / (2 * prior_std ** 2))
    return {"regression_l1/loss": np.abs(error).sum(-1).mean(), "regression_l1/grad": np.sign(error) / 12,
            "regression_l2/grad": 2 * error / 12, "spatial_l1/loss": np.abs(plane).sum(2).mean(),
            "spatial_l2_imask/loss": (plane ** 2 * mask).sum() / mask.sum(),
            "kl0.75_1d/loss": divergence.sum(-1).mean()}


def test_kinds_another_seed_and_other_sizes(tmp_path):
    sizes = {"p1": {"regression": [3, 4, 1], "spatial_hw": [10, 14], "kl_1d": [1, 5, 6]}}
    entries = other_pack()
    report = runner.run_folder(write_folder(tmp_path, entries, seed=5, **sizes), SMALL, only=["p1"],
                               write=SILENT)
    assert (report.passed, report.failed, report.unexplained) == (len(entries), 0, []) and report.ok


def test_a_wrong_number_and_an_unknown_entry_fail(tmp_path):
    entries = {"regression_l1/loss": np.float32(0.3), "hyperbolic/loss": np.float32(0.0)}
    lines = []
    report = runner.run_folder(write_folder(tmp_path, entries, seed=0), SMALL, write=lines.append)
    assert report.failed == 1 and not report.ok and "FAIL" in lines[0]
    assert report.unexplained == ["p1_losses_metrics hyperbolic/loss"]
    assert any("hyperbolic/loss" in line for line in report.lines())


def test_what_stops_fails_and_hides_nothing_else(tmp_path):
    """A group that raises, a measure that raises, a file that is cut off: each fails, the others are checked."""
    def stops(context):
        yield cases.Check("early", np.float32(1.0), 1e-6)
        raise MemoryError("no room for late")

    def unmeasurable(file, entry, got):
        raise IndexError("no such pixel")

    groups = (stops, lambda context: (cases.Check("odd", np.float32(1.0), 1e-6, unmeasurable),
                                      cases.Check("last", np.float32(1.0), 1e-6)))
    entries = {name: np.float32(1.0) for name in ("early", "late", "odd", "last", "told")}
    np.savez(write_folder(tmp_path, entries) / "broken.npz", x=np.zeros(9))
    (tmp_path / "broken.npz").write_bytes((tmp_path / "broken.npz").read_bytes()[:90])
    kinds = [cases.FileChecks("broken", (r"broken\.npz",), groups),
                cases.FileChecks("p1", (r"p1_.*",), groups, {"told": "for information only"})]
    lines = []
    report = runner.run_folder(tmp_path, kinds, write=lines.append)
    assert (report.passed, report.failed, report.left_out.total(), report.unexplained) == (2, 3, 1, [])
    assert not report.ok
    failed = {line.split()[1]: line for line in lines if "FAIL" in line}
    assert "stops stopped with MemoryError: no room for late" in failed["late"]
    assert "IndexError: no such pixel" in failed["odd"] and any("broken.npz: expected an npz file" in line
                                                                for line in report.lines())


def test_what_cannot_be_checked_is_said(tmp_path):
    with pytest.raises(golden.GoldenError, match="found none"):
        runner.run_folder(tmp_path, registry.FILES, write=SILENT)
    np.savez(tmp_path / "p1_losses_metrics.npz", x=np.zeros(2))
    with pytest.raises(golden.GoldenError, match=r"pack\.json: expected the JSON description"):
        runner.run_folder(tmp_path, registry.FILES, write=SILENT)
    write_folder(tmp_path, {"x": np.array([object()])}, seed=0)
    objects = runner.run_folder(tmp_path, registry.FILES, write=SILENT)
    assert "p1_losses_metrics.npz: expected an npz file of plain arrays" in objects.stopped[0] and objects.failed == 1
    (tmp_path / "pack.json").write_text(json.dumps({"format": 9}))
    with pytest.raises(golden.GoldenError, match="expected format 1, found 9"):
        runner.run_folder(tmp_path, registry.FILES, write=SILENT)
    with pytest.raises(ValueError, match="--only=q1"):
        runner.run_folder(tmp_path, registry.FILES, only=["q1"], write=SILENT)


def test_recordings_are_asked_for(tmp_path):
    np.savez(tmp_path / "p6_dataset.npz", x=np.zeros(2))
    report = runner.run_folder(tmp_path, registry.FILES, write=SILENT)  # needs no pack.json
    assert not report.unexplained and runner.RECORDINGS_REASON in next(iter(report.left_out))


def checked(name, file, groups):
    """The report of some groups of a file in tests/golden; what other groups check counts as unexplained."""
    checks = next(checks for checks in registry.FILES if checks.name == name)
    report, lines = runner.Report(), []
    context = cases.Context(golden.File(golden_rule.FOLDER / file), golden.Settings(golden_rule.FOLDER))
    runner.run_file(dataclasses.replace(checks, groups=groups), context, report, lines.append)
    assert not report.failed, "\n".join(lines)
    return report


def test_losses():
    groups = (losses.divergence, losses.spatial, losses.scene_class_affinity, losses.structural_similarity,
              losses.chamfer_metrics, losses.class_scores)
    assert checked("p1", "p1_losses_metrics.npz", groups).passed > 60


def test_geometry():
    groups = tuple(group for group in geometry.GROUPS if group not in pooling.GROUPS)
    assert checked("p2", "p2_geometry.npz", groups).passed == 105


@pytest.mark.slow
def test_pooling_into_cells_of_the_ground():
    assert checked("p2", "p2_geometry.npz", pooling.GROUPS).passed == 20


def test_a_target_lies_north_of_a_car_that_heads_north_or_east():
    ahead = reference_data.gps_vector(np.array([0.0, 8.0]), np.array([1e-4, 8.0]), np.nan)
    np.testing.assert_allclose(ahead, [11.1319, 0.0], atol=1e-3)  # a degree is 111,319 m at the equator
    to_the_left = reference_data.gps_vector(np.array([0.0, 8.0]), np.array([1e-4, 8.0]), np.pi / 2)
    np.testing.assert_allclose(to_the_left, [0.0, -11.1319], atol=1e-3)


def test_modules_of_the_1d_model():
    groups = (modules_1d.compression, modules_1d.recurrent)
    assert checked("p3_1d", "p3_modules_1d.npz", groups).passed == 30


def test_modules_of_the_2d_model():
    assert checked("p3_2d", "p3_modules_2d.npz", (modules_2d.recurrent_units, modules_2d.backbone)).passed == 5


def test_a_kink_is_compared_on_both_of_its_sides(tmp_path):
    """relu'(0) is 0 or 1, as rounding has it; 0.5 is neither."""
    np.savez(tmp_path / "p.npz", slope=np.float32(1.0), level=np.float32(0.5))
    sides = lambda: iter([np.float32(0.0), np.float32(1.0)])
    group = lambda context: (cases.Check(entry, np.float32(0.0), 1e-3, again=sides) for entry in ("slope", "level"))
    report, lines = runner.Report(), []
    runner.run_file(cases.FileChecks("p", ("p",), (group,)),
                    cases.Context(golden.File(tmp_path / "p.npz"), golden.Settings()), report, lines.append)
    assert (report.passed, report.failed) == (1, 1)
    assert "1.0e+00 as first rounded, this in try 2" in lines[0] and "FAIL" in lines[1]


@pytest.mark.slow
@pytest.mark.parametrize("name, file, entries", [
    ("p1", "p1_losses_metrics.npz", 142), ("p3_1d", "p3_modules_1d.npz", 61), ("p3_2d", "p3_modules_2d.npz", 82),
    ("p5_losses", "p5_losses_all_1d.npz", 42), ("p5_losses", "p5_losses_all_2d.npz", 39)])
def test_whole_packs(name, file, entries):
    checks = next(checks for checks in registry.FILES if checks.name == name)
    assert checked(name, file, checks.groups).passed == entries
