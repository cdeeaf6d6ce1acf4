"""A config survives JSON, refuses nonsense and names what was meant."""

import dataclasses
import json
import math

import pytest

from muvo_jax import config as config_lib
from muvo_jax import limits, presets


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


SETTINGS = [(section, name, whole, limit) for section in
            ("model", "loss", "optimizer", "data", "augmentation", "train", "evaluation", "contract")
            for name, limit, whole in limits.of(type(getattr(config_lib.Config(), section)))]


@pytest.mark.parametrize(("section", "name", "whole", "limit"), SETTINGS, ids=[f"{s[0]}.{s[1]}" for s in SETTINGS])
def test_no_number_of_the_settings_may_be_what_it_cannot_be(section, name, whole, limit):
    """Every number of every section: NaN, infinity, text, true, and one step beyond each end of its range."""
    config = presets.get("tiny")
    now = getattr(getattr(config, section), name)
    if now == ():
        now = (1.0,)
    like = lambda value: (value,) * len(now) if isinstance(now, tuple) else value
    wrong = [like("much"), like(True)]
    wrong += [] if whole else [like(math.nan), like(math.inf), like(-math.inf)]
    if math.isfinite(limit.lowest):
        wrong.append(like(limit.lowest if limit.open_low else limit.lowest - 1))
    if math.isfinite(limit.highest):
        wrong.append(like(limit.highest if limit.open_high else limit.highest * 2 + 1))
    for value in wrong:
        with pytest.raises(ValueError, match=f"{section}.*{name}"):
            config_lib.override(config, f"{section}.{name}", value)
    if not whole and not isinstance(now, tuple):
        with pytest.raises(limits.RangeError, match=rf"{name} is nan; it must be "):
            dataclasses.replace(getattr(config, section), **{name: math.nan})


def test_every_weight_rate_and_probability_has_a_range():
    unlimited = {name for section, name, _, limit in SETTINGS if limit == limits.FINITE}
    assert unlimited == set()


def test_geometry_says_what_is_wrong_in_its_own_words():
    with pytest.raises(ValueError, match=r"elevation_min_rad is 0.2; it must be below elevation_max_rad, 0.1"):
        config_lib.RangeViewGeometry(elevation_min_rad=0.2, elevation_max_rad=0.1)
    with pytest.raises(ValueError, match=r"VoxelGrid.voxel_size_m is 0.0; it must be above 0 and at most 1000 m"):
        config_lib.VoxelGrid(voxel_size_m=0.0)


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
