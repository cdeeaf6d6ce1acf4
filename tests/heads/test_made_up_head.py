"""One file and one line make a head: it trains, is judged, reported and drawn as those of the package are."""

import pathlib

import jax
import numpy as np
import pytest
import speed_head
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax import evaluation_report, presets, types
from muvo_jax.metrics import protocol
from muvo_jax.model import world_model
from muvo_jax.training import preparation
from muvo_jax.training import step as step_lib
from muvo_jax.viz import sheets

SETTINGS = {"model.heads": ["action", "speed"], "model.camera": "none", "model.route": False,
            "model.convolution": "xla", "train.parallel": "shard_map", "train.batch": 8}


@pytest.fixture
def config(monkeypatch):
    monkeypatch.setitem(config_lib.KNOWN_HEADS, "speed", "speed_head:HEAD")
    return config_lib.override_all(presets.tiny(), SETTINGS)


def batch_of(config):
    """Random scans of a car that drives at a speed of its own in each window."""
    shapes, random = preparation.expected_batch(config, 8), np.random.default_rng(0)
    batch = jax.tree.map(lambda leaf: random.uniform(-1, 1, leaf.shape).astype(leaf.dtype), shapes)
    speed_mps = np.broadcast_to(np.arange(8, dtype=np.float32)[:, None], shapes.speed_mps.shape).copy()
    return batch.replace(speed_mps=speed_mps, is_first=np.arange(4)[None].repeat(8, 0) == 0)


def test_it_takes_forty_lines():
    assert len(pathlib.Path(speed_head.__file__).read_text().splitlines()) <= 40


def test_a_made_up_head_trains_is_judged_and_is_drawn(config, tmp_path):
    prepared = preparation.prepare(config, preparation.expected_batch(config, 8))
    batch, before = batch_of(config), jax.tree.map(np.asarray, prepared.state.params["decoders_speed"])
    state, metrics = prepared.step(prepared.state, batch)
    metrics = {name: float(value) for name, value in metrics.items()}
    assert metrics["total"] == pytest.approx(
        0.5 * metrics["speed"] + config.loss.action * metrics["action"] + config.loss.kl * metrics["kl"], rel=1e-5)
    moved = jax.tree.map(lambda old, new: np.abs(old - np.asarray(new)).max(), before, state.params["decoders_speed"])
    assert all(change > 0 for change in jax.tree.leaves(moved))

    model, variables = world_model.WorldModel(config.model), jax.device_get(state.variables)
    drives = tuple("abcdefgh")
    report = protocol.evaluate(model, variables, [protocol.Windows(batch, drives, batch.action[::-1].copy())], config)
    frames = protocol.predict(model, variables, jax.random.key(0), batch, context=2, horizon=2, sampled=False)
    score = report["observed"]["model"]["speed_error_mps"]
    assert score["frames"] == 16 and score["mean"] == pytest.approx(
        np.abs(frames["speed"][:, :2] - batch.speed_mps[:, :2]).mean(), rel=1e-3)
    assert report["action_shuffle"]["speed"]["mean"] > 0
    assert "speed_error_mps" not in report["imagined"]["copy_last"]
    table = evaluation_report.screen_table("val", "imagined", report)
    assert next(iter(table.columns[0].cells)) == "speed error (m/s)"

    views = [sheets.views_of_batch(batch, 7), sheets.views_of_frames(frames, 7)]
    sensors, *_ = sheets.write_dream(tmp_path, views[0], {"world model": views[1]}, batch.action[7],
                                     sheets.Scene.of(config), context=2, title="t", animate=False)
    assert (np.asarray(Image.open(sensors)) == (0, 200, 255)).all(axis=-1).any()


def test_what_it_learns_from_must_be_there(config):
    model = world_model.WorldModel(config.model)
    blind = batch_of(config).replace(speed_mps=None)
    forward = lambda: step_lib.total.losses(
        types.Predictions({"action": {1: blind.action}, "speed": {1: blind.action[..., :1]}}), blind,
        types.Observed(None, *(types.Gaussian(blind.action, 1 + 0 * blind.action),) * 2), model=model.config,
        loss=config.loss, keys=jax.random.split(jax.random.key(0), 8))
    with pytest.raises(ValueError, match=r"the model has the head 'speed', but the batch has no speed_mps"):
        forward()
