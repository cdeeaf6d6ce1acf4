"""A config survives JSON, refuses nonsense and names what was meant."""

import dataclasses
import json
import math
import pathlib

import pytest

from muvo_jax import config as config_lib
from muvo_jax import limits, presets
from muvo_jax.config import migration, parts, sizes

KEPT = pathlib.Path(__file__).parent / "kept_runs"  # config.json of version 1, in version_2 of that


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_json_round_trip_is_exact_and_hashable(name):
    config = presets.get(name)
    again = config_lib.Config.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert hash(again) == hash(config)
    assert config.preset == name


def test_override_changes_one_field_and_leaves_the_rest():
    config = presets.get("tiny")
    changed = config_lib.override(config, "model.fusion.dropout", 0)
    assert changed.model.fusion.dropout == 0.0
    assert isinstance(changed.model.fusion.dropout, float)
    assert dataclasses.replace(changed.model, fusion=config.model.fusion) == config.model
    assert dataclasses.replace(changed, model=config.model) == config


def test_a_part_is_chosen_by_its_kind_and_has_the_size_of_the_preset():
    tiny = presets.get("tiny")
    chosen = config_lib.override_all(tiny, {
        "model.latent.transition_layers": 2, "model.latent": "2d", "model.lidar": "pp", "model.camera": None})
    assert chosen.model.latent == config_lib.TokenLatent(transition_layers=2, occupancy_token_stages=0)
    assert chosen.model.lidar == sizes.of("tiny", config_lib.PillarLidar) != config_lib.PillarLidar()
    assert chosen.model.camera is None and chosen.model.variant == "PP-NONE-TR"
    wider = config_lib.override(tiny, "model.latent.deterministic_channels", 24)
    assert config_lib.override(wider, "model.latent", "1d") == wider  # the kind it has already
    mine = config_lib.TrainingMean()
    assert config_lib.override(tiny, "model.first_guess", mine).model.first_guess == mine


@pytest.mark.parametrize(("field", "value", "message"), [
    ("model.dropot", 0.1, "Did you mean model.fusion.dropout"),
    ("modle.dropout", 0.1, "Did you mean model.fusion.dropout"),
    ("data.frmes", 3, r"'frmes' is unknown; known are path, .*Did you mean data.frames"),
    ("model.latent.determnistic_channels", 3, "Did you mean model.latent.deterministic_channels"),
    ("model.image_size.rows", 32, "model.image_size has no settings of its own"),
    ("model.fusion.dropout", "much", "got 'much', expected float"),
    ("model.dropout", 0.0, r"model\.dropout is called model\.fusion\.dropout now"),
    ("model.pillars.points", 99, r"model\.pillars\.points is called model\.lidar\.grid\.points now"),
    ("model.latent.transition_layers", 2,
     r"is a setting of model.latent=2d \(TokenLatent\), and model.latent is 1d: .*choose model.latent=2d"),
    ("model.first_guess.memory_frames", 0, "model.first_guess.memory_frames is 0; it must be at least 1"),
    ("model.fusion.map_channels", 8, "is a setting of model.fusion=fc or avg"),
    ("model.latent", {"kind": "2d"}, "known are 1d, 2d"),
    ("train.batch", True, "got True, expected int"),
    ("model.fusion", "concat", "model.fusion: 'concat' is unknown; known are tr, fc, avg"),
    ("model.camera", "bew", "'bew' is unknown; known are wob, bev, none. Did you mean bev"),
    ("model.image_size", [64, 100], "must be multiples of 32"),
    ("model.fusion.heads", 7, "model.fusion.token_channels is 96; it must be a multiple of 4 and of heads, 7"),
    ("model.latent.occupancy_blocks", 9, "each side must be a multiple of 4096"),
    ("model.lidar.grid.cells_per_m", 1.0, "model.lidar.grid has 48 cells on a side"),
    ("model.lidar.grid.half_side_m", 24.2, r"model.lidar.grid.cells_per_m is 2: with half_side_m 24.2 a side has 96.8"),
    ("model.camera.grid.lifted_bins", 99, "lifted_bins 99 lie between 1 and depth_bins"),
    ("data.stride", 0, "data.stride is 0; it must be at least 1"),
    ("train.steps", 0, "train.steps is 0; it must be at least 1"),
    ("train.parallel", "pmapp", "Did you mean pmap"),
])
def test_bad_values_are_refused_with_the_reason(field, value, message):
    town = config_lib.override_all(presets.get("town"), {
        "model.latent": "1d", "model.lidar": "pp", "model.camera": "bev"})
    with pytest.raises(ValueError, match=message):
        config_lib.override(town, field, value)


