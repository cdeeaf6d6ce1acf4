"""The loop: a run that was stopped or killed goes on as if nothing had happened, and bad endings are explained."""

import dataclasses
import io
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rich.console
import small_world
from jax.experimental.compilation_cache import compilation_cache

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fitting, schema
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint, checkpoint_meta, integrity, loop, preparation, run_folder, screen
from muvo_jax.training import step as step_lib

STEPS = 6
INTRINSICS = ((32.0, 0.0, 32.0), (0.0, 32.0, 16.0), (0.0, 0.0, 1.0))
CAMERA_TO_EGO = ((0.0, 0.0, 1.0, 1.0), (-1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))


class SmallWorld(small_world.SmallWorld):
    """The small model with all that the loop and its validation ask for."""

    def init(self, key, batch=None):
        del key, batch
        return super().init()

    def encode(self, variables, batch, *, train=False, keys=None, axis_name=None):
        return super().encode(variables, batch, train=train, keys=keys, axis_name=axis_name)

    def imagine_step(self, variables, *args):
        network = small_world.SmallNetwork(self.config)
        return network.apply(variables, *args, method=lambda module, *values: module.transition.imagine_step(*values))


class MemoryRecording:
    """A recording without files: 14 training frames and 8 to validate."""

    description = schema.RecordingDescription(
        name="memory", kind="memory", rate_hz=10.0,
        camera=schema.Camera(64, 32, INTRINSICS, CAMERA_TO_EGO),
        lidar=config_lib.RangeViewGeometry(), voxels=None, contract=config_lib.ActionContract(),
        modalities=frozenset(schema.RawFrame.__annotations__) - {"occupancy", "reward", "is_terminal"},
        splits=("train", "val_rl"))
    sequences = (schema.Sequence("train", "a", 0, 14), schema.Sequence("val_rl", "b", 0, 8))

    def read(self, sequence, index):
        random = np.random.default_rng([len(sequence.split), index])
        camera = self.description.camera
        return {"image": random.integers(0, 255, (32, 64, 3), np.uint8), "intrinsics": np.float32(camera.intrinsics),
                "camera_to_ego": np.float32(camera.camera_to_ego),
                "points_m": random.uniform(-20.0, 20.0, (50, 3)).astype(np.float32),
                "route_map": np.zeros((64, 64), np.uint8), "speed_mps": np.float32(3.0),
                "action": self.action(sequence, index),
                "timestamp_s": np.float64(index / 10), "frame_id": np.int64(index)}

    def action(self, sequence, index):
        return np.random.default_rng([len(sequence.split), index, 1]).uniform(-1.0, 1.0, 2).astype(np.float32)


class Interrupting(screen.Screen):
    """A screen that does something at the log line of one step."""

    def __init__(self, at=None, action=None):
        self.output = io.StringIO()
        super().__init__(rich.console.Console(file=self.output, width=200))
        self._at, self._action = at, action

    def log(self, text):
        super().log(text)
        if self._at is not None and text.startswith(f"step {self._at}/"):
            self._action()


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(tmp_path_factory):
    """Runs of this file share compiled programs through a cache on disk, as the commands do."""
    settings = {"jax_compilation_cache_dir": str(tmp_path_factory.mktemp("programs")),
                "jax_persistent_cache_min_compile_time_secs": 0.0, "jax_persistent_cache_min_entry_size_bytes": -1}
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(autouse=True)
def small_model(monkeypatch):
    monkeypatch.setattr(world_model, "WorldModel", SmallWorld)


def _config(**train):
    config = presets.tiny()
    settings = {"steps": STEPS, "batch": 2, "log_every": 1, "validate_every": 3, "checkpoint_every": 2,
                "preview_every": 0, "validation_windows": 2, "parallel": "auto", **train}
    return dataclasses.replace(
        config, data=dataclasses.replace(config.data, path="memory", frames=3, stride=1, context=2, horizon=2),
        model=dataclasses.replace(config.model, heads=("image", "action"), prior_dropout=0.5,
                                  fusion=dataclasses.replace(config.model.fusion, dropout=0.2)),
        train=dataclasses.replace(config.train, **settings))


