"""Packing: what comes out is what went in, and nothing is lost by kills, damage or a second packer."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import recording_writers as writers

from muvo_jax.data import plain, records, schema, shards, sources

ROOT = pathlib.Path(__file__).parents[2]


def frames_of(recording):
    return [recording.read(sequence, index) for sequence in recording.sequences for index in range(sequence.length)]


def assert_same(left, right):
    assert left.keys() == right.keys()
    for name in left:
        assert np.asarray(left[name]).dtype == np.asarray(right[name]).dtype
        np.testing.assert_array_equal(left[name], right[name])


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return writers.write_plain(tmp_path_factory.mktemp("eine Straße mit Leerzeichen") / "Aufnahme ä")


@pytest.fixture
def packed(source, tmp_path):
    out = tmp_path / "gepackt ü"
    assert shards.pack(source, out, frames_per_shard=5, workers=1)
    return out


def test_every_frame_and_the_description_come_back(source, packed):
    before, after = plain.PlainRecording(source), sources.open_recording(packed)
    assert isinstance(after, records.PackedRecording)
    assert after.sequences == before.sequences
    for name in ("camera", "lidar", "voxels", "contract", "modalities", "splits", "rate_hz", "name"):
        assert getattr(after.description, name) == getattr(before.description, name)
    for left, right in zip(frames_of(before), frames_of(after), strict=True):
        assert_same(left, right)
    last = after.sequences[-1]
    np.testing.assert_array_equal(after.action(last, 3), before.action(last, 3))


def test_machines_share_the_shards(source, packed, tmp_path):
    assert not shards.pack(source, tmp_path / "two", frames_per_shard=5, machine=1, machines=2, workers=1)
    with pytest.raises(schema.DataError, match="manifest"):
        records.PackedRecording(tmp_path / "two")
    assert shards.pack(source, tmp_path / "two", frames_per_shard=5, machine=0, machines=2, workers=1)
    assert (tmp_path / "two/manifest.json").read_text() == (packed / "manifest.json").read_text()


def test_a_killed_packer_loses_only_the_shard_it_was_writing(source, packed, tmp_path):
    out = tmp_path / "killed"
    code = ("import time, sys\nfrom muvo_jax.data import shards, records\n"
            "encode = records.encode_frame\n"
            "def slow(*arguments):\n    time.sleep(0.05)\n    return encode(*arguments)\n"
            "records.encode_frame = slow\n"
            f"shards.pack({str(source)!r}, {str(out)!r}, frames_per_shard=5, workers=1)\n")
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    while not (out / "shard-00001.json").exists() and process.poll() is None:
        time.sleep(0.01)
    with pytest.raises(BlockingIOError, match="another process is packing"):
        shards.pack(source, out, frames_per_shard=5, workers=1)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not (out / "manifest.json").exists()
    kept = (out / "shard-00000.arrayrecord").stat().st_mtime_ns
    assert shards.pack(source, out, frames_per_shard=5, workers=1)
    assert (out / "shard-00000.arrayrecord").stat().st_mtime_ns == kept
    assert json.loads((out / "manifest.json").read_text()) == json.loads((packed / "manifest.json").read_text())


def test_other_settings_do_not_mix(source, packed):
    with pytest.raises(FileExistsError, match="other settings"):
        shards.pack(source, packed, frames_per_shard=6, workers=1)


def test_a_truncated_shard_is_named_and_counted(packed):
    path = packed / "shard-00001.arrayrecord"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(schema.DataError, match=r"shard-00001.*1 of 5 shards"):
        sources.open_recording(packed)
    with pytest.warns(schema.DataWarning, match=r"1 of 5 shards are damaged and skipped, 5 of 24 frames.*shard-00001"):
        recording = sources.open_recording(packed, skip_corrupt_shards=True)
    assert len(frames_of(recording)) == 19


def test_flipped_bytes_are_found(packed):
    """In the middle of a frame: at reading by default, at opening where damaged shards are skipped."""
    path = packed / "shard-00000.arrayrecord"
    content = bytearray(path.read_bytes())
    middle = content.index(b"PNG") + 40
    content[middle] ^= 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(schema.DataError, match=r"shard-00000.arrayrecord, record 0: damaged"):
        frames_of(sources.open_recording(packed))
    with pytest.warns(schema.DataWarning, match="checksum does not fit"):
        assert len(frames_of(sources.open_recording(packed, skip_corrupt_shards=True))) == 19


def test_records_are_not_unpickled_and_lossy_ones_are_smaller(source):
    frame = plain.PlainRecording(source).read(plain.PlainRecording(source).sequences[0], 0)
    rng = np.random.default_rng(0)
    frame["image"] = rng.integers(0, 255, (32, 64, 3), np.uint8)
    frame["points_m"] = rng.uniform(-60, 60, (500, 3)).astype(np.float32)
    exact = records.encode_frame(frame, records.Encoding())
    assert_same(records.decode_frame(exact, "here"), frame)
    lossy = records.encode_frame(frame, records.Encoding(jpeg_quality=80, half_points=True))
    assert len(lossy) < 0.8 * len(exact)
    np.testing.assert_allclose(records.decode_frame(lossy, "here")["points_m"], frame["points_m"], atol=0.032)
    with pytest.raises(ValueError):
        records.encode_frame({"image": np.array([{}], object)}, records.Encoding())
