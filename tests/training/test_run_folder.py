"""The folder of a run: what is refused, what a crash or a full disk leaves, and what TensorBoard reads."""

import json
import os

import pytest
from tensorboardX.proto import event_pb2

from muvo_jax import presets
from muvo_jax.training import run_folder


@pytest.fixture(scope="module")
def config():
    return presets.tiny()


def records_of(folder):
    return [(record["kind"], record["step"]) for record in run_folder.read_metrics(folder)]


def test_run_folder_refuses_what_exists_and_forgets_later_records(tmp_path, config):
    run_folder.create(tmp_path / "run", config, "again")
    assert run_folder.read_config(tmp_path / "run") == config
    with pytest.raises(FileExistsError, match="Go on with it:  again"):
        run_folder.create(tmp_path / "run", config, "again")
    files = run_folder.RunFolder(tmp_path / "run")
    for step in (1, 2, 3):
        files.log({"kind": "train", "step": step, "total": float("nan") if step == 2 else 1.0})
    files.close()
    assert run_folder.forget_after(tmp_path / "run", 2) == 1
    assert [record["total"] for record in run_folder.read_metrics(tmp_path / "run")] == [1.0, None]
    with pytest.raises(FileNotFoundError, match="no run to go on with"):
        run_folder.read_config(tmp_path / "other")


def test_a_record_after_a_line_that_was_cut_short_is_whole(tmp_path):
    (tmp_path / "metrics.jsonl").write_bytes(
        b'{"kind": "train", "step": 1}\n3\n{"a": 1}\n\xff\n{"kind": "train", "step": 2, "to')
    files = run_folder.RunFolder(tmp_path, first_step=1)
    files.log({"kind": "train", "step": 2})
    files.close()
    assert records_of(tmp_path) == [("train", 1), ("train", 2)]


def test_a_full_disk_is_told_with_the_file_and_how_to_go_on(tmp_path):
    os.symlink("/dev/full", tmp_path / "metrics.jsonl")
    files = run_folder.RunFolder(tmp_path)
    with pytest.raises(OSError, match=r"metrics\.jsonl cannot be written \(No space left on device\)\. .*--resume"):
        files.log({"kind": "train", "step": 1})
    files.close()


def test_a_disk_that_is_full_of_events_ends_the_run_instead_of_waiting(tmp_path, monkeypatch):
    files = run_folder.RunFolder(tmp_path)
    monkeypatch.setattr(files._events, "flush", lambda: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    for step in range(30):  # more than any queue holds
        with pytest.raises(OSError, match="cannot be written"):
            files.log({"kind": "train", "step": step, "total": 1.0})
    files.close()


def test_tensorboard_reads_every_finite_number_once(tmp_path):
    files = run_folder.RunFolder(tmp_path, first_step=3)
    files.log({"kind": "validation", "split": "val_rl", "step": 3, "total": 0.5, "bad": float("nan")})
    files.close()
    (path,) = tmp_path.glob("events.out.tfevents.*")
    content, events = path.read_bytes(), []
    while content:  # length, its checksum, the event, its checksum
        size = int.from_bytes(content[:8], "little")
        events.append(event_pb2.Event.FromString(content[12:12 + size]))
        content = content[16 + size:]
    assert events[0].file_version == "brain.Event:2"
    assert [event.step for event in events if event.session_log.status == event_pb2.SessionLog.START] == [3]
    (event,) = [event for event in events if event.summary.value]
    assert event.step == 3 and event.wall_time > 1e9
    assert [(value.tag, value.simple_value) for value in event.summary.value] == [("validation/val_rl/total", 0.5)]


def test_a_folder_that_cannot_be_made_is_told_at_once(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file is a file, so that .* cannot be made: choose another --runs-dir"):
        run_folder.check_new(tmp_path / "file" / "runs" / "a", "again")
    run_folder.check_new(tmp_path / "not" / "yet" / "there", "again")
    assert not (tmp_path / "not").exists()


@pytest.mark.parametrize(("content", "message"), [
    (b"[]", r"config\.json: config: got \[\]"), (b"\xff", r"config\.json is not valid JSON"),
    (json.dumps(presets.tiny().to_dict() | {"foo": 1}).encode(), r"config\.json: .*'foo' is unknown")])
def test_a_config_that_cannot_be_understood_is_named(tmp_path, content, message):
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        run_folder.read_config(tmp_path)