def _train(folder, show=None, config=None, **options):
    job = loop.Job(config=config or _config(), folder=folder, open_recording=MemoryRecording, **options)
    return loop.train(job, show or Interrupting())


_logged = run_folder.reproducible_metrics


def _final(folder):
    return jax.tree.map(np.asarray, checkpoint.load_run(folder).variables)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, compiled_programs):
    folder = tmp_path_factory.mktemp("runs") / "whole"
    patch = pytest.MonkeyPatch()
    patch.setattr(world_model, "WorldModel", SmallWorld)
    show = Interrupting()
    outcome = _train(folder, show)
    final = _final(folder)
    patch.undo()
    return folder, outcome, final, show.output.getvalue()


def test_a_run_leaves_its_files_and_says_what_it_does(uninterrupted):
    folder, outcome, _, text = uninterrupted
    assert (outcome.step, outcome.stopped) == (STEPS, False)
    assert run_folder.read_config(folder) == outcome.config
    kinds = [(record["kind"], record["step"]) for record in _logged(folder)]
    assert [step for kind, step in kinds if kind == "train"] == [1, 2, 3, 4, 5, 6]
    assert [step for kind, step in kinds if kind == "validation"] == [3, 6]
    assert {path.name for path in (folder / "checkpoints").iterdir()} >= {"4", "6"}
    assert list(folder.glob("events.*"))
    for part in ("memory", "RV-WOB-TR", "parameters", str(folder), "first loss", "compilation", "peak memory"):
        assert part in text


def test_a_run_says_what_its_time_went_into(uninterrupted):
    records = [record for record in run_folder.read_metrics(uninterrupted[0]) if record["kind"] == "time"]
    assert [record["step"] for record in records] == [2, 3, 4, STEPS]  # after every pause, and at the end
    for part in ("data_s", "steps_s", "validation_s", "checkpoints_s"):
        spent = [record.get(part, 0.0) for record in records]
        assert spent == sorted(spent) and spent[-1] > 0.0
    assert "time went into" in uninterrupted[3]


def test_some_steps_are_traced_where_asked_for(tmp_path):
    show = Interrupting()
    _train(tmp_path / "run", show, trace=True)
    written = list((tmp_path / "run" / run_folder.TRACE_FOLDER).rglob("*.xplane.pb"))
    assert len(written) == 1 and written[0].stat().st_size > 1000
    assert show.output.getvalue().count("traced steps into") == 1
    show = Interrupting()
    _train(tmp_path / "short", show, config=_config(steps=2), trace=True)
    assert "nothing was traced: steps 4 to 8 are" in show.output.getvalue()


def test_how_many_frames_are_observed_stays_as_a_run_began(tmp_path):
    """Fitting takes no more than evaluation observes, unless more were chosen; --resume must not fit anew."""
    folder = tmp_path / "run"
    _train(folder, config=_config(steps=2, observe_frames=3), chosen=("train.observe_frames",))
    assert run_folder.read_config(folder).train.observe_frames == 3
    stored = run_folder.read_config(folder)
    longer = dataclasses.replace(stored, train=dataclasses.replace(stored.train, steps=3))
    outcome = _train(folder, config=longer, resume=True, chosen=("train.steps",))
    assert outcome.config.train.observe_frames == 3


def test_validation_reports_loss_and_imagined_scores(uninterrupted):
    record = next(record for record in _logged(uninterrupted[0]) if record["kind"] == "validation")
    assert record["split"] == "val_rl"
    assert np.isfinite([record[name] for name in ("total", "psnr_db", "imagined_psnr_db", "copy_last_psnr_db",
                                                  "action_shuffle_image", "skill")]).all()


def test_the_best_checkpoint_is_the_most_skilful_one(uninterrupted):
    folder = uninterrupted[0]
    skills = {record["step"]: record["skill"] for record in _logged(folder) if record["kind"] == "validation"}
    kept = checkpoint_meta.read(folder / "checkpoints" / "6")
    assert kept["score"] == pytest.approx(skills[6])


