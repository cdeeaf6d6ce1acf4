"""Protocol cards: what may be called by a card's name, and what is refused."""

import dataclasses
import types

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import presets
from muvo_jax.data import schema
from muvo_jax.metrics import cards, protocol
from muvo_jax.training import validation


@pytest.fixture(scope="module")
def town():
    return cards.load("town")


def test_the_cards_of_the_package_say_how_each_of_their_scores_is_defined():
    assert cards.known() == ("authors", "kitti-4docc-1s", "town")
    for card in map(cards.load, cards.known()):
        assert card.about and card.notes and card.metrics and all(map(str.strip, card.metrics.values()))
        assert {"data.context", "data.horizon", "evaluation.seed", "evaluation.sampled"} <= card.settings.keys()
    scored = {name for head in ("image", "range_view", "occupancy") for name in head_lib.shown((head,))[head].metrics}
    asked_for = {name for name in scored if name.startswith(("scan_", "chamfer_pixels"))}
    assert cards.load("town").metrics.keys() == scored - asked_for


def test_the_towns_preset_is_judged_as_the_towns_card_says(town):
    config = presets.town()
    label = lambda config, split="val_rl", samples=town.samples["val_rl"]: cards.label(config, "plain", split, samples)
    assert label(config) == "town"
    for setting, value in (("data.horizon", 10), ("evaluation.chamfer_points", 0), ("model.image_size", [32, 128])):
        assert label(config_lib.override(config, setting, value)) == cards.NONE
    assert label(config, samples=dataclasses.replace(town.samples["val_rl"], windows=31)) == cards.NONE
    assert label(config, split="val_ds") == label(config, split="train") == cards.NONE
    assert label(config_lib.override(config, "data.path", "elsewhere")) == cards.NONE


def test_a_card_asked_for_says_when_its_samples_are_others(town):
    ours = town.samples["val_ds"]
    assert town.label("val_ds", ours) == "town"
    assert town.label("val_rl", ours) == town.label("train", ours) == "town, other samples"
    assert cards.load("authors").label("val", cards.Samples(3, "x")) == "authors"  # there is no list to differ from


def test_a_card_changes_the_settings_but_not_the_run():
    authors = cards.load("authors")
    config = config_lib.override(presets.town(), "data.horizon", 9)
    applied = authors.applied(config, {"evaluation.windows": 3})
    assert (applied.data.horizon, applied.evaluation.batch_norm) == (6, "batch")
    assert applied.evaluation.pixel_chamfer == 10_000
    assert applied.evaluation.windows == 3 and authors.applied(config, {}).evaluation.windows == 0
    assert applied.model == config.model and applied.train == config.train


def test_what_a_card_cannot_do_is_refused(town, tmp_path):
    config = presets.town()
    with pytest.raises(ValueError, match=r"card town says data.horizon=6, but 10 was chosen"):
        town.applied(config_lib.override(config, "data.horizon", 10), {"data.horizon": 10})
    with pytest.raises(ValueError, match=r"for runs with data.stride=2, but this one was trained with 1"):
        town.applied(config_lib.override(config, "data.stride", 1), {})
    kitti = cards.load("kitti-4docc-1s")
    with pytest.raises(ValueError, match=r"scores range_view, but the run's heads are image"):
        kitti.applied(config_lib.override(config, "model.heads", ["image"]), {})
    assert "is for KITTI raw, but the recording town is plain" in kitti.foreign(config, "plain")
    unmoved = config_lib.override_all(config, {"contract.kinematics": "none", "model.first_guess": "zero"})
    assert "has the motion from actions, but of the recording town it is recorded" in town.foreign(unmoved, "plain")
    with pytest.raises(ValueError, match=r"'twon' is unknown; known are authors, .* Did you mean town"):
        cards.load("twon")
    own = tmp_path / "own.toml"
    for text, message in (('protocol = "muvo_jax-1"', r"is a card of protocol muvo_jax-1; this version judges by"),
                          ("protocol =", "not TOML"), ('splitz = ["val"]', "'splitz' is unknown.*Did you mean splits"),
                          ('protocol = "VERSION"\n[settings]\n"data.horizn" = 1', "Did you mean data.horizon"),
                          ('protocol = "VERSION"\n[metrics]\npsnr = "x"', "'psnr' is unknown")):
        own.write_text(text.replace("VERSION", protocol.VERSION))
        with pytest.raises(ValueError, match=message):
            cards.load(str(own))


def test_a_card_may_lie_at_home_and_begin_with_a_byte_order_mark(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "own.toml").write_text(f'protocol = "{protocol.VERSION}"\n', encoding="utf-8-sig")
    assert cards.load("~/own.toml").protocol == protocol.VERSION


def test_scores_that_a_card_does_not_define_do_not_go_under_its_name():
    scores = {"windows": 2, "observed": {"model": {"psnr_db": 1, "chamfer_m": 2}},
              "imagined": {"model": {"chamfer_m": 3}}}
    assert cards.defined(cards.load("authors"), scores) == {
        "windows": 2, "observed": {"model": {"psnr_db": 1}}, "imagined": {"model": {}}}


def test_boxes_that_are_none_are_refused():
    for box in ((0.0,), (1.0, 1.0, 1.0, 0.0, 2.0, 2.0)):
        with pytest.raises(ValueError, match=r"scan_region_m is .* expected 3 numbers of a box's lowest corner"):
            config_lib.EvaluationConfig(scan_region_m=box)
    assert config_lib.EvaluationConfig(scan_without_m=(-1.0, -1.0, 1.0, 1.0)).scan_region_m == ()


def test_batch_statistics_are_those_of_training_without_dropout(monkeypatch):
    """And only where they are asked for."""
    seen = {}
    model = protocol.world_model.WorldModel(config_lib.override(presets.town(), "model.fusion.dropout", 0.1).model)

    def observe_window(model, variables, batch, keys, *, train, sampled):
        seen.update(train=train, sampled=sampled, dropout=model.config.fusion.dropout, keys=keys.shape)
        raise InterruptedError

    monkeypatch.setattr(protocol.rollout, "observe_window", observe_window)
    monkeypatch.setattr(protocol.rollout, "observe", lambda *_, **__: 1 / 0)
    batch = protocol.types.Batch(action=np.zeros((2, 5, 2), np.float32), is_first=np.zeros((2, 5), bool))
    predict = lambda batch_norm: protocol._predict.__wrapped__(
        model, {}, protocol.jax.random.key(0), batch, None, 2, 3, True, batch_norm)
    with pytest.raises(InterruptedError):
        predict("batch")
    assert model.config.fusion.dropout > 0
    assert seen == {"train": True, "sampled": True, "dropout": 0.0, "keys": (2,)}
    with pytest.raises(ZeroDivisionError):
        predict("running")


def test_scores_of_scans_need_scans_and_poses():
    config = config_lib.override(presets.town(), "evaluation.scan_region_m", [-1, -1, -1, 1, 1, 1])
    recording = types.SimpleNamespace(
        description=types.SimpleNamespace(name="blind", modalities={"image", "speed_mps"}))
    with pytest.raises(schema.DataError, match=r"along the rays of scans, but recording 'blind' has no points_m, pose"):
        next(validation.windows(types.SimpleNamespace(config=config, recording=recording), "val", 1))
