"""The drive command: the town as a simulator, scores of drives, who drives, and what is written."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from muvo_jax import command_line, drive, drive_report, presets, town_drive
from muvo_jax import config as config_lib
from muvo_jax import run as run_lib
from muvo_jax.agents import closed_loop, drive_scores, sensitivity
from muvo_jax.model import world_model
from muvo_jax.town import settings
from muvo_jax.town import simulator as town_lib
from muvo_jax.training import checkpoint, screen


def made_up(metres, end=None, speeds_mps=(5.0, 5.0), headings_rad=(0.0, 0.0)):
    """A drive of given metres, speeds and headings."""
    end = {} if end is None else {end: True}
    places = np.linspace(0.0, metres, len(speeds_mps))
    situations = [closed_loop.Situation(place, speed_mps=speed, heading_rad=heading)
                  for place, speed, heading in zip(places, speeds_mps, headings_rad, strict=True)]
    situations[-1] = dataclasses.replace(situations[-1], **end)
    return closed_loop.Drive(metres, len(situations) - 1, tuple(situations), ())


def test_scores_are_relative_to_the_experts_metres_and_have_intervals():
    drives = {"expert": [made_up(metres) for metres in (4.0, 5.0, 6.0, 5.0)],
              "constant": [made_up(metres, end) for metres, end in ((2.0, "collided"), (2.5, "lost"), (3.0, None),
                                                                    (2.5, "arrived"))]}
    scores = drive_scores.summarise(drives, route_m=50.0, step_s=0.2, expert="expert")
    expert, constant = scores["expert"], scores["constant"]
    assert expert["progress"] == 1.0 and expert["progress_interval"] == [1.0, 1.0] and expert["success"] == 1.0
    np.testing.assert_allclose(expert["success_interval"], [1 / (1 + 3.8415 / 4), 1.0], rtol=1e-4)
    assert expert["route_share"] == pytest.approx(5 / 50) and expert["seconds_share"] == 1.0
    assert (constant["success"], constant["collisions"], constant["lost"]) == (0.5, 1, 1)
    assert constant["progress_m"] == 2.5
    np.testing.assert_allclose(constant["progress_interval"], [0.5, 0.5])  # half the expert's metres at every seed
    low, high = constant["progress_m_interval"]
    assert 2.0 <= low < 2.5 < high <= 3.0
    alone = drive_scores.summarise({"constant": drives["constant"][:1]}, route_m=50.0, step_s=0.2)
    assert "progress" not in alone["constant"] and np.isnan(alone["constant"]["progress_m_interval"]).all()


def test_wilsons_interval_says_what_sixteen_of_sixteen_leave_open():
    np.testing.assert_allclose(drive_scores.wilson(16, 16), [0.806, 1.0], atol=1e-3)
    np.testing.assert_allclose(drive_scores.wilson(8, 16), [0.280, 0.720], atol=1e-3)
    np.testing.assert_allclose(drive_scores.wilson(0, 16), [0.0, 0.194], atol=1e-3)


def test_comfort_is_what_passengers_feel():
    """Steps of 0.5 s: 4 m/s2 of braking in the first; half a radian at 4 m/s, 4 m/s2 across, in the second."""
    one = made_up(4.0, speeds_mps=(6.0, 4.0, 4.0, 4.0), headings_rad=(3.0, 3.0, 3.5 - 2 * np.pi, 3.5 - 2 * np.pi))
    scores = drive_scores.summarise({"a": [one]}, route_m=50.0, step_s=0.5)["a"]
    np.testing.assert_allclose([scores["acceleration_mps2"], scores["lateral_mps2"]], [4 / 3**0.5, 4 / 3**0.5])
    assert scores["hard_share"] == pytest.approx(2 / 3)
    silent = dataclasses.replace(one, situations=tuple(closed_loop.Situation(0.0) for _ in range(4)))
    scores = drive_scores.summarise({"a": [silent]}, route_m=50.0, step_s=0.5)["a"]
    assert np.isnan([scores["acceleration_mps2"], scores["hard_share"]]).all()


@pytest.fixture(scope="module")
def town():
    return town_lib.Town(settings.from_config(presets.get("tiny")))


def test_the_town_gives_what_the_model_reads_at_the_models_rate(town):
    config = presets.get("tiny")
    world = town_drive.town_simulator(town, config)
    done = closed_loop.drive(world, closed_loop.expert_driver(world), jax.random.key(0), town_drive.FIRST_SEED, 4,
                            context=1)
    assert done.unharmed and done.progress_m > 1.0
    state = done.moments[0].state
    assert int(world.step(state, done.moments[0].action).frame) == int(state.frame) + config.data.stride
    seen = world.observe(state)
    assert seen["image"].shape == (*config.model.image_size, 3) and seen["image"].dtype == np.uint8
    assert seen["range_view"].shape == (config.model.range_view.rows, config.model.range_view.columns, 4)
    assert seen["route_map"].shape == (64, 64)
    lifted = config_lib.override(config, "model.camera", "bev")
    assert set(town_drive.observation(town, state, lifted)) >= set(world_model.inputs(lifted.model))


def test_geometry_alone_answers_to_the_wheel_as_the_town_does(town):
    config = presets.get("tiny")
    world = town_drive.town_simulator(town, config)
    states = [world.reset(town_drive.FIRST_SEED + drive) for drive in range(2)]
    assert town_drive.contrast_horizons(config) == (2, 4)
    pair = sensitivity.CONTRASTS["left or right"]
    truth = lambda state: town_drive.town_truth(town, state)
    shown = [[sensitivity.follow(world, truth, state, action, 2) for state in states] for action in pair]
    moved = [town_drive.moved_views(town, config, states, action, 2) for action in pair]
    for head in ("image", "range_view", "occupancy"):
        true = [np.stack([frames[head] for frames in drives]) for drives in shown]
        found = sensitivity.score(head, [frames[head] for frames in moved], true)
        assert found["gain"] > 0.1 and found["correlation"] > 0.1, (head, found)


def test_a_model_that_shows_nothing_drives_without_pictures_of_what_it_imagines(town):
    config = config_lib.override(presets.get("tiny"), "model.heads", ("action",))
    world = town_drive.town_simulator(town, config)
    done = closed_loop.drive(world, closed_loop.expert_driver(world), jax.random.key(0), town_drive.FIRST_SEED, 1,
                             context=1)
    moments = tuple(dataclasses.replace(moment, memory=object()) for moment in done.moments)
    planned = dataclasses.replace(done, moments=moments)
    blind = run_lib.Run(world_model.WorldModel(config.model), {}, config)
    films = [drive_report.film(blind, town, one, jax.random.key(0), None, 2) for one in (done, planned)]
    np.testing.assert_array_equal(*films)
    assert drive_report.sensitivity_rows({"sensitivity": {"2": {"left or right": {}}}}) == []


def test_help_shows_examples_and_explains_every_option(capsys):
    with pytest.raises(SystemExit) as ended:
        command_line.run(drive.Options, lambda *_: None, program="drive", arguments=["--help"],
                         examples=drive.EXAMPLES)
    text = capsys.readouterr().out
    assert ended.value.code == 0 and text.count("python -m muvo_jax.drive ") >= 3 and "None" not in text


def test_icem_is_cem_with_kept_elites():
    name, improved = drive.planner_of(drive.Options(run="r"))
    plain_name, plain = drive.planner_of(drive.Options(run="r", planner="cem"))
    assert name == plain_name == "cem" and improved.kept > 0 and plain.kept == 0 and plain.noise_exponent == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of fresh weights."""
    config = presets.tiny()
    folder = tmp_path_factory.mktemp("drive") / "tiny"
    checkpoint.save_variables(folder, 1, world_model.WorldModel(config.model).init(jax.random.key(0)), config=config)
    return folder