def test_a_killed_run_resumes_to_the_same_numbers(tmp_path, uninterrupted):
    def die():
        raise RuntimeError("power failure")

    with pytest.raises(RuntimeError, match="power failure"):
        _train(tmp_path / "run", Interrupting(4, die))
    show = Interrupting()
    _train(tmp_path / "run", show, resume=True)
    assert "from step 2" in show.output.getvalue()
    _assert_equal_runs(tmp_path / "run", uninterrupted)


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path, uninterrupted):
    before = signal.getsignal(signal.SIGINT)  # a shell's background jobs ignore it
    show = Interrupting(3, lambda: os.kill(os.getpid(), signal.SIGINT))
    outcome = _train(tmp_path / "run", show, resume_command="how to go on")
    assert (outcome.step, outcome.stopped) == (3, True)
    assert "stopped at step 3 of 6; saved. Go on with:  how to go on" in show.output.getvalue()
    _train(tmp_path / "run", resume=True)
    _assert_equal_runs(tmp_path / "run", uninterrupted)
    assert signal.getsignal(signal.SIGINT) is before


def _assert_equal_runs(folder, uninterrupted):
    """The same records, each once, and the same parameters."""
    assert _logged(folder) == _logged(uninterrupted[0])
    jax.tree.map(np.testing.assert_array_equal, _final(folder), uninterrupted[2])


def test_resuming_past_a_damaged_checkpoint_says_so_and_reaches_the_same_end(tmp_path, uninterrupted):
    _train(tmp_path / "run", Interrupting(5, lambda: os.kill(os.getpid(), signal.SIGINT)))
    next(path for path in (tmp_path / "run/checkpoints/5").rglob("*") if path.is_file()
         and path.stat().st_size > 3000).write_bytes(b"")
    show = Interrupting()
    _train(tmp_path / "run", show, resume=True)
    text = "".join(show.output.getvalue().split())  # a long folder name wraps the line
    assert "checkpoints/5isdamaged" in text and "fromstep4" in text
    assert (tmp_path / "run" / integrity.DAMAGED_FOLDER / "5").is_dir()
    jax.tree.map(np.testing.assert_array_equal, _final(tmp_path / "run"), uninterrupted[2])


def test_an_existing_run_is_refused_and_left_alone(uninterrupted):
    folder = uninterrupted[0]
    before = (folder / "metrics.jsonl").read_bytes()
    with pytest.raises(FileExistsError, match=r"exists and has checkpoints\. Go on with it:  again"):
        _train(folder, resume_command="again")
    assert (folder / "metrics.jsonl").read_bytes() == before


def test_a_finished_run_has_nothing_left_to_train(uninterrupted):
    show = Interrupting()
    outcome = _train(uninterrupted[0], show, resume=True)
    assert outcome.step == STEPS and "nothing left to train" in show.output.getvalue()


def test_resuming_with_another_architecture_names_both(uninterrupted):
    config = dataclasses.replace(_config(), preset="wider")
    config = config_lib.override(config, "model.latent.deterministic_channels", 24)
    with pytest.raises(ValueError, match=r"another architecture.*deterministic_channels 16 \(stored\) against 24"):
        _train(uninterrupted[0], config=config, resume=True)


def test_resuming_with_other_parameters_to_train_names_both_and_what_to_do(uninterrupted):
    with pytest.raises(ValueError, match=r"trained with train\.trainable=\*, and cannot go on with !embed.*--init"):
        _train(uninterrupted[0], config=_config(trainable="!embed"), resume=True)


def test_a_new_run_starts_from_the_weights_of_another(tmp_path, uninterrupted):
    folder, _, final, _ = uninterrupted
    show = Interrupting()
    _train(tmp_path / "more", show, config=_config(steps=1, validate_every=0), init=folder)
    assert f"of step {STEPS} of {folder}" in show.output.getvalue()
    # One update at the schedule's first, tiny rate leaves the parameters where they were.
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), _final(tmp_path / "more")["params"], final["params"])
    assert 0 < max(jax.tree.leaves(moved)) < 1e-3
    assert checkpoint.load_run(tmp_path / "more").step == 1


def test_weights_of_another_network_are_refused_naming_both(tmp_path, uninterrupted):
    wider = config_lib.override(_config(), "model.latent.deterministic_channels", 32)
    with pytest.raises(ValueError, match=r"deterministic_channels 16 \(stored\) against 32 \(asked for\)"):
        _train(tmp_path / "other", config=wider, init=uninterrupted[0])
    assert not (tmp_path / "other").exists()


