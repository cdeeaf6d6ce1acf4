"""From a checkpoint of the authors to a run and back, without torch; what does not fit is named and leaves nothing."""

import errno
import json
import pathlib
import resource
import shutil
import time

import jax
import numpy as np
import pytest
import torch_writer

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import convert, dream, evaluate, presets, safetensors_file, train
from muvo_jax.interop import checkpoints, export_torch, names, weights_rule
from muvo_jax.interop.parity import golden
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint, screen

# The tiny preset, with two things that no checkpoint tells as they are by default.
TINY = config_lib.override_all(presets.get("tiny"), {
    "model.numerics": "reference", "model.fusion.heads": 8, "model.fusion.token_channels": 24,
    "model.image_size": (64, 128), "model.range_view": config_lib.RangeViewGeometry(rows=64, columns=64)})


def drawn_variables(config):
    shapes = world_model.WorldModel(config).variable_shapes()
    random = np.random.default_rng(0)

    def draw(path, leaf):
        value = (0.1 * random.normal(size=leaf.shape)).astype(np.float32)
        return 0.5 + np.abs(value) if path[-1].key == "var" else value  # a network that can be run

    return jax.tree_util.tree_map_with_path(draw, shapes)


def checkpoint_of(state_dict):
    """What Lightning saves, with things beside the network."""
    inner = {f"model.{key}": value for key, value in state_dict.items()}
    inner |= {"preprocess.image_mean": np.zeros((1, 3, 1, 1), np.float32),
              "model.encoder.bn1.num_batches_tracked": np.array(9),
              "model.encoder_layer.linear1.weight": np.zeros((4, 4), np.float32)}
    return {"epoch": 1, "global_step": 70, "pytorch-lightning_version": "2.0.1",
            "state_dict": torch_writer.tensors(inner),
            "hyper_parameters": torch_writer.ForeignObject("fvcore.common.config", "CfgNode", {"STEPS": 5})}


@pytest.fixture(scope="module", params=[
    {}, {"model.latent": "2d", "model.backbone": "mobilevitv2_100"},
    {"model.lidar": "pp", "model.camera": "bev", "model.fusion": "fc", "model.navigation": True,
     "model.heads": ("image", "range_view", "action", "birds_eye")}], ids=["1d", "2d-mobilevit", "fc"])
def tiny(request):
    """Configuration, variables and state_dict of a small model."""
    config = config_lib.override_all(TINY, request.param).model
    variables = drawn_variables(config)
    return config, variables, names.reference_state_dict(variables, config)


def run_convert(path, out):
    return convert.convert(convert.Options(path, out), screen.Screen())


def test_there_and_back(tiny, tmp_path):
    config, variables, state_dict = tiny
    torch_writer.write_zip(tmp_path / "a.ckpt", checkpoint_of(state_dict))
    run_convert(tmp_path / "a.ckpt", tmp_path / "runs" / "a")
    run = muvo_jax.load(tmp_path / "runs" / "a")
    for field in ("numerics", "latent", "variant", "heads", "navigation", "backbone", "image_size", "range_view"):
        assert getattr(run.config.model, field) == getattr(config, field)
    jax.tree.map(np.testing.assert_array_equal, dict(run.variables), variables)
    report = json.loads((tmp_path / "runs" / "a" / convert.REPORT_FILE).read_text())
    assert report["facts"]["global_step"] == 70 and len(report["mapped"]) == len(state_dict)
    assert report["ignored"]["preprocess.image_mean"] == "constants of the preprocessing"
    assert report["ignored"]["encoder.bn1.num_batches_tracked"] == "counter of torch's BatchNorm"
    assert not report["missing"] + report["unexpected"] + report["wrong_shape"]
    export_torch.export(export_torch.Options(tmp_path / "runs" / "a", tmp_path / "w.safetensors"), screen.Screen())
    exported = safetensors_file.load(tmp_path / "w.safetensors")
    assert exported.keys() == state_dict.keys()
    for key, value in state_dict.items():
        np.testing.assert_array_equal(exported[key], value)


