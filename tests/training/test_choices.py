"""What flags and --set of a training choose together is checked at once: before anything is recorded or compiled."""

import typing

import pytest

from muvo_jax import config as config_lib
from muvo_jax import estimate, presets, train
from muvo_jax.town import record
from muvo_jax.town import settings as town_settings


def configured(*settings, **flags):
    return train.configure(train.Options(preset="tiny", set=settings, **flags))[0]


@pytest.mark.parametrize("flags", [{}, {"with_heads": "depth"}, {"occupancy": True}])
@pytest.mark.parametrize("value", ["3", "null", "image", "[1]", "[]", '["image","image"]', '{"image":1}'])
def test_heads_are_a_list_of_heads_each_once(value, flags):
    with pytest.raises(ValueError, match=r"--set model\.heads=.*: expected a list of one or more heads, each once"):
        configured(f"model.heads={value}", **flags)


def test_heads_are_known_and_add_up():
    with pytest.raises(ValueError, match=r"--set model\.heads: 'imag' is unknown; .*Did you mean image"):
        configured('model.heads=["imag"]', with_heads="depth")
    with pytest.raises(ValueError, match="--no-occupancy leaves no head"):
        configured('model.heads=["occupancy"]', no_occupancy=True)
    with pytest.raises(ValueError, match=r"--heads=image and --set model\.heads=\[\"action\"\] contradict each other"):
        configured('model.heads=["action"]', heads="image")
    assert configured('model.heads=["action"]', heads="action").model.heads == ("action",)
    assert configured('model.heads=["image"]', with_heads="depth").model.heads == ("image", "depth")


def test_the_size_of_a_town_is_a_known_one(monkeypatch):
    assert typing.get_type_hints(config_lib.DataConfig)["town_size"] == typing.Literal[tuple(town_settings.SIZES)]
    with pytest.raises(ValueError, match=r"data\.town_size: 'huge' is unknown; known are default, large, tiny"):
        configured("data.town_size=huge")
    monkeypatch.setattr(town_settings, "SIZES", {})
    with pytest.raises(ValueError, match="town size 'tiny' is unknown"):
        record.cached_town(presets.tiny())


@pytest.mark.parametrize(("flags", "setting", "message"), [
    ({"steps": 7}, "train.steps=5", r"--steps=7 and --set train\.steps=5 contradict each other"),
    ({"variant": "RV-WOB-TR"}, "model.camera=null", r"--variant=RV-WOB-TR and --set model\.camera=null contradict"),
    ({"camera": "wob"}, "model.camera=null", r"--camera=wob and --set model\.camera=null contradict each other"),
    ({"data": "/a", "key_frames": True}, "data.key_frames=false", r"--key-frames and --set data\.key_frames=false"),
    ({"perceptual_from": "a"}, "train.perceptual_from=b", r"--perceptual-from=a and --set train\.perceptual_from=b"),
    ({}, "preset=paper", r"--set preset=paper: .*Choose it by --preset=NAME"),
    ({}, "model.kinematics.periods=3", r"model\.kinematics\.periods follows from .* data\.stride.*Leave it out"),
    ({}, "model.kinematics=null", r"model\.kinematics follows from"),
    ({"data_camera": "foo"}, "train.seed=1", "the built-in town has no camera 'foo'.*Leave --data-camera out"),
    ({"augment": True}, 'augmentation={"image": false}', "augmentation is a section of settings.*such as augmentation"),
    ({}, "model={}", r"model is a section of settings, not one: set what is in it, such as model\."),
    ({"resume": True}, "train.backbone_weights=a.pth", r"--set train\.backbone_weights and --resume contradict"),
    ({"perceptual_from": "a"}, "loss.image_perceptual=0", r"--perceptual-from and --set loss\.image_perceptual=0"),
    ({"key_frames": True}, "train.seed=1", "the built-in town has no key frames; leave --key-frames out"),
])
def test_what_contradicts_or_cannot_be_set_is_refused(flags, setting, message):
    flags = {name: train.pathlib.Path(value) if name == "perceptual_from" else value for name, value in flags.items()}
    with pytest.raises(ValueError, match=message):
        configured(setting, **flags)


