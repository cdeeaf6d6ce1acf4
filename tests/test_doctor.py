"""python -m muvo_jax.doctor as a user meets it: report, pictures and exit code."""

import re
import shutil
import sys

import numpy as np
import pytest
import recording_samples as samples
import recording_writers as writers
from PIL import Image

from muvo_jax import command_line, doctor


def run(*arguments):
    """The exit code of python -m muvo_jax.doctor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["doctor", *map(str, arguments)])
        return doctor.main()


@pytest.fixture(autouse=True)
def no_compilation_cache(monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)


def test_problems_are_reported_with_pictures_and_exit_code(tmp_path, capsys):
    root = writers.write_plain(tmp_path / "mes données")
    (root / "train/a/image/000004.png").write_bytes(b"")
    (root / "train/b/lidar/000002.npz").unlink()
    assert run(root, f"--out={tmp_path / 'out'}") == 1
    captured = capsys.readouterr()
    assert re.search(r"^\d+ problems found in .*report.md", captured.out, re.MULTILINE) and captured.err == ""
    report = (tmp_path / "out/report.md").read_text()
    assert "000004.png" in report and "1 of 6 frames are left out" in report and "| camera | 64x32 pixels" in report
    for name in [*sorted(path.name for path in (tmp_path / "out").glob("overlay_*.png")), "actions.png"]:
        assert f"({name})" in report
        assert np.asarray(Image.open(tmp_path / "out" / name)).std() > 1


def test_times_out_of_order_are_named_by_file_and_line(tmp_path, capsys):
    table = writers.write_plain(tmp_path / "plain") / "train/a/frames.csv"
    header, first, second, *rest = table.read_text().splitlines()
    table.write_text("\n".join([header, second, first, *rest]) + "\n")
    stamps = writers.write_kitti(tmp_path / "kitti") / "image_02/timestamps.txt"
    lines = stamps.read_text().splitlines()
    stamps.write_text("\n".join([*lines[:4], lines[5], lines[4], *lines[6:]]) + "\n")
    for name, kind, text in (("plain", "plain", f"{table}, line 3: time 0.000 s does not come after"),
                             ("kitti", "KITTI raw", f"{stamps}, line 6: time ")):
        assert run(tmp_path / name, f"--out={tmp_path / 'out' / name}") == 1
        captured = capsys.readouterr()
        assert "problem: " in captured.out and "1 problem found" in captured.out and captured.err == ""
        report = (tmp_path / "out" / name / "report.md").read_text()
        assert f"| recording | {name} ({kind}) |" in report
        assert text in report.partition("# What should be mended")[2].partition("# What should be known")[0]


def test_kitti_is_looked_at_too(tmp_path, capsys):
    drive = writers.write_kitti(tmp_path)
    run(drive, f"--out={tmp_path / 'out'}")
    assert "KITTI raw" in capsys.readouterr().out and (tmp_path / "out/report.md").is_file()


@pytest.mark.skipif(samples.MUVO_LAYOUT is None, reason="no recording in the MUVO layout here")
def test_the_authors_layout_has_no_problem(tmp_path, capsys):
    assert run(samples.MUVO_LAYOUT, f"--out={tmp_path}") == 0
    assert "no problem found" in capsys.readouterr().out


def test_what_is_no_recording_is_one_line(tmp_path, capsys):
    (tmp_path / "x.txt").write_text("")
    assert run(tmp_path, f"--out={tmp_path / 'out'}") == 2
    assert "is of no known kind" in capsys.readouterr().err and not (tmp_path / "out").exists()


def problems_of(folder, *arguments):
    """Exit code and the problems of the report."""
    code = run(folder, f"--out={folder / 'out'}", *arguments)
    report = (folder / "out/report.md").read_text()
    return code, report.partition("# What should be mended")[2].partition("# What should be known")[0]


@pytest.mark.parametrize("folder", ["image", "lidar"])
def test_a_sensor_that_is_described_but_not_there_is_a_remark(folder, tmp_path, capsys):
    root = writers.write_plain(tmp_path / "one")
    for run_folder in root.glob("*/*"):
        shutil.rmtree(run_folder / folder)
    run(root, f"--out={tmp_path / 'out'}")
    captured = capsys.readouterr()
    assert f"remark: a {'camera' if folder == 'image' else 'lidar'} is described, but no frame has" in captured.out
    assert captured.err == ""


def test_one_missing_scan_of_kitti_is_a_gap_and_many_are_a_fault(tmp_path):
    drive = writers.write_kitti(tmp_path, frames=24)
    (drive / "velodyne_points/data/0000000005.bin").unlink()
    _, found = problems_of(drive)
    assert "left out" not in found and "1 of 24 frames are left out" in (drive / "out/report.md").read_text()
    for number in (3, 7, 9, 11):
        (drive / f"velodyne_points/data/{number:010d}.bin").unlink()
    code, found = problems_of(drive)
    assert code == 1 and "5 of 24 frames are left out" in found


def test_labels_are_opened(tmp_path):
    root = writers.write_plain(tmp_path / "labels")
    for run_folder in root.glob("*/*"):
        (run_folder / "depth").mkdir()
        for image in (run_folder / "image").iterdir():
            Image.fromarray(np.full((32, 64), 500, np.uint16)).save(run_folder / "depth" / image.name)
    assert "depth" not in problems_of(root)[1]
    (root / "train/a/depth/000003.png").write_bytes(b"no image")
    code, found = problems_of(root)
    assert code == 1 and "1 of 24 frames cannot be read" in found and "depth/000003.png" in found


def test_values_that_a_label_cannot_have_are_found(tmp_path):
    root = writers.write_plain(tmp_path / "values")
    np.savez(root / "train/a/occupancy/000002.npz", occupancy=np.full((16, 16, 16), 7, np.uint8))
    code, found = problems_of(root)
    assert code == 1 and "occupancy" in found and "7" in found


def test_what_training_would_refuse_is_refused_here(tmp_path, capsys):
    root = writers.write_plain(tmp_path / "short", {"train/a": 10, "val_rl/c": 3})
    code, found = problems_of(root)
    assert code == 1 and "muvo_jax.train --data refuses it" in found and "split 'val_rl' has 3 frames" in found
    other = writers.write_plain(tmp_path / "grid", **{"shape": "[12, 12, 12]"})
    for path in other.glob("*/*/occupancy/*.npz"):
        np.savez(path, occupancy=np.full((12, 12, 12), 255, np.uint8))
    assert "does not suit the voxel decoder" in problems_of(other)[1]


def test_reports_go_where_the_user_says_whatever_the_recording_calls_itself(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(writers.write_plain(tmp_path / "mine", name='"../../elsewhere"'))
    assert (tmp_path / "doctor/mine/report.md").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["doctor", "mine"]


def test_every_frame_is_read_side_by_side(tmp_path, capsys):
    root = writers.write_plain(tmp_path / "long", {"train/a": 200, "val_rl/b": 70})
    (root / "train/a/lidar/000199.npz").write_bytes(b"")
    for workers in (1, 3):
        assert "000199.npz" in problems_of(root, "--frames=0", f"--workers={workers}")[1]
        lines = capsys.readouterr().out.splitlines()
        assert any(line.endswith("269 of 270 frames looked at") for line in lines)
        assert "looking at: 270/270 frames" in lines


@pytest.mark.parametrize("path", ["nowhere", "town", "file.zip"])
def test_what_cannot_be_looked_at_ends_with_two(path, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.zip").write_bytes(b"PK")
    assert run(path) == 2
    said = capsys.readouterr().err
    assert {"nowhere": "does not exist", "town": "muvo_jax.train --data=town", "file.zip": "unpack it"}[path] in said
    assert not (tmp_path / "doctor").exists()
