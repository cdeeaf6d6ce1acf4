"""Checkpoints: exact round trips, and nothing lost when a file is damaged, the disk is full or the machine changes."""

import dataclasses
import errno
import json
import os
import pathlib
import shutil
import subprocess
import sys
import textwrap
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.training import checkpoint, checkpoint_meta, integrity, optimizer, state

ROOT = pathlib.Path(muvo_jax.__file__).parents[1]


@pytest.fixture(scope="module")
def config():
    return presets.tiny()


@pytest.fixture(scope="module")
def fresh(config):
    """A training state with few leaves, for speed; a checkpoint does not look into it."""
    return _fresh(config)


def _fresh(config):
    variables = {"params": {"layer": {"kernel": jnp.arange(8.0 * 4096).reshape(8, 4096), "bias": jnp.ones(3)}},
                 "batch_stats": {"norm": {"mean": jnp.zeros(3)}}}
    return state.create(variables, optimizer.make_optimizer(config.optimizer, 10), jax.random.key(7),
                        config.train.trainable)


@pytest.fixture(autouse=True)
def few_leaves(fresh, monkeypatch):
    """The model of a run is to have the variables of `fresh`."""
    monkeypatch.setattr(world_model.WorldModel, "variable_shapes", lambda self: fresh.variables)


def _at(fresh, step):
    """A state whose numbers tell the step."""
    moved = jax.tree.map(lambda leaf: leaf + step, fresh.params)
    return fresh.replace(params=moved, step=jnp.int32(step), key=jax.random.fold_in(fresh.key, step))


def _assert_same(left, right):
    jax.tree.map(np.testing.assert_array_equal, left.replace(key=jax.random.key_data(left.key)),
                 right.replace(key=jax.random.key_data(right.key)))


def _save(folder, fresh, config, *steps, **options):
    keeper = checkpoint.Checkpoints(folder, **options)
    for step in steps:
        keeper.save(step, _at(fresh, step), config=config, data_state={"position": step}, score=float(-step),
                    provenance={"name": "town"})
    keeper.wait()
    return keeper


def test_a_run_that_clips_gradients_goes_on_as_one_that_does(config, fresh, tmp_path):
    _save(tmp_path, fresh, config, 1)
    clipping = config_lib.override(config, "optimizer.clip_norm", 1.0)
    with pytest.raises(ValueError, match=r"trained with optimizer\.clip_norm=0\.0, and cannot go on with 1\.0.*--init"):
        checkpoint.Checkpoints(tmp_path).restore_latest(_fresh(clipping), clipping)


def test_round_trip_restores_every_leaf_the_typed_key_and_the_data_position(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 3).close()
    restored = checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config)
    _assert_same(restored.state, _at(fresh, 3))
    assert jax.dtypes.issubdtype(restored.state.key.dtype, jax.dtypes.prng_key)
    assert (restored.step, restored.data_state, restored.warnings) == (3, {"position": 3}, ())
    assert restored.meta["contract"]["rate_hz"] == config.contract.rate_hz
    assert restored.meta["packages"]["jax"] == jax.__version__
    assert restored.meta["provenance"] == {"name": "town"}
    assert config_lib.Config.from_dict(restored.meta["config"]) == config


def test_data_position_may_be_bytes(tmp_path, fresh, config):
    keeper = checkpoint.Checkpoints(tmp_path)
    keeper.save(1, fresh, config=config, data_state=b"\x00\xff")
    assert keeper.restore_latest(fresh, config).data_state == b"\x00\xff"


def test_an_empty_run_has_nothing_to_restore(tmp_path, fresh, config):
    assert checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config) is None


def _truncate(folder):
    largest = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    largest.write_bytes(b"")


def _flip_a_byte(folder):
    largest = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(content)


def _interrupt(folder):
    (folder / integrity.CHECKSUM_FILE).unlink()


def _remove_a_file(folder):
    next(path for path in (folder / "training").rglob("*") if path.is_file()).unlink()


@pytest.mark.parametrize("harm", [_truncate, _flip_a_byte, _interrupt, _remove_a_file])
def test_a_damaged_newest_checkpoint_is_passed_over_and_named(tmp_path, fresh, config, harm):
    _save(tmp_path, fresh, config, 1, 2).close()
    harm(tmp_path / "checkpoints" / "2")
    restored = checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config)
    _assert_same(restored.state, _at(fresh, 1))
    assert len(restored.warnings) == 1 and "checkpoints/2 is damaged" in restored.warnings[0]
    loaded = checkpoint.load_run(tmp_path)
    assert loaded.step == 1 and "checkpoints/2 is damaged" in loaded.warnings[0]


