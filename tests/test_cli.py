"""The commands as a user meets them: help, wrong options, and one clear line for an expected error."""

import contextlib
import importlib
import io
import json
import os
import pathlib
import re
import subprocess
import sys
import types

import pytest

import muvo_jax
from muvo_jax import __main__ as listing
from muvo_jax import cache, command_line, drive, evaluate, evaluation_report, presets, record_carla, train
from muvo_jax import config as config_lib
from muvo_jax.data import words
from muvo_jax.training import host, run_folder, screen

ROOT = pathlib.Path(muvo_jax.__file__).parents[1]


@pytest.fixture(autouse=True)
def no_compilation_cache(monkeypatch):
    """These tests call the commands inside this process, which must keep its settings."""
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)


def _command(*arguments, cwd=ROOT, **environment):
    variables = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), "XLA_FLAGS": "", **environment}
    return subprocess.run([sys.executable, "-m", *arguments], cwd=cwd, env=variables, capture_output=True, text=True,
                          timeout=560, check=False)


def _main(capsys, *arguments):
    code = command_line.run(train.Options, train.train, program="train", arguments=arguments)
    return code, capsys.readouterr()


def _module(command):
    inside = "interop.parity.__main__" if command == "interop.parity" else command
    return importlib.import_module(f"muvo_jax.{inside}")


@pytest.mark.parametrize("command", listing.COMMANDS)
def test_help_has_examples_and_every_option_explained(command, capsys, monkeypatch):
    monkeypatch.setattr(host, "restart_with_huge_pages", lambda: None)
    monkeypatch.setattr(sys, "argv", [command, "--help"])
    with pytest.raises(SystemExit) as ended:
        _module(command).main()
    assert ended.value.code == 0
    text = capsys.readouterr().out
    _, _, examples = text.partition("Examples:")
    assert f"python -m muvo_jax.{command} " in examples
    assert "None" not in text