def test_a_loss_that_is_not_finite_stops_the_run_by_name(tmp_path):
    config = config_lib.override(_config(), "optimizer.learning_rate", 1e38)
    with pytest.raises(loop.NonFiniteLossError, match=r"step \d: the loss is not finite: .*= (nan|inf).*checkpoint"):
        _train(tmp_path / "run", config=config)
    assert run_folder.read_metrics(tmp_path / "run")[-1]["kind"] == "non_finite"


class Flag:
    """A step's "finite", which notes after how many steps it was read."""

    def __init__(self, value, step, done, reads):
        self.value, self.step, self.done, self.reads = value, step, done, reads

    def copy_to_host_async(self):
        self.reads.setdefault(self.step, None)

    def __float__(self):
        self.reads[self.step] = len(self.done)
        return float(self.value)


def test_whether_a_step_was_finite_is_read_late_and_for_every_step(tmp_path, monkeypatch):
    done, reads, call = [], {}, step_lib.SpreadFunction.__call__

    def noted(self, state, batch):
        result = call(self, state, batch)
        if not isinstance(result, tuple):
            return result  # of validation
        state, metrics = result
        done.append(None)
        return state, metrics | {"finite": Flag(metrics["finite"], len(done), done, reads)}

    monkeypatch.setattr(step_lib.SpreadFunction, "__call__", noted)
    _train(tmp_path / "run", config=_config(steps=12, log_every=8, validate_every=0, checkpoint_every=0))
    assert reads == {1: 1, 2: 6, 3: 7} | dict.fromkeys(range(4, 9), 8) | dict.fromkeys(range(9, 13), 12)


class Holed(MemoryRecording):
    """Some training frames have an action that is no number."""

    def action(self, sequence, index):
        bad = sequence.split == "train" and index in self.bad
        return super().action(sequence, index) * np.float32(np.nan if bad else 1.0)


def _train_on(recording, bad, folder, **settings):
    recording.bad = bad
    job = loop.Job(config=_config(non_finite="skip", validate_every=0, **settings), folder=folder,
                   open_recording=lambda: recording)
    return loop.train(job, Interrupting())


def test_batches_that_are_not_finite_are_skipped_and_counted_where_asked_for(tmp_path):
    _train_on(Holed(), {0}, tmp_path / "run")
    records = run_folder.read_metrics(tmp_path / "run")
    skipped = {record["step"] for record in records if record["kind"] == "non_finite"}
    without = {record["step"] for record in records if record["kind"] == "train" and record["total"] is None}
    assert skipped == without and 0 < len(skipped) < STEPS
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(_final(tmp_path / "run")))


def test_ten_skipped_batches_in_a_row_are_an_error(tmp_path):
    with pytest.raises(loop.NonFiniteLossError, match="step 10: the loss is not finite"):
        _train_on(Holed(), set(range(14)), tmp_path / "run", steps=12)


def test_a_second_training_is_kept_out_of_a_run_folder(tmp_path, uninterrupted):
    with run_folder.claimed(uninterrupted[0]), pytest.raises(BlockingIOError, match="another process is training here"):
        _train(uninterrupted[0], resume=True)


def test_bad_data_leaves_no_run_folder_behind(tmp_path):
    def missing():
        raise schema.DataError("data folder x does not exist")

    with pytest.raises(schema.DataError, match="does not exist"):
        loop.train(loop.Job(config=_config(), folder=tmp_path / "run", open_recording=missing), Interrupting())
    assert not (tmp_path / "run").exists()


def test_expected_batch_is_what_the_pipeline_makes():
    from muvo_jax.data import pipeline

    recording = MemoryRecording()
    config = fitting.adapt(_config(), recording).config
    batch = next(pipeline.train_batches(pipeline.Frames(recording, config), seed=0, batch=2))
    expected = preparation.expected_batch(config, 2, recorded=recording.description.modalities)
    assert jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), batch) == expected


def test_accumulated_micro_batches_count_as_one_step():
    config = config_lib.override(_config(), "optimizer.accumulate", 3)
    assert loop.windows_per_step(config) == 6
    assert jnp.int32(loop.windows_per_step(_config())) == 2
