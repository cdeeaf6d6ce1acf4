"""Runs whose heads show nothing: a dream is refused by name, reports are written without what there is none of."""

import jax
import pytest

from muvo_jax import command_line, dream, evaluate, evaluation_report, presets
from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint, run_folder, screen
from muvo_jax.viz import sheets


def test_what_is_drawn_needs_a_head_that_shows_something(tmp_path, monkeypatch):
    config = config_lib.override(presets.tiny(), "model.heads", ("action", "reward"))
    variables = world_model.WorldModel(config.model).init(jax.random.key(0))
    checkpoint.save_variables(tmp_path / "run", 1, variables, config=config)
    monkeypatch.setattr(command_line, "open_data", lambda *_: pytest.fail("data was opened"))
    with pytest.raises(ValueError, match=r"run has the heads action, reward, .*a dream needs .* of image, "):
        dream.dream(dream.Options(tmp_path / "run"), screen.Screen())
    with pytest.raises(ValueError, match=r"run has the heads action, reward, .*--rerun needs .* of image, "):
        evaluate.evaluate(evaluate.Options(tmp_path / "run", rerun=tmp_path / "all.rrd"), screen.Screen())
    with pytest.raises(ValueError, match="there is nothing to draw: none of the model's heads is one of image, "):
        sheets.views_of_frames({}, 0)


def test_where_nothing_can_be_written_is_told_before_data_is_opened(tmp_path, monkeypatch):
    config = config_lib.override(presets.tiny(), "model.heads", ("image",))
    (tmp_path / "file").touch()
    shown = run_lib.Run(world_model.WorldModel(config.model), {}, config, folder=tmp_path / "file")
    monkeypatch.setattr(command_line, "load_run", lambda *_: shown)
    monkeypatch.setattr(command_line, "open_data", lambda *_: pytest.fail("data was opened"))
    with pytest.raises(OSError, match=r"RUN: nothing can be written into .*/file \(.*/file: it is a file\)"):
        evaluate.evaluate(evaluate.Options(tmp_path / "run"), screen.Screen())
    with pytest.raises(OSError, match=r"RUN: nothing can be written into .*/file/dreams \(.*/file: it is a file\)"):
        dream.dream(dream.Options(tmp_path / "run"), screen.Screen())
    with pytest.raises(OSError, match=r"--out: nothing can be written into .*/file/a/b"):
        dream.dream(dream.Options(tmp_path / "run", out=tmp_path / "file/a/b"), screen.Screen())
    run_folder.check_writable(tmp_path / "new/one", "RUN")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_report_that_cannot_be_written_is_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluation_report, "markdown", lambda report: "the page")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"could not be written to .*/file \(.*\), and stands above instead"):
        evaluate._write(tmp_path / "file", {}, "", screen.Screen())
    assert "the page" in "".join(capsys.readouterr())


def test_a_report_of_no_scores_says_so():
    nothing = {"model": {}, "copy_last": {}}
    scores = {"card": "none", "samples": {"windows": 1, "fingerprint": "0123"}, "windows": 1, "drives": 1,
              "copy_last_unknown_voxels": 0, "movers": None, "action_shuffle": {}, "observed": {"model": {}},
              "imagined": nothing}
    page = evaluation_report.markdown({
        "run": "runs/x", "variant": "RV-WOB-TR", "step": 3, "parameters": 1000, "data": {"name": "town"},
        "protocol": "p", "training_mean_frames": 9, "card": None, "splits": {"val_rl": scores}})
    assert "Nothing that the heads predict is scored." in page and "step by step" not in page


@pytest.mark.parametrize(("trained", "said"), [
    ("town", "trained and judged on town."), (None, "step 3, judged on town."),
    ("KITTI", "trained on KITTI, judged on town.")])
def test_a_report_says_what_a_model_was_trained_on(trained, said):
    page = evaluation_report.markdown({
        "run": "runs/x", "variant": "RV-WOB-TR", "step": 3, "parameters": 1000, "data": {"name": "town"},
        "trained_on": trained, "protocol": "p", "training_mean_frames": 9, "card": None, "splits": {}})
    assert said in page