@pytest.mark.parametrize("buffered", [True, False])
def test_the_reader_of_the_help_may_leave(buffered, monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    with io.TextIOWrapper(os.fdopen(write, "wb", buffering=-1), write_through=not buffered) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        with pytest.raises(SystemExit) as ended:
            command_line.run(train.Options, train.train, program="train", arguments=["--help"])
        pipe.flush()
    assert ended.value.code == 0 and capfd.readouterr().err == ""


def test_the_package_alone_lists_every_command(capsys, monkeypatch):
    package = ROOT / "muvo_jax"
    written = {".".join(path.relative_to(package).with_suffix("").parts).removesuffix(".__main__")
               for path in package.rglob("*.py") if "command_line.run(" in path.read_text(encoding="utf-8")}
    assert written == set(listing.COMMANDS)
    monkeypatch.setattr(sys, "argv", ["muvo_jax"])
    assert listing.main() == 0
    lines = capsys.readouterr().out.splitlines()
    for command in listing.COMMANDS:
        assert sum(line.startswith(f"  python -m muvo_jax.{command} ") for line in lines) == 1


def test_the_readme_lists_every_command():
    table = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## Commands\n")[2].partition("\n## ")[0]
    for command in listing.COMMANDS:
        assert re.search(rf"^\| `python -m muvo_jax\.{re.escape(command)} ", table, re.MULTILINE), command


@pytest.mark.parametrize("command", listing.COMMANDS)
def test_help_loads_nothing_that_takes_long(command):
    """What `--help` costs is what it imports. JAX reads where compiled programs are kept when it is imported: later."""
    done = _command(f"muvo_jax.{command}", "--help", PYTHONPROFILEIMPORTTIME="1")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Examples:" in done.stdout
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "tyro" in loaded
    assert not loaded & {"jax._src", "flax", "optax", "orbax", "grain", "tensorstore", "chex", "torch"}


@pytest.mark.parametrize("called", ["record_carla", "record-carla", "interop.export_torch", "export-torch"])
def test_a_command_is_called_by_its_name(called, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/muvo", called, "--help"])
    with pytest.raises(SystemExit) as ended:
        listing.main()
    name = called.replace("-", "_").removeprefix("interop.")
    assert ended.value.code == 0 and f"usage: muvo {name} " in capsys.readouterr().out


def test_only_training_starts_the_process_anew_and_only_once_the_flags_are_right(monkeypatch, capsys, tmp_path):
    restarts = []
    monkeypatch.setattr(host, "restart_with_huge_pages", lambda: restarts.append(sys.argv[1]))
    for module, option in ((train, "--help"), (train, "--batch=-1"), (train, "--prest=tiny"), (train, "--preset=towm"),
                           (evaluate, str(tmp_path))):
        monkeypatch.setattr(sys, "argv", ["muvo", option])
        with contextlib.suppress(SystemExit):
            module.main()
    assert restarts == ["--preset=towm"]


@pytest.mark.parametrize(("command", "option"), [
    ("train", "--steps=-1"), ("train", "--workers=0"), ("doctor", "--frames=-1"), ("dream", "--branches=-2"),
    ("drive", "--episodes=-1"), ("drive", "--seconds=-1"), ("record_carla", "--vehicles=-1"),
    ("pack", "--frames-per-shard=-5"), ("pack", "--workers=-1"), ("voxelize", "--workers=0"),
    ("evaluate", "--windows=-1"), ("estimate", "--memory-gib=inf"), ("drive", "--seconds=nan")])
def test_a_count_below_zero_is_a_wrong_command_line(command, option, capsys, monkeypatch):
    positional = {"pack": ["a", "b"]}.get(command, [] if command in ("train", "estimate") else ["a"])
    monkeypatch.setattr(sys, "argv", ["muvo", *positional, option])
    with pytest.raises(SystemExit) as ended:
        _module(command).main()
    flag, _, value = option.partition("=")
    assert ended.value.code == 2 and f"{flag} is {float(value):g}" in capsys.readouterr().err.replace(".0", "")


def test_without_a_home_commands_work_and_what_must_be_kept_says_where(monkeypatch):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.undo()  # of this module's fixture
    for name in ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pathlib.Path, "home", staticmethod(nowhere))
    monkeypatch.setattr(host, "use_plain_emitters", lambda: None)
    command_line.prepare_compiler()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    with pytest.raises(OSError, match="Set XDG_CACHE_HOME to a folder"):
        cache.folder()


def test_a_path_may_begin_at_home(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    given = []
    arguments = ["~/run", "--out=~/there", "--policy", "~nobody-of-that-name/agent"]
    command_line.run(drive.Options, lambda options, show: given.append(options), program="drive", arguments=arguments)
    assert (given[0].run, given[0].out) == (tmp_path / "run", tmp_path / "there")
    assert given[0].policy == pathlib.Path("~nobody-of-that-name/agent")


def test_work_goes_on_when_the_reader_of_its_lines_leaves(monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    done = []

    def work(options, show):
        for _ in range(3):
            show.line("a line")
            done.append(1)
        return len(done)

    with io.TextIOWrapper(os.fdopen(write, "wb", buffering=-1)) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        code = command_line.run(train.Options, work, program="train", arguments=[], status=lambda count: count)
    assert code == len(done) == 3 and capfd.readouterr().err == ""


def test_a_command_as_argument_is_told_how_it_is_called(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["muvo_jax", "trian"])
    assert listing.main() == 2
    assert "did you mean python -m muvo_jax.train?" in capsys.readouterr().err


def test_an_unknown_option_names_its_neighbours(capsys):
    with pytest.raises(SystemExit) as ended:
        _main(capsys, "--prest=tiny")
    assert ended.value.code == 2
    assert "unknown option --prest; did you mean --preset" in capsys.readouterr().err


@pytest.mark.parametrize(("arguments", "message"), [
    (["--preset=towm"], "preset 'towm' is unknown; known are town, tiny, paper, paper-occupancy, "
     "reference-1d, reference-2d, reference-mobilevit. Did you mean town?"),
    (["--fusion=tt"], "model.fusion: 'tt' is unknown; known are tr"),
    (["--variant=PP-FC"], "--variant=PP-FC is unknown; known are RV-WOB-TR"),
    (["--variant=PP-BEV-FC", "--set", "model.fusion=tr"], "--set model.fusion=tr contradict each other"),
    (["--variant=PP-BEV-FC", "--lidar=rv"], "--variant=PP-BEV-FC and --lidar=rv contradict each other"),
    (["--fusion=avg", "--latent=2d"], "the 2D latent is made of tokens, and only tr keeps tokens"),
    (["--occupancy", "--no-occupancy"], "contradict each other"),
    (["--set", "model.dropot=0"], "'dropot' is unknown"),
    (["--set", "model.dropout"], "expected name=value"),
    (["--set", "model.memory_frames=3"], "model.memory_frames is called model.first_guess.memory_frames now"),
    (["--set", "model.latent.aligned_tokens=true"], "is a setting of model.latent=2d (TokenLatent)"),
    (["--set", "train.steps=many"], "train.steps: got 'many', expected int"),
    (["--data=/nowhere/at/all"], "data folder /nowhere/at/all does not exist"),
    (["--name=ghost", "--resume"], "no run to go on with"),
    (["--parallel=pmpa"], "'pmpa' is unknown"),
])
def test_expected_errors_are_one_line_without_traceback(arguments, message, capsys, tmp_path):
    code, captured = _main(capsys, "--preset=tiny", f"--runs-dir={tmp_path}", *arguments)
    assert code == 1
    assert message in captured.err and "Traceback" not in captured.err
    assert not any(tmp_path.iterdir())


def test_the_traceback_is_there_for_who_asks(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv(command_line.TRACEBACK_VARIABLE, "1")
    code, captured = _main(capsys, "--data=/nowhere/at/all", f"--runs-dir={tmp_path}")
    assert code == 1 and "Traceback" in captured.err


def test_an_existing_run_is_refused_with_the_command_to_go_on(capsys, tmp_path):
    run_folder.create(tmp_path / "tiny-tr", presets.tiny(), "")
    code, captured = _main(capsys, "--preset=tiny", f"--runs-dir={tmp_path}")
    assert code == 1
    assert f"python -m muvo_jax.train --name=tiny-tr --resume --runs-dir={tmp_path}" in captured.err
    assert "--name=SOMETHING_NEW" in captured.err


def test_a_flag_beats_the_preset_and_set_reaches_everything():
    options = train.Options(preset="tiny", steps=7, frames=5, parallel="pmap",
                            set=("loss.kl=0.5", 'model.heads=["image"]'))
    config, chosen, folder = train.configure(options)
    assert (config.train.steps, config.data.frames, config.train.parallel) == (7, 5, "pmap")
    assert (config.loss.kl, config.model.heads) == (0.5, ("image",))
    assert set(chosen) == {"train.steps", "data.frames", "train.parallel", "loss.kl", "model.heads"}
    assert folder == pathlib.Path("runs/tiny-tr")


def test_set_may_be_given_again_and_again():
    given = []
    for arguments in (["--set", "a.b=1", "c=2", "--set=d=x=y", "--name", "run", "--set", "c=3"],
                      ["--name=run", "--set", "a.b=1", "c=2", "d=x=y", "c=3"]):
        command_line.run(train.Options, lambda options, _: given.append(options), program="train", arguments=arguments)
    assert given[0] == given[1] and given[0].set == ("a.b=1", "c=2", "d=x=y", "c=3")


def test_what_has_many_values_by_default_may_be_given_again_and_again():
    given = []
    command_line.run(record_carla.Options, lambda options, _: given.append(options), program="record_carla",
                     arguments=["out", "--towns", "Town01", "--towns=Town02"])
    assert given[0].towns == ("Town01", "Town02")


@pytest.mark.parametrize("name, problem", [
    ("~/x", r"got '~/x': it is a path; give --runs-dir=~/x and a name"),
    ("/tmp/x", "it is a path; give --runs-dir=/tmp/x"),
    (".", "it leads out of that folder, or to the folder itself"), ("..", "leads out"), ("a/../../b", "leads out"),
    ("a\0b", "no folder can be called so"), ("x" * 256, "no folder can be called so"),
    ("\u00e9" * 128, "up to 255 bytes")])
def test_a_name_is_one_inside_the_folder_of_runs(name, problem):
    with pytest.raises(ValueError, match=rf"--name is a name inside --runs-dir \(runs\); .*{problem}"):
        train.configure(train.Options(preset="tiny", name=name))
    assert train.configure(train.Options(preset="tiny", name="a/b"))[2] == pathlib.Path("runs/a/b")


def test_default_names_tell_runs_apart():
    names = [train.default_name(options) for options in (
        train.Options(), train.Options(preset="paper", fusion="tr"), train.Options(data="/data/kitti_raw"),
        train.Options(data="/data/kitti_raw/", preset="tiny"), train.Options(variant="PP-BEV-FC"),
        train.Options(lidar="pp", latent="2d"))]
    assert names == ["town-tr", "paper-tr", "kitti_raw-tr", "kitti_raw-tiny-tr", "town-pp-bev-fc", "town-pp-wob-tr-2d"]


def test_variant_flags_choose_encoders_fusion_latent_and_heads():
    model = train.configure(train.Options(preset="tiny", variant="pp-bev-fc", no_occupancy=True))[0].model
    assert (model.variant, model.latent.kind) == ("PP-BEV-FC", "1d")
    assert model.heads == ("image", "range_view", "action")
    model = train.configure(train.Options(preset="paper", occupancy=True, backbone="mobilevitv2_100"))[0].model
    assert (model.heads, model.backbone) == (config_lib.HEADS, "mobilevitv2_100")
    model = train.configure(train.Options(preset="tiny", heads="action,image", with_heads="range_view"))[0].model
    assert model.heads == ("image", "range_view", "action")
    for options, message in ((train.Options(heads="image,deph"), "--heads: 'deph' is unknown"),
                             (train.Options(heads=""), "--heads= names no head: expected one or more of image"),
                             (train.Options(with_heads=""), "--with-heads= names no head"),
                             (train.Options(with_heads="occupancy", no_occupancy=True), "contradict each other")):
        with pytest.raises(ValueError, match=message):
            train.configure(options)
    model = train.configure(train.Options(preset="reference-2d", fusion="avg"))[0].model
    assert (model.variant, model.latent.kind) == ("RV-WOB-AVG", "1d")


@pytest.mark.parametrize(("options", "latent"), [
    (train.Options(), "2d"), (train.Options(fusion="tr"), "2d"), (train.Options(lidar="pp"), "2d"),
    (train.Options(fusion="tr", latent="1d"), "1d"), (train.Options(fusion="fc"), "1d"),
    (train.Options(variant="PP-BEV-AVG"), "1d"), (train.Options(preset="reference-1d", fusion="tr"), "1d")])
def test_the_town_has_the_2d_latent_where_fusion_keeps_tokens(options, latent):
    assert train.configure(options)[0].model.latent.kind == latent


def test_resume_takes_the_settings_of_the_run_and_refuses_another_preset(tmp_path):
    stored = config_lib.override(presets.tiny(), "train.seed", 5)
    run_folder.create(tmp_path / "r", stored, "")
    options = train.Options(name="r", runs_dir=tmp_path, resume=True, steps=9)
    assert train.configure(options)[0] == config_lib.override(stored, "train.steps", 9)
    with pytest.raises(ValueError, match="was started with preset 'tiny', not 'paper'"):
        train.configure(train.Options(name="r", runs_dir=tmp_path, resume=True, preset="paper"))


def test_evaluating_what_is_not_a_run_is_one_clear_line(capsys, tmp_path):
    code = command_line.run(evaluate.Options, evaluate.evaluate, program="evaluate", arguments=[str(tmp_path / "none")])
    assert code == 1
    assert "does not exist; expected" in capsys.readouterr().err


def _scores(value):
    metric = {"mean": value, "interval": [0.5 * value, 2 * value], "per_step": [value, 2 * value], "frames": 4,
              "undefined": 1}
    undefined = {"mean": float("nan"), "interval": [float("nan")] * 2}
    return {"psnr_db": metric, "chamfer_m": {**metric, **undefined}}


def test_report_marks_the_best_and_says_nan(tmp_path):
    phases = {"observed": {"model": _scores(2.0), "training_mean": _scores(1.0)},
              "imagined": {"model": _scores(1.0), "copy_last": _scores(3.0), "training_mean": _scores(2.0)}}
    report = {"run": "runs/x", "variant": "RV-WOB-TR", "step": 3, "parameters": 1000, "data": {"name": "town"},
              "protocol": "p", "training_mean_frames": 9,
              "card": {"name": "authors", "about": "As theirs.", "notes": ("It misleads.",)},
              "splits": {"val_rl": {"card": "authors, other samples",
                                    "samples": {"windows": 2, "fingerprint": "0123"},
                                    "windows": 2, "drives": 2, "copy_last_unknown_voxels": 5, "movers": None,
                                    "action_shuffle": {"image": {"mean": 1.25, "interval": [float("nan")] * 2,
                                                                 "per_step": [1.0, 1.5]}}, **phases}}}
    evaluation_report.write_report(tmp_path, report)
    page = (tmp_path / "report.md").read_text()
    assert "| PSNR (dB) | **2.00** [1.00..4.00] | 1.00 [0.50..2.00] | 4 (1), 4 (1) |" in page
    assert "| PSNR (dB) | 1.00 [0.50..2.00] | **3.00** [1.50..6.00] | 2.00 [1.00..4.00] |" in page
    assert "| Chamfer (m) | nan | nan | nan |" in page
    assert "| image | 1.25 | 1.00 | 1.50 |" in page
    assert "| PSNR (dB) | copy-last | 3.00 | 6.00 |" in page
    stored = json.loads((tmp_path / "evaluation.json").read_text())
    assert stored["splits"]["val_rl"]["imagined"]["model"]["chamfer_m"]["mean"] == "nan"
    assert stored["splits"]["val_rl"]["imagined"]["model"]["psnr_db"]["interval"] == [0.5, 2.0]
    table = evaluation_report.screen_table("val_rl", "imagined", report["splits"]["val_rl"])
    assert table.row_count == 2 and table.title.endswith("2 windows of 2 drives; card authors, other samples")
    assert "(2 windows of 2 drives; card authors, other samples)" in page and "Samples 0123." in page
    assert "Card authors: As theirs." in page and "* It misleads." in page


def test_durations_read_well():
    assert [screen.duration_text(seconds) for seconds in (12.4, 200, 7500, float("nan"))] == [
        "12 s", "3 min 20 s", "2 h 5 min", "?"]


@pytest.mark.slow
def test_the_whole_job_on_the_smallest_town(tmp_path):
    run = tmp_path / "runs" / "tiny-tr"
    result = _command("muvo_jax.train", "--preset=tiny", f"--runs-dir={tmp_path}/runs",
                      XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert result.returncode == 0, result.stderr
    assert json.loads((run / "evaluation.json").read_text())["splits"].keys() == {"val_rl", "val_ds", "train"}
    assert list(run.glob("dreams/*.gif")) and list(run.glob("previews/*.png")) and (run / "curves.png").is_file()
    judged = _command("muvo_jax.evaluate", str(run), "--card=authors", "--windows=1",
                      XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert judged.returncode == 0, judged.stderr
    theirs = json.loads((run / "evaluation-authors.json").read_text())["splits"]["val_rl"]
    assert (theirs["card"], theirs["samples"]["windows"]) == ("authors", 1)
    assert theirs["imagined"]["model"].keys() >= {"psnr_db", "chamfer_pixels_m", "iou_occ_all"}
    assert "chamfer_m" not in theirs["imagined"]["model"]
    again = _command("muvo_jax.dream", str(run), "--branches=2", f"--out={tmp_path}/out",
                     XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert again.returncode == 0, again.stderr
    assert list((tmp_path / "out").glob("*.gif"))


@pytest.mark.parametrize("heads, visible", [("action,reward", False), ("image,action", True)])
def test_a_model_that_predicts_no_sensor_is_neither_drawn_nor_judged(monkeypatch, tmp_path, heads, visible):
    done = []
    monkeypatch.setattr(train.loop, "train", lambda job, show: done.append(job) or types.SimpleNamespace(stopped=False))
    monkeypatch.setattr(train, "draw_curves", lambda folder: None)
    monkeypatch.setattr(train.evaluate, "evaluate", lambda *_: done.append("judged"))
    monkeypatch.setattr(train.dream, "dream", lambda *_: done.append("drawn"))
    train.train(train.Options(preset="tiny", heads=heads, runs_dir=tmp_path), screen.Screen())
    assert (done[0].preview is not None) is visible and done[1:] == (["judged", "drawn"] if visible else [])


def test_progress_reaches_its_end(capsys):
    show = screen.Screen()
    with show.counter("packing", "frames") as progress:
        for done in range(16, 100, 16):
            progress(done, 100)
    assert capsys.readouterr().out.splitlines()[-1] == "packing: 100/100 frames"
    with pytest.raises(OSError), show.counter("packing", "frames") as progress:
        progress(50, 100)
        raise OSError
    assert capsys.readouterr().out.splitlines() == ["packing: 50/100 frames"]


def test_one_of_a_kind_is_not_many():
    assert [words.counted(number, "run") for number in (0, 1, 2)] == ["0 runs", "1 run", "2 runs"]
    assert [words.counted(number, "entry", "entries") for number in (1, 2)] == ["1 entry", "2 entries"]
