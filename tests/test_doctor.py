"""python -m muvo_jax.doctor as a user meets it: report, pictures and exit code."""

import pathlib
import re
import sys

import numpy as np
import pytest
from PIL import Image

from muvo_jax import command_line, doctor

sys.path.append(str(pathlib.Path(__file__).parent / "data"))
import recording_samples as samples
import recording_writers as writers


def run(*arguments):
    """The exit code of python -m muvo_jax.doctor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["doctor", *map(str, arguments)])
        return doctor.main()


@pytest.fixture(autouse=True)
def no_compilation_cache(monkeypatch):
    monkeypatch.setattr(command_line, "use_compilation_cache", lambda: None)


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