@pytest.mark.parametrize(("changes", "message"), [
    ({"model.decoder_channels": 7},
     "model.decoder_channels is 7; it must be at least 8 with the heads image, range_view"),
    ({"model.occupancy_channels": 4}, "model.occupancy_channels is 4; it must be at least 8 with the head occupancy"),
    ({"model.measurement_channels": 1, "model.navigation": True},
     "model.measurement_channels is 1; it must be at least 2 with navigation"),
    ({"model.backbone": "mobilevitv2_100", "model.backbone_width": 1},
     "model.backbone_width is 1; it must be at least 2 with backbone mobilevitv2_100"),
    ({"model.first_guess": config_lib.LastSeen(2, (8, 1, 8))},
     r"model.first_guess.guided_channels is \(8, 1, 8\); it must be at least 2 for each of the heads range_view"),
])
def test_widths_that_leave_no_channel_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        config_lib.override_all(presets.get("tiny"), changes)


def test_widths_that_nothing_divides_may_be_one():
    narrow = {"model.decoder_channels": 1, "model.occupancy_channels": 1, "model.measurement_channels": 1,
              "model.backbone_width": 1}
    for name, value in (("heads", ("action",)), ("first_guess", config_lib.LastSeen(2, (2, 2, 2)))):
        config = config_lib.override_all(presets.get("tiny"), narrow | {f"model.{name}": value})
        assert (getattr(config.model, name), config.model.decoder_channels) == (value, 1)


def test_settings_of_a_sensor_that_the_model_does_not_see_are_refused():
    blind = config_lib.override(presets.get("tiny"), "model.camera", "none")
    with pytest.raises(ValueError, match=r"model.camera.grid is a setting of model.camera=bev .*model.camera is none"):
        config_lib.override(blind, "model.camera.grid.cells", 8)
    with pytest.raises(ValueError, match="both none"):
        config_lib.override(blind, "model.lidar", "none")


@pytest.mark.parametrize("name", sorted(path.stem for path in KEPT.glob("*.json")))
def test_runs_of_version_1_load_as_todays_presets(name):
    """What earlier versions wrote: a flat model, in which settings of parts that are not there did nothing. What the
    preset has got since is off in them."""
    stored = json.loads((KEPT / f"{name}.json").read_text())
    assert migration.VERSION_FIELD not in stored
    config = config_lib.Config.from_dict(stored)
    assert config_lib.Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    town = presets.get("town")
    town = dataclasses.replace(town, model=dataclasses.replace(town.model, first_guess=config_lib.LastSeen(),
                                                               occupied_above=0.5))
    if name == "kitti_raw-tr":  # fitted to that recording
        assert config.data.path.endswith("kitti_raw") and config.contract.source == "derived"
        config = dataclasses.replace(config, data=town.data, contract=town.contract, train=town.train,
                                     model=dataclasses.replace(config.model, route=True,
                                                               range_view=town.model.range_view))
    expected = {"town-tr": town, "kitti_raw-tr": town, "tiny-tr": presets.get("tiny"),
                "town-pp-none-fc": config_lib.override_all(town, {
                    "model.lidar": "pp", "model.camera": "none", "model.fusion": "fc", "model.latent": "1d"})}
    assert config == expected[name]


def test_version_1_from_before_it_had_all_of_its_fields_and_what_never_was():
    stored = json.loads((KEPT / "tiny-tr.json").read_text())
    for field in ("first_guess", "memory_frames", "guided_channels", "action_path", "kinematics", "many_tokens"):
        del stored["model"][field]
    del stored["train"]["restart"], stored["contract"]["step_action"]
    tiny = presets.get("tiny")
    old = config_lib.Config.from_dict(stored)
    assert old.model.first_guess == tiny.model.first_guess and old.model.fusion == tiny.model.fusion
    assert (old.contract.step_action, tiny.contract.step_action) == ("first", "mean")
    with pytest.raises(ValueError, match=r"config\.model\.fusion: 'concat' is unknown; known are tr, fc, avg"):
        config_lib.Config.from_dict({"model": {"fusion": "concat"}})
    with pytest.raises(ValueError, match=r"\(ModelConfig\): 'colour' is unknown"):
        config_lib.Config.from_dict({"model": {"colour": 3}})
    with pytest.raises(ValueError, match="config_version is 4, and this version of muvo_jax reads 1 to 3"):
        config_lib.Config.from_dict(tiny.to_dict() | {"config_version": 4})
    with pytest.raises(ValueError, match=r'config.model.latent: got \{\}, expected \{"kind": \.\.\.\} of 1d, 2d'):
        config_lib.Config.from_dict({"config_version": 2, "model": {"latent": {}}})