def test_a_damaged_step_can_be_written_again(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1, 2).close()
    _truncate(tmp_path / "checkpoints" / "2")
    keeper = checkpoint.Checkpoints(tmp_path)
    keeper.save(2, _at(fresh, 2), config=config)
    _assert_same(keeper.restore_latest(fresh, config).state, _at(fresh, 2))
    assert (tmp_path / integrity.DAMAGED_FOLDER / "2").is_dir()


def test_only_damaged_checkpoints_is_an_error(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1).close()
    _truncate(tmp_path / "checkpoints" / "1")
    with pytest.raises(checkpoint.CheckpointError, match="no readable checkpoint"):
        checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config)
    with pytest.raises(checkpoint.CheckpointError, match="no readable checkpoint"):
        checkpoint.load_run(tmp_path)


def test_another_architecture_is_refused_by_naming_both(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1).close()
    other = config_lib.override(dataclasses.replace(config, preset="other"), "model.latent.embedding_channels", 24)
    with pytest.raises(ValueError, match=r"preset 'tiny'.*preset 'other'.*embedding_channels 16 \(stored\) against 24"):
        checkpoint.Checkpoints(tmp_path).restore_latest(fresh, other)


def test_a_checkpoint_with_the_config_of_version_1_is_read(tmp_path, fresh, config, monkeypatch):
    kept = json.loads((pathlib.Path(__file__).parents[1] / "kept_runs/tiny-tr.json").read_text())
    with monkeypatch.context() as patch:
        patch.setattr(config_lib.Config, "to_dict", lambda self: kept)
        _save(tmp_path, fresh, config, 1).close()
    assert checkpoint.load_run(tmp_path).config == presets.tiny()
    assert checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config).step == 1


def test_a_run_with_frozen_parameters_goes_on_and_refuses_to_train_others(tmp_path, config):
    some = config_lib.override(config, "train.trainable", "!layer/kernel")
    fresh = _fresh(some)
    keeper = _save(tmp_path, fresh, some, 1)
    _assert_same(keeper.restore_latest(fresh, some).state, _at(fresh, 1))
    with pytest.raises(ValueError, match=r"trained with train\.trainable=!layer/kernel, .* go on with \*: .*--init"):
        keeper.restore_latest(_fresh(config), config)


def test_keeps_the_last_and_the_best(tmp_path, fresh, config):
    keeper = checkpoint.Checkpoints(tmp_path, keep_last=2, keep_best=1)
    for step, score in ((1, 0.0), (2, 5.0), (3, 1.0), (4, None), (5, 2.0)):
        keeper.save(step, fresh, config=config, score=score)
        if step == 3:  # the run goes on in another process
            keeper.close()
            keeper = checkpoint.Checkpoints(tmp_path, keep_last=2, keep_best=1)
    keeper.wait()
    assert keeper.steps() == [2, 4, 5]
    keeper.close()
    assert checkpoint.load_run(tmp_path, "best").step == 2
    assert checkpoint.load_run(tmp_path, "latest").step == 5
    assert checkpoint.load_run(tmp_path, 4).step == 4
    with pytest.raises(checkpoint.CheckpointError, match="no step 3; it has 2, 4, 5"):
        checkpoint.load_run(tmp_path, 3)
    _flip_a_byte(tmp_path / "checkpoints" / "2")
    best = checkpoint.load_run(tmp_path, "best")
    assert best.step == 5 and "checkpoints/2 is damaged" in best.warnings[0]
    with pytest.raises(checkpoint.CheckpointError, match=r"no readable checkpoint of step 2 .* 2, 4, 5: .* damaged"):
        checkpoint.load_run(tmp_path, 2)


def test_where_nothing_has_a_score_the_newest_is_said_to_be_the_best(tmp_path, fresh, config):
    keeper = checkpoint.Checkpoints(tmp_path)
    keeper.save(1, fresh, config=config)
    keeper.close()
    loaded = checkpoint.load_run(tmp_path, "best")
    assert loaded.step == 1 and "has a score; the newest is taken for the best" in loaded.warnings[0]


def test_load_gives_the_model_and_its_variables(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1).close()
    run = muvo_jax.load(tmp_path)
    assert isinstance(run, muvo_jax.Run) and run.model == world_model.WorldModel(config.model)
    assert (run.config, run.contract, run.step, run.folder) == (config, config.contract, 1, tmp_path.resolve())
    jax.tree.map(np.testing.assert_array_equal, run.variables, _at(fresh, 1).variables)
    with pytest.warns(DeprecationWarning, match=r"write run = muvo_jax.load"):
        model, variables = run
    assert model is run.model and variables is run.variables


