"""What a run compiles, and when: its step once, before the first batch; validation once; nothing after that."""

import jax
import pytest
from test_loop import Interrupting, MemoryRecording, SmallWorld, _config

from muvo_jax import config as config_lib
from muvo_jax.model import world_model
from muvo_jax.training import loop, preparation
from muvo_jax.training import step as step_lib


@pytest.fixture(autouse=True)
def small_model(monkeypatch):
    monkeypatch.setattr(world_model, "WorldModel", SmallWorld)


def test_the_step_is_compiled_once_and_nothing_after_the_first_validation(tmp_path, monkeypatch):
    happened, call = [], step_lib.SpreadFunction.__call__

    def listen(event, duration_s, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            happened.append("compiled")

    def noted(self, state, batch):
        result = call(self, state, batch)
        happened.append("step" if isinstance(result, tuple) else "validation")
        return result

    monkeypatch.setattr(step_lib.SpreadFunction, "__call__", noted)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        config = _config(validate_every=2, checkpoint_every=0)
        loop.train(loop.Job(config=config, folder=tmp_path / "run", open_recording=MemoryRecording), Interrupting())
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    steps = [index for index, what in enumerate(happened) if what == "step"]
    validations = [index for index, what in enumerate(happened) if what == "validation"]
    assert len(steps) == 6 and len(validations) >= 3
    assert "compiled" in happened[:steps[0]]  # the step itself, from shapes
    assert "compiled" not in happened[steps[0]:steps[1]]
    second = next(index for index in validations if index > steps[3])  # of step 4; the first was of step 2
    assert "compiled" not in happened[steps[2]:second + 1]


def test_an_early_step_is_taken_only_where_the_data_changed_none_of_its_settings(monkeypatch):
    config = _config()
    shapes = preparation.expected_batch(config, 2)
    early = preparation.Prepared(config, None, None, None, shapes, 0.0, 0.0)
    anew = object()
    monkeypatch.setattr(preparation, "prepare", lambda *_: anew)
    elsewhere = config_lib.override_all(config, {"data.path": "other", "evaluation.windows": 3})
    assert preparation.recompile(early, elsewhere, shapes) is early
    for name, value in (("train.observe_frames", 1), ("loss.kl", 0.5), ("augmentation.mirror", True),
                        ("data.route_map.metres_per_px", 0.9)):
        changed = config_lib.override_all(config, {name: value})
        assert preparation.recompile(early, changed, shapes) is anew, name
    assert preparation.recompile(early, config, preparation.expected_batch(config, 3)) is anew