def test_an_exported_run_comes_back_as_it_was_where_shapes_do_not_tell(tmp_path, capsys):
    """Sides that are odd multiples of 32, heads of attention, and what standard numerics do otherwise."""
    config = config_lib.override_all(presets.get("tiny"), {
        "model.image_size": (96, 128), "model.range_view": config_lib.RangeViewGeometry(rows=32, columns=96),
        "model.fusion.heads": 2, "model.fusion.token_channels": 16, "data.stride": 3})
    model = world_model.WorldModel(config.model)
    variables = drawn_variables(config.model)
    checkpoint.save_variables(tmp_path / "run", 12, variables, config=config)
    export_torch.export(export_torch.Options(tmp_path / "run", tmp_path / "w.safetensors"), screen.Screen())
    assert "the authors' code has no numerics=standard: it will not take these weights" in capsys.readouterr().out
    run_convert(tmp_path / "w.safetensors", tmp_path / "again")
    again = muvo_jax.load(tmp_path / "again")
    assert again.config == config and again.step == 12 and again.model == model
    jax.tree.map(np.testing.assert_array_equal, dict(again.variables), variables)


def test_a_config_of_ours_that_cannot_be_read_is_named(tiny, tmp_path):
    safetensors_file.save(tmp_path / "w.safetensors", tiny[2], {checkpoints.CONFIG: '{"model": 3}'})
    with pytest.raises(checkpoints.CheckpointMismatch, match=r"w.safetensors: its metadata 'muvo_jax.config' is no"):
        run_convert(tmp_path / "w.safetensors", tmp_path / "again")


def test_half_precision_of_the_old_format(tiny, tmp_path):
    _, variables, state_dict = tiny
    halves = {key: value.astype(np.float16) for key, value in state_dict.items()}
    torch_writer.write_legacy(tmp_path / "a.pth", torch_writer.tensors(halves))
    run_convert(tmp_path / "a.pth", tmp_path / "run")
    loaded = muvo_jax.load(tmp_path / "run").variables
    expected = jax.tree.map(lambda leaf: leaf.astype(np.float16).astype(np.float32), variables)
    jax.tree.map(np.testing.assert_array_equal, dict(loaded), expected)