def test_loading_what_is_not_there_says_what_was_expected(tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="does not exist"):
        checkpoint.load_run(tmp_path / "nowhere")
    with pytest.raises(checkpoint.CheckpointError, match="has no checkpoint yet"):
        checkpoint.load_run(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(checkpoint.CheckpointError, match="is a file, and no run's folder"):
        checkpoint.load_run(tmp_path / "file")


def test_an_unknown_schema_names_the_version_that_wrote_it(tmp_path, fresh, config, monkeypatch):
    monkeypatch.setattr(checkpoint_meta, "SCHEMA_VERSION", 99)
    _save(tmp_path, fresh, config, 1).close()
    monkeypatch.undo()
    with pytest.raises(ValueError, match="checkpoint schema 99, this version reads 1"):
        checkpoint.load_run(tmp_path)


def _run(code, devices, **environment):
    variables = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT),
                 "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", **environment}
    return subprocess.run([sys.executable, "-c", textwrap.dedent(code)], env=variables, capture_output=True, text=True,
                          timeout=120, check=False)


def test_eight_devices_write_and_one_reads(tmp_path, fresh, config):
    assert jax.device_count() == 8
    mesh = jax.make_mesh((8,), ("data",))
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    _save(tmp_path, jax.device_put(fresh, everywhere), config, 1).close()
    result = _run(f"""
        import jax, json
        from muvo_jax.training import checkpoint
        checkpoint.world_model.WorldModel.variable_shapes = lambda self: {{}}
        loaded = checkpoint.load_run({str(tmp_path)!r})
        leaves = jax.tree.leaves(loaded.variables)
        print(json.dumps([jax.device_count(), len(leaves), sum(float(leaf.sum()) for leaf in leaves)]))
    """, devices=1)
    assert result.returncode == 0, result.stderr
    devices, count, total = json.loads(result.stdout)
    expected = jax.tree.leaves(_at(fresh, 1).variables)
    assert (devices, count) == (1, len(expected))
    assert total == pytest.approx(sum(float(leaf.sum()) for leaf in expected), rel=1e-6)


def test_a_full_disk_leaves_the_checkpoint_before_and_says_so(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1).close()
    result = _run(f"""
        import resource, sys
        sys.path.insert(0, {str(pathlib.Path(__file__).parent)!r})
        from muvo_jax import presets
        from muvo_jax.training import checkpoint
        from test_checkpoint import _fresh
        config = presets.tiny()
        fresh = _fresh(config)
        keeper = checkpoint.Checkpoints({str(tmp_path)!r})
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            keeper.save(2, fresh, config=config)
            keeper.wait()
        except checkpoint.CheckpointError as error:
            print(error)
        print(keeper.steps(), keeper.restore_latest(fresh, config).step)
    """, devices=1)
    assert result.returncode == 0, result.stderr
    message, kept = result.stdout.strip().splitlines()
    assert "checkpoint of step 2 could not be written" in message and "Readable checkpoints: 1." in message
    assert kept == "[1] 1"
    _assert_same(checkpoint.Checkpoints(tmp_path).restore_latest(fresh, config).state, _at(fresh, 1))


def test_a_folder_that_cannot_be_written_is_told_and_what_is_there_stays(tmp_path, fresh, config, monkeypatch):
    keeper = _save(tmp_path, fresh, config, 1)
    with monkeypatch.context() as patch:
        patch.setattr(integrity, "seal", lambda folder: (_ for _ in ()).throw(OSError(errno.EROFS, "Read-only")))
        with pytest.raises(checkpoint.CheckpointError, match=r"step 2 .* Read-only.*or the folder read-only\?.*: 1\."):
            keeper.save(2, _at(fresh, 2), config=config)
            keeper.wait()
    assert keeper.saved == 1
    assert keeper.restore_latest(fresh, config).step == 1
    keeper.save(2, _at(fresh, 2), config=config)
    assert keeper.restore_latest(fresh, config).step == 2


def test_training_goes_on_while_a_checkpoint_is_written_and_the_one_before_stays_whole(tmp_path, fresh, config,
                                                                                       monkeypatch):
    keeper, slow, seal = _save(tmp_path, fresh, config, 1), threading.Event(), integrity.seal
    monkeypatch.setattr(integrity, "seal", lambda folder: (slow.wait(60.0), seal(folder)))
    state = _at(fresh, 2)
    want = jax.tree.map(np.array, state.replace(key=jax.random.key_data(state.key)))
    keeper.save(2, state, config=config)
    for leaf in jax.tree.leaves(state.params):  # as the training step does with what was given to it
        leaf.delete()
    assert keeper.saved == 1 and checkpoint.load_run(tmp_path).step == 1
    slow.set()
    keeper.wait()
    assert keeper.saved == 2
    restored = keeper.restore_latest(fresh, config).state
    jax.tree.map(np.testing.assert_array_equal, restored.replace(key=jax.random.key_data(restored.key)), want)