def test_a_flag_and_a_setting_may_say_the_same():
    config = configured("train.steps=7", "model.camera=bev", steps=7, variant="RV-BEV-TR")
    assert config.train.steps == 7 and config.model.variant == "RV-BEV-TR"
    assert configured("model.camera=null", camera="NONE").model.camera is None


def test_a_hint_names_only_what_can_be_set():
    with pytest.raises(ValueError, match="'period' is unknown") as refused:
        config_lib.override(presets.town(), "model.period", 3)
    assert "kinematics." not in str(refused.value)


def test_a_model_that_ships_is_named_where_a_run_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = configured(perceptual_from=train.pathlib.Path("builtin:town"))
    assert config.train.perceptual_from == "builtin:town"
    assert "of " in train.frozen_encoder(config).source


def test_another_network_than_that_of_the_first_run_is_refused_at_once():
    shipped = train.pathlib.Path("builtin:town")
    with pytest.raises(ValueError, match=r"holds another architecture.*model.latent|latent\.kind"):
        train.configure(train.Options(init=shipped, latent="1d"))
    config, _, _ = train.configure(train.Options(init=shipped, fusion="tr", with_heads="ego_motion", set=(
        "model.fusion.dropout=0.3", "model.prior_dropout=0")))
    assert "ego_motion" in config.model.heads and config.model.fusion.dropout == 0.3


def test_the_hint_to_go_on_says_the_name_as_given(monkeypatch, tmp_path):
    jobs = []
    monkeypatch.setattr(train.loop, "train", lambda job, show: jobs.append(job))
    monkeypatch.setattr(train.together, "is_first", lambda: False)
    train.train(train.Options(preset="tiny", name="a/b", runs_dir=tmp_path), None)
    assert "--name=a/b --resume" in jobs[0].resume_command and jobs[0].folder == tmp_path / "a" / "b"


@pytest.mark.parametrize(("options", "message"), [
    ({"share": 0.0}, "--share is 0; expected .* above 0 and at most 1"),
    ({"share": float("inf")}, "--share is inf; expected"),
    ({"hosts": "2", "batch": 16}, "--hosts=2: what one process needs is estimated.*with --batch"),
    ({"hosts": "nonsense", "host": 7}, "--hosts=nonsense --host=7: what one process needs"),
])
def test_an_estimate_refuses_what_it_cannot_follow_before_it_compiles(options, message, monkeypatch):
    monkeypatch.setattr(estimate, "of_config", lambda config: pytest.fail("compiled"))
    with pytest.raises(ValueError, match=message):
        estimate.estimate(estimate.Options(preset="tiny", **options), None)


def test_augmentation_that_is_asked_for_and_switched_off_contradict_each_other():
    with pytest.raises(ValueError, match="--augment and --set augmentation"):
        train.configure(train.Options(preset="tiny", augment=True,
                                      set=("augmentation.image=false", "augmentation.route=false")))


def test_without_augmentation_windows_are_as_they_were_recorded():
    assert train.configure(train.Options())[0].augmentation.mirror
    still = train.configure(train.Options(no_augment=True))[0].augmentation
    assert not (still.image or still.route or still.mirror or still.light)


def test_a_number_that_no_float_can_be_is_refused():
    with pytest.raises(ValueError, match=r"batch is 1000+ .infinite in float32.; it must be"):
        configured(f"train.batch=1{'0' * 400}")


def test_a_variant_in_capitals_has_the_name_of_its_folder(monkeypatch, tmp_path):
    jobs = []
    monkeypatch.setattr(train.loop, "train", lambda job, show: jobs.append(job))
    monkeypatch.setattr(train.together, "is_first", lambda: False)
    train.train(train.Options(preset="tiny", lidar="RV", fusion="TR", latent="1D", runs_dir=tmp_path), None)
    assert jobs[0].folder == tmp_path / "tiny-tr-1d" and "--name=tiny-tr-1d --resume" in jobs[0].resume_command