@pytest.mark.parametrize("damage, message", [
    (lambda state: state.pop("rssm.prior.module.2.bias"), r"1 missing: rssm\.prior\.module\.2\.bias"),
    (lambda state: state.update({"bev.weight": np.zeros(2, np.float32)}), r"1 unexpected: bev\.weight"),
    (lambda state: state.update({"policy.fc.6.bias": np.zeros(3, np.float32)}),
     r"1 of another shape: policy\.fc\.6\.bias \[3\]"),
    (lambda state: state.pop("rssm.pre_gru_net.0.weight"), "expected a MUVO or MILE-style world model"),
    (lambda state: (state.clear(), state.update({"fc.weight": np.zeros((2, 2), np.float32)})), r"such as fc\.weight"),
])
def test_what_does_not_fit_is_named_and_leaves_no_folder(damage, message, tmp_path):
    state_dict = names.reference_state_dict(drawn_variables(TINY.model), TINY.model)
    damage(state_dict)
    torch_writer.write_zip(tmp_path / "a.ckpt", {"state_dict": torch_writer.tensors(
        {f"model.{key}": value for key, value in state_dict.items()})})
    with pytest.raises(checkpoints.CheckpointMismatch, match=rf"a\.ckpt: .*{message}"):
        run_convert(tmp_path / "a.ckpt", tmp_path / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ckpt"]


def test_a_checkpoint_without_tensors_and_an_occupied_folder(tmp_path):
    torch_writer.write_zip(tmp_path / "a.ckpt", {"epoch": 1})
    with pytest.raises(checkpoints.CheckpointMismatch, match=r"a\.ckpt: expected a checkpoint with tensors.*epoch"):
        run_convert(tmp_path / "a.ckpt", tmp_path / "run")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "diary.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="run"):
        run_convert(tmp_path / "a.ckpt", tmp_path / "run")
    assert (tmp_path / "run" / "diary.txt").read_text() == "mine"


def test_weights_that_are_not_finite_are_said(tmp_path, capsys):
    state_dict = names.reference_state_dict(drawn_variables(TINY.model), TINY.model)
    state_dict["policy.fc.6.bias"] = np.array([np.nan, 0.0], np.float32)
    torch_writer.write_zip(tmp_path / "a.ckpt", checkpoint_of(state_dict))
    run_convert(tmp_path / "a.ckpt", tmp_path / "run")
    printed = " ".join("".join(capsys.readouterr()).split())
    assert "1 of its weights hold NaN or infinity, such as policy.fc.6.bias" in printed


def test_a_full_disk_is_named_and_leaves_no_folder(tmp_path, monkeypatch):
    def full(*arguments, **settings):
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(convert.checkpoint, "save_variables", full)
    with pytest.raises(OSError, match=r"could not be written to .*new/run: RuntimeError: No space left"):
        convert._write(tmp_path / "new" / "run", 0, {}, presets.get("tiny"), {"source": "a", "recognised": None})
    assert not list(tmp_path.iterdir())
    assert convert._of_disk(OSError(errno.EDQUOT, "")) and convert._of_disk(ValueError("a: No space left on device"))
    assert not convert._of_disk(OSError(errno.EBUSY, "Device or resource busy"))


@pytest.mark.parametrize("out", [".", "..", "below/.."])
def test_the_current_folder_is_no_folder_of_a_run(tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"--out is .*, the current folder or one around it; .* --out=runs/NAME"):
        run_convert(tmp_path / "a.ckpt", pathlib.Path(out))


def test_weights_are_exported_into_a_file_that_can_be(tmp_path):
    for out, message in ((tmp_path, r"OUT: .* is a folder; name a file"),
                         (tmp_path / "none/w.safetensors", r"OUT: there is no folder .*/none for w\.safetensors")):
        with pytest.raises(ValueError, match=message):
            export_torch.export(export_torch.Options(tmp_path / "run", out), screen.Screen())


@pytest.mark.slow
@pytest.mark.usefixtures("fast_compilation")
def test_a_converted_run_is_judged_dreams_and_trains_on(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    state_dict = names.reference_state_dict(drawn_variables(TINY.model), TINY.model)
    torch_writer.write_zip(tmp_path / "a.ckpt", checkpoint_of(state_dict))
    run_convert(tmp_path / "a.ckpt", tmp_path / "run")
    judged = evaluate.evaluate(evaluate.Options(tmp_path / "run", splits=("val_rl",), windows=1, batch=1),
                               screen.Screen())
    assert "val_rl" in json.dumps(judged) and (tmp_path / "run" / "evaluation.json").exists()
    town = next((tmp_path / "cache" / "muvo_jax").glob("town-tiny-*"))
    shutil.copytree(town, tmp_path / "copied", ignore=shutil.ignore_patterns("train"))  # what is judged, and no more
    again = evaluate.evaluate(evaluate.Options(tmp_path / "run", splits=("val_rl",), windows=1, batch=1,
                                               data=str(tmp_path / "copied")), screen.Screen())
    scores = judged["splits"]["val_rl"]["imagined"], again["splits"]["val_rl"]["imagined"]
    assert json.dumps(scores[0]["model"]) == json.dumps(scores[1]["model"])  # NaN and all
    assert scores[0].keys() - scores[1].keys() == {"training_mean"}
    assert judged["splits"]["val_rl"]["action_shuffle"] == {}  # a single window has no other one's actions
    drawn = dream.dream(dream.Options(tmp_path / "run", context=2, horizon=2), screen.Screen())
    assert {path.suffix for path in drawn} == {".gif", ".png", ".html"} and all(path.stat().st_size for path in drawn)
    train.train(train.Options(preset="tiny", init=tmp_path / "run", name="more", runs_dir=tmp_path, steps=1, batch=1,
                              evaluate=False), screen.Screen())
    assert checkpoint.load_run(tmp_path / "more").config.model == checkpoint.load_run(tmp_path / "run").config.model


@pytest.mark.slow
def test_a_checkpoint_of_full_size(tmp_path):
    """About 700 MB in the released 1D model's shapes, converted and loaded; prints seconds and peak memory."""
    manifest = golden.manifest("1d_RV_WOB_TR_voxel")
    state_dict = {f"model.{key}": weights_rule.make_param(key, shape) for key, shape in manifest.items()}
    torch_writer.write_zip(tmp_path / "full.ckpt", {"state_dict": torch_writer.tensors(state_dict)})
    assert (tmp_path / "full.ckpt").stat().st_size > 700e6
    del state_dict
    start_s = time.perf_counter()
    run_convert(tmp_path / "full.ckpt", tmp_path / "run")
    print(f"{time.perf_counter() - start_s:.1f} s, "
          f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2 ** 20:.2f} GiB at most")
    variables = muvo_jax.load(tmp_path / "run").variables
    drawn = weights_rule.make_param("features_combine.weight", manifest["features_combine.weight"])
    np.testing.assert_array_equal(variables["params"]["fusion"]["combine"]["kernel"], drawn.T)
