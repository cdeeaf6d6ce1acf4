"""A config survives JSON, refuses nonsense and names what was meant."""

import dataclasses
import json

import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_json_round_trip_is_exact_and_hashable(name):
    config = presets.get(name)
    again = config_lib.Config.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert hash(again) == hash(config)
    assert config.preset == name


def test_override_changes_one_field_and_leaves_the_rest():
    config = presets.get("tiny")
    changed = config_lib.override(config, "model.dropout", 0)
    assert changed.model.dropout == 0.0
    assert isinstance(changed.model.dropout, float)
    assert dataclasses.replace(changed, model=config.model) == config


@pytest.mark.parametrize(("field", "value", "message"), [
    ("model.dropot", 0.1, "Did you mean dropout"),
    ("modle.dropout", 0.1, "Did you mean model"),
    ("model.dropout", "much", "got 'much', expected float"),
    ("train.batch", True, "got True, expected int"),
    ("model.fusion", "concat", "model.fusion: 'concat' is unknown; known are"),
    ("model.image_size", [64, 100], "must be multiples of 32"),
    ("model.transformer_heads", 7, "multiple of 4 and of model.transformer_heads 7"),
    ("model.occupancy_blocks", 9, "each side must be a multiple of 4096"),
    ("model.pillars.cells_per_m", 1.0, "model.pillars has 48 cells on a side"),
    ("model.birds_eye.lifted_bins", 99, "lifted_bins 99 lie between 1 and depth_bins"),
    ("data.stride", 0, "data.stride is 0; it must be at least 1"),
    ("train.steps", 0, "train.steps is 0; it must be at least 1"),
    ("train.parallel", "pmapp", "Did you mean pmap"),
])
def test_bad_values_are_refused_with_the_reason(field, value, message):
    town = config_lib.override_all(presets.get("town"), {
        "model.latent": "1d", "model.lidar": "pp", "model.camera": "bev"})
    with pytest.raises(ValueError, match=message):
        config_lib.override(town, field, value)


def test_a_kept_run_that_says_nothing_of_steps_goes_on_taking_the_first_action():
    kept = presets.get("town").to_dict()
    assert kept["contract"].pop("step_action") == "mean"
    assert config_lib.Config.from_dict(kept).contract.step_action == "first"
    assert config_lib.Config.from_dict({"preset": "mine"}).contract.step_action == "mean"
    assert {name: presets.get(name).contract.step_action for name in presets.PRESETS} == {
        "town": "mean", "tiny": "mean", "paper": "first", "paper-occupancy": "first", "reference-1d": "first",
        "reference-2d": "first", "reference-mobilevit": "first"}


def test_unknown_preset_names_its_neighbour():
    with pytest.raises(ValueError, match="Did you mean paper-occupancy"):
        presets.get("paper-ocupancy")


def test_paper_sizes_are_the_papers():
    config = presets.get("paper-occupancy")
    assert config.model.variant == "RV-WOB-TR"
    assert config.model.image_size == (320, 832)
    assert config.model.voxels.shape == (192, 192, 64)
    assert config.train.batch * config.optimizer.accumulate == 16
    assert (config.data.frames, config.data.context, config.data.horizon) == (6, 4, 2)