def test_a_save_that_failed_in_the_background_is_told_at_the_next_look(tmp_path, fresh, config, monkeypatch):
    keeper = _save(tmp_path, fresh, config, 1)
    monkeypatch.setattr(integrity, "seal", lambda folder: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space")))
    keeper.save(2, _at(fresh, 2), config=config)
    with pytest.raises(checkpoint.CheckpointError, match=r"step 2 .*No space"):
        for _ in range(600):
            keeper.check()
            time.sleep(0.1)


def test_a_clock_that_was_set_back_changes_nothing(tmp_path, fresh, config, monkeypatch):
    now_s = time.time()
    keeper = _save(tmp_path, fresh, config, 1, 2)
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: now_s - 1e6)
        patch.setattr(time, "time_ns", lambda: int((now_s - 1e6) * 1e9))
        keeper.save(3, _at(fresh, 3), config=config)
        keeper.close()
    for step in (2, 3):
        long_ago_s = now_s - 1e6 * step
        os.utime(tmp_path / "checkpoints" / str(step), (long_ago_s, long_ago_s))
    keeper = checkpoint.Checkpoints(tmp_path)
    assert keeper.steps() == [1, 2, 3] and keeper.restore_latest(fresh, config).step == 3
    keeper.save(4, _at(fresh, 4), config=config)
    keeper.wait()
    assert keeper.steps() == [1, 3, 4] and checkpoint.load_run(tmp_path).step == 4


@pytest.mark.parametrize("files", [[], None, 3, "text"])
def test_a_list_of_checksums_that_is_none_is_damage(tmp_path, fresh, config, files):
    keeper = _save(tmp_path, fresh, config, 1, 2)
    (tmp_path / "checkpoints/2/checksums.json").write_text(json.dumps({"files": files}))
    restored = keeper.restore_latest(fresh, config)
    assert restored.step == 1 and "checksums.json cannot be read" in restored.warnings[0]


def _reseal(folder):
    (folder / integrity.CHECKSUM_FILE).unlink()
    integrity.seal(folder)


def _without_variables(folder):
    shutil.rmtree(folder / "variables")
    _reseal(folder)


def _empty_list(folder):
    (folder / integrity.CHECKSUM_FILE).write_text('{"files": {}}')


def _described_as(change):
    def harm(folder):
        meta = folder / "meta/metadata"
        meta.write_text(change(json.loads(meta.read_text())))
        _reseal(folder)
    return harm


@pytest.mark.parametrize("harm, reason", [
    (_empty_list, "lists nothing of meta/"), (_without_variables, "lists nothing of variables/"),
    (_described_as(lambda meta: "{"), "description in meta/ cannot be read"),
    (_described_as(lambda meta: "[]"), "is a list, not an object"),
    (_described_as(lambda meta: json.dumps({"schema_version": 1})), "lacks config, data_state, packages"),
])
def test_what_describes_no_checkpoint_is_damage(tmp_path, fresh, config, harm, reason):
    keeper = _save(tmp_path, fresh, config, 1, 2)
    harm(tmp_path / "checkpoints/2")
    restored, loaded = keeper.restore_latest(fresh, config), checkpoint.load_run(tmp_path)
    assert restored.step == loaded.step == 1
    assert reason in restored.warnings[0] and reason in loaded.warnings[0]
    with pytest.raises(checkpoint.CheckpointError, match=reason):
        checkpoint.load_run(tmp_path, 2)


def test_variables_of_another_model_than_that_of_the_config_are_refused(tmp_path, fresh, config, monkeypatch):
    _save(tmp_path, fresh, config, 1).close()
    other = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, 2)), fresh.variables)
    monkeypatch.setattr(world_model.WorldModel, "variable_shapes", lambda self: other)
    with pytest.raises(checkpoint.CheckpointError, match=r"\['norm'\]\['mean'\] is \[3\], .* config has \[3, 2\]"):
        checkpoint.load_run(tmp_path)
    monkeypatch.setattr(world_model.WorldModel, "variable_shapes", lambda self: {"params": {"more": jnp.zeros(1)}})
    with pytest.raises(checkpoint.CheckpointError, match=r"\['more'\] is missing, .* has \[1\] there"):
        checkpoint.load_run(tmp_path)


def test_folders_that_no_save_named_are_no_checkpoints(tmp_path, fresh, config):
    _save(tmp_path, fresh, config, 1).close()
    for name in ("\u00b2", "007", "\u0663", "old"):
        (tmp_path / "checkpoints" / name).mkdir()
    assert checkpoint.load_run(tmp_path).step == 1