def test_who_is_named_drives_and_the_report_says_how(folder, tmp_path):
    options = drive.Options(folder, agent="constant,expert", episodes=2, seconds=0.6, sensitivity=False, out=tmp_path)
    report = drive.drive(options, screen.Screen())
    assert list(report["scores"]) == ["constant", "expert"] and "sensitivity" not in report
    stored = json.loads((tmp_path / "drive.json").read_text())
    assert stored["seeds"] == [5000, 5001] and stored["scores"]["expert"]["progress"] == 1.0
    assert len(stored["drives"]["constant"]) == 2 and stored["scores"]["constant"]["acceleration_mps2"] < 1e-6
    page = (tmp_path / "drive.md").read_text()
    assert "| driver | success | collisions | off route | metres | of expert's metres |" in page
    assert "| constant | 100% [34..100] | 0 | 0 |" in page and "answer to actions" not in page
    assert (tmp_path / "drive.gif").is_file()


def test_a_planner_that_sees_no_obstacles_says_so(town, capsys):
    config = config_lib.override(presets.tiny(), "model.heads", ("image", "action"))
    blind = run_lib.Run(world_model.WorldModel(config.model), {}, config)
    options = drive.Options("r", horizon=3)
    assert callable(drive.driver_of("planner", options, blind, town_drive.town_simulator(town, config), None,
                                    screen.Screen()))
    printed = capsys.readouterr().out
    assert "has no head occupancy: the planner sees no obstacles" in printed
    assert "planning 3 steps ahead; training imagined 2" in printed


@pytest.mark.parametrize(("options", "message"), [
    ({"agent": "planner,experts"}, "experts is none of them"), ({"agent": "expert,expert"}, "each once"),
    ({"agent": ","}, "expected one or several of planner, learned, expert, constant, random"),
    ({"agent": "learned"}, r"tiny/agent holds no agent"),
    ({"episodes": 0}, "--episodes is 0")])
def test_who_cannot_drive_is_refused_before_anyone_does(options, message, folder):
    with pytest.raises(ValueError, match=message):
        drive.drive(drive.Options(folder, **options), screen.Screen())


def test_a_policy_that_no_agent_drives_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"--policy=.* names none: add it, as in --agent=learned,planner"):
        drive.drive(drive.Options(tmp_path, agent="planner", policy=tmp_path / "agent"), screen.Screen())