@pytest.mark.parametrize(("before", "today"), [(False, "none"), (True, "frames")])
def test_runs_of_version_2_keep_what_they_compute_again(before, today):
    stored = json.loads((KEPT / "version_2/town-tr.json").read_text())
    assert stored[migration.VERSION_FIELD] == 2
    assert config_lib.Config.from_dict(stored | {"train": stored["train"] | {"remat": before}}).train.remat == today


def test_every_moved_setting_has_a_place_today():
    places = {f"{part}.{field.name}" for part, (hint, _) in migration._PARTS.items()
              for cls in parts.kinds(hint).values() for field in dataclasses.fields(cls) if field.init}
    later = {"first_guess.follow_movers"}  # version 1 had nothing of the kind
    assert set(migration.MOVED.values()) == places - later
    fields = {field.name for field in dataclasses.fields(config_lib.ModelConfig)}
    assert fields.isdisjoint(migration.MOVED) and fields >= migration._PARTS.keys()


# Numbers of the sections, and of each part that a model can have.
SECTIONS = [(section, {}) for section in
            ("model", "loss", "optimizer", "data", "augmentation", "train", "evaluation", "contract")]
SECTIONS += [(f"model.{part}", {f"model.{part}": kind}) for part, (hint, _) in migration._PARTS.items()
             for kind in parts.kinds(hint)]


def _below(config, dotted):
    for name in dotted.split("."):
        config = getattr(config, name)
    return config


SETTINGS = [(section, choice, name, whole, limit) for section, choice in SECTIONS
            for name, limit, whole in limits.of(type(_below(config_lib.override_all(presets.tiny(), choice), section)))]


@pytest.mark.parametrize(("section", "choice", "name", "whole", "limit"), SETTINGS,
                         ids=["-".join((f"{s[0]}.{s[2]}", *s[1].values())) for s in SETTINGS])
def test_no_number_of_the_settings_may_be_what_it_cannot_be(section, choice, name, whole, limit):
    """Every number of every section: NaN, infinity, text, true, and one step beyond each end of its range."""
    config = config_lib.override_all(presets.get("tiny"), choice)
    now = getattr(_below(config, section), name)
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
            dataclasses.replace(_below(config, section), **{name: math.nan})


def test_every_weight_rate_and_probability_has_a_range():
    unlimited = {name for _, _, name, _, limit in SETTINGS if limit == limits.FINITE}
    assert unlimited == set()


@pytest.mark.parametrize("heads", [(), ("image", "action", "image")])
def test_a_model_has_heads_and_each_once(heads):
    with pytest.raises(ValueError, match=r"model\.heads is \(.*; expected one or more heads, each once, of image"):
        dataclasses.replace(presets.get("tiny").model, heads=heads)


@pytest.mark.parametrize("field, value, message", [
    ("optimizer.epsilon", 1e-60, r"epsilon is 1e-60 \(0 in float32\); it must be above 0"),
    ("optimizer.epsilon", 1e-39, r"epsilon is 1e-39 \(0 in float32\); it must be above 0"),
    ("augmentation.blur_std_px", (1e-50, 1.0), r"blur_std_px is \(1e-50, 1.0\) \(0 in float32\)"),
    ("loss.kl", 1e39, r"kl is 1e\+39 \(infinite in float32\)"),
])
def test_numbers_must_hold_in_float32(field, value, message):
    with pytest.raises(ValueError, match=message):
        config_lib.override(presets.get("tiny"), field, value)


def test_geometry_says_what_is_wrong_in_its_own_words():
    with pytest.raises(ValueError, match=r"elevation_min_rad is 0.2; it must be below elevation_max_rad, 0.1"):
        config_lib.RangeViewGeometry(elevation_min_rad=0.2, elevation_max_rad=0.1)
    with pytest.raises(ValueError, match=r"VoxelGrid.voxel_size_m is 0.0; it must be above 0 and at most 1000 m"):
        config_lib.VoxelGrid(voxel_size_m=0.0)


def test_a_kept_run_that_says_nothing_of_steps_goes_on_taking_the_first_action():
    kept = json.loads((KEPT / "town-tr.json").read_text())
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
