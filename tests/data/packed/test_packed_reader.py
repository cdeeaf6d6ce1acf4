"""Packing: what comes out is what went in, and nothing is lost by kills, damage or a second packer."""

import contextlib
import io
import json
import os
import pathlib
import pickle
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib

import numpy as np
import pytest
import recording_writers as writers
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from muvo_jax.data import schema, sources
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.packed import records
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import reader as plain_reader

ROOT = pathlib.Path(__file__).parents[3]


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
    assert packed_writer.pack(source, out, frames_per_shard=5, workers=1)
    return out


def test_every_frame_and_the_description_come_back(source, packed):
    before, after = plain_reader.PlainRecording(source), sources.open_recording(packed)
    assert isinstance(after, packed_reader.PackedRecording)
    assert after.sequences == before.sequences
    for name in ("camera", "lidar", "voxels", "contract", "modalities", "splits", "rate_hz", "name"):
        assert getattr(after.description, name) == getattr(before.description, name)
    for left, right in zip(frames_of(before), frames_of(after), strict=True):
        assert_same(left, right)
    last = after.sequences[-1]
    np.testing.assert_array_equal(after.action(last, 3), before.action(last, 3))


def test_machines_share_the_shards(source, packed, tmp_path):
    assert not packed_writer.pack(source, tmp_path / "two", frames_per_shard=5, machine=1, machines=2, workers=1)
    with pytest.raises(schema.DataError, match="manifest"):
        packed_reader.PackedRecording(tmp_path / "two")
    assert packed_writer.pack(source, tmp_path / "two", frames_per_shard=5, machine=0, machines=2, workers=1)
    assert (tmp_path / "two/manifest.json").read_text() == (packed / "manifest.json").read_text()


def test_a_killed_packer_loses_only_the_shard_it_was_writing(source, packed, tmp_path):
    out = tmp_path / "killed"
    code = ("import time, sys\nfrom muvo_jax.data.packed import records, writer\n"
            "encode = records.encode_frame\n"
            "def slow(*arguments):\n    time.sleep(0.05)\n    return encode(*arguments)\n"
            "records.encode_frame = slow\n"
            f"writer.pack({str(source)!r}, {str(out)!r}, frames_per_shard=5, workers=1)\n")
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    while not (out / "shard-00001.json").exists() and process.poll() is None:
        time.sleep(0.01)
    with pytest.raises(BlockingIOError, match="another process is packing"):
        packed_writer.pack(source, out, frames_per_shard=5, workers=1)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not (out / "manifest.json").exists()
    kept = (out / "shard-00000.arrayrecord").stat().st_mtime_ns
    assert packed_writer.pack(source, out, frames_per_shard=5, workers=1)
    assert (out / "shard-00000.arrayrecord").stat().st_mtime_ns == kept
    assert json.loads((out / "manifest.json").read_text()) == json.loads((packed / "manifest.json").read_text())


def test_other_settings_do_not_mix(source, packed):
    with pytest.raises(FileExistsError, match="other settings"):
        packed_writer.pack(source, packed, frames_per_shard=6, workers=1)


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


def test_shards_that_were_exchanged_are_no_frames_of_other_runs(packed):
    """They are of one size, and every record is whole."""
    first, second = (packed / f"shard-0000{number}.arrayrecord" for number in (0, 1))
    assert first.stat().st_size == second.stat().st_size
    first.rename(packed / "aside")
    second.rename(first)
    (packed / "aside").rename(second)
    with pytest.raises(schema.DataError, match=r"shard-00000.arrayrecord, record 0: .*it is row 5 of run train/a, not "
                                               r"row 0 of run train/a: were shards exchanged"):
        frames_of(sources.open_recording(packed))
    with pytest.warns(schema.DataWarning, match="2 of 5 shards are damaged and skipped, 10 of 24 frames"):
        recording = sources.open_recording(packed, skip_corrupt_shards=True)
    assert len(frames_of(recording)) == 14


@pytest.mark.parametrize("order", [[1, 0, 2, 3, 4], [0, 0, 2, 3, 4]], ids=["exchanged", "twice"])
def test_a_manifest_names_its_shards_in_their_order(packed, order):
    content = json.loads((packed / "manifest.json").read_text())
    content["shards"] = [content["shards"][number] for number in order]
    (packed / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(schema.DataError, match=r"shards\[\d\]: file is shard-0000\d\S*, expected shard-0000"):
        packed_reader.PackedRecording(packed)


def test_records_are_not_unpickled_and_lossy_ones_are_smaller(source):
    frame = plain_reader.PlainRecording(source).read(plain_reader.PlainRecording(source).sequences[0], 0)
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


def test_more_shards_than_a_process_may_open(source, tmp_path):
    out = tmp_path / "many"
    assert packed_writer.pack(source, out, frames_per_shard=1, workers=1)
    code = ("import resource, sys\nfrom muvo_jax.data.packed import reader\n"
            "reader._OPEN_READERS = 4\nrecording = reader.PackedRecording(sys.argv[1])\n"
            "resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))\n"
            "for _ in range(2):\n    for sequence in recording.sequences:\n"
            "        for index in range(sequence.length):\n            recording.read(sequence, index)\n")
    done = subprocess.run([sys.executable, "-c", code, str(out)], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)},
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_readers_are_bounded_and_closed(source, tmp_path, monkeypatch):
    assert packed_writer.pack(source, tmp_path / "out", frames_per_shard=1, workers=1)
    monkeypatch.setattr(packed_reader, "_OPEN_READERS", 3)
    recording = packed_reader.PackedRecording(tmp_path / "out")
    before = len(os.listdir("/proc/self/fd"))
    first = frames_of(recording)
    assert len(os.listdir("/proc/self/fd")) - before <= 3
    recording.close()
    assert len(os.listdir("/proc/self/fd")) == before
    for left, right in zip(first, frames_of(pickle.loads(pickle.dumps(recording))), strict=True):
        assert_same(left, right)


def test_several_workers_write_what_one_writes(source, packed, tmp_path):
    progress = []
    assert packed_writer.pack(source, tmp_path / "two", frames_per_shard=5, workers=2,
                              progress=lambda *counts: progress.append(counts))
    assert (tmp_path / "two/manifest.json").read_text() == (packed / "manifest.json").read_text()
    assert progress[-1] == (24, 24)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_the_same_from_one_worker_and_from_several(source, tmp_path, workers):
    broken = shutil.copytree(source, tmp_path / "broken")
    (broken / "train/b/lidar/000003.npz").write_bytes(b"nothing")
    with pytest.raises(schema.DataError, match=r"000003.npz: not a readable NPZ file"):
        packed_writer.pack(broken, tmp_path / "out", frames_per_shard=5, workers=workers)
    assert not (tmp_path / "out/manifest.json").exists()


def test_a_full_disk_is_told_and_complete_shards_are_kept(source, tmp_path):
    recording, out = shutil.copytree(source, tmp_path / "copy"), tmp_path / "out"
    points_m = np.random.default_rng(0).uniform(-50, 50, (20_000, 3)).astype(np.float32)
    np.savez(recording / "train/b/lidar/000002.npz", points_m=points_m)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"shard-00002.arrayrecord: cannot be written \(.*too large.* kept"):
            packed_writer.pack(recording, out, frames_per_shard=5, workers=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    kept = (out / "shard-00001.arrayrecord").stat().st_mtime_ns
    assert packed_writer.pack(recording, out, frames_per_shard=5, workers=1)
    assert (out / "shard-00001.arrayrecord").stat().st_mtime_ns == kept


def test_a_corrected_source_packs_anew_what_it_touches(source, tmp_path):
    recording, out = shutil.copytree(source, tmp_path / "copy"), tmp_path / "out"
    assert packed_writer.pack(recording, out, frames_per_shard=4, workers=1)
    times = {path.name: path.stat().st_mtime_ns for path in out.glob("*.arrayrecord")}
    corrected = np.full((16, 16, 16), 1, np.uint8)
    np.savez(recording / "train/b/occupancy/000002.npz", occupancy=corrected)
    assert packed_writer.pack(recording, out, frames_per_shard=4, workers=1)
    changed = {name for name, time_ns in times.items() if (out / name).stat().st_mtime_ns != time_ns}
    # Run a has 10 frames, b the next 6: shards of 4 that hold some of b are 2 and 3.
    assert changed == {"shard-00002.arrayrecord", "shard-00003.arrayrecord"}
    assert any(np.array_equal(frame["occupancy"], corrected) for frame in frames_of(packed_reader.PackedRecording(out)))
    (recording / "val_rl/c/image/000007.png").unlink()  # one frame less: the last shard is shorter
    with pytest.warns(schema.DataWarning):
        assert packed_writer.pack(recording, out, frames_per_shard=4, workers=1)
    assert len(frames_of(packed_reader.PackedRecording(out))) == 23


@pytest.mark.parametrize("place", [".", "inside", ".."])
def test_source_and_target_lie_apart(source, tmp_path, place):
    recording = shutil.copytree(source, tmp_path / "there/copy")
    with pytest.raises(ValueError, match="lie in one another"):
        packed_writer.pack(recording, recording / place, workers=1)


def test_the_camera_is_chosen(tmp_path):
    drive = writers.write_kitti(tmp_path)
    shutil.copytree(drive / "image_02", drive / "image_00")
    calibration = drive.parent / "calib_cam_to_cam.txt"
    assert packed_writer.pack(drive, tmp_path / "out", camera="image_00", workers=1)
    assert calibration.is_file()
    left, right = sources.open_recording(drive, camera="image_00"), sources.open_recording(tmp_path / "out")
    assert left.description.camera == right.description.camera
    with pytest.raises(FileExistsError, match="other settings"):
        packed_writer.pack(drive, tmp_path / "out", camera="image_02", workers=1)


def test_labels_are_packed_and_left_out_where_nobody_asks(source, tmp_path):
    recording = shutil.copytree(source, tmp_path / "copy")
    for image in recording.glob("*/*/image/*.png"):
        folder = image.parents[1] / "depth"
        folder.mkdir(exist_ok=True)
        Image.fromarray(np.full((32, 64), 500, np.uint16)).save(folder / image.name)
    assert packed_writer.pack(recording, tmp_path / "out", workers=1)
    with_labels = sources.open_recording(tmp_path / "out", labels=schema.LABELS)
    expected = sources.open_recording(recording, labels=schema.LABELS)
    assert with_labels.description.modalities == expected.description.modalities >= {"depth_m"}
    for left, right in zip(frames_of(expected), frames_of(with_labels), strict=True):
        assert_same(left, right)
    assert packed_writer.pack(recording, tmp_path / "without", labels=False, workers=1)
    assert "depth_m" not in sources.open_recording(tmp_path / "without", labels=schema.LABELS).description.modalities
    without = sources.open_recording(tmp_path / "out")
    assert "depth_m" not in without.description.modalities | frames_of(without)[0].keys()


_LEAVES = st.sampled_from([None, True, -1, 0, 3, 2**63, 10**30, 1.5, float("nan"), "", "../x", [], [[]], {}, {"a": 1},
                           "shard-00000.arrayrecord"])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_malformed_manifest_is_a_data_error(packed, data):
    content = json.loads((packed / "manifest.json").read_text())
    node = content
    while isinstance(node, dict | list) and node:
        key = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(len(node))))
        child = node[key]
        if not isinstance(child, dict | list) or not child or data.draw(st.booleans()):
            break
        node = child
    if data.draw(st.booleans()) and isinstance(node, dict):
        del node[key]
    else:
        node[key] = data.draw(_LEAVES)
    folder = packed.with_name("fuzzed")
    if not folder.exists():
        shutil.copytree(packed, folder)
    (folder / "manifest.json").write_text(json.dumps(content))
    with contextlib.suppress(schema.DataError):
        frames_of(packed_reader.PackedRecording(folder))


def test_a_manifest_that_claims_more_than_there_is_takes_no_memory(packed):
    content = json.loads((packed / "manifest.json").read_text())
    content["frames_per_shard"] = 10**12
    content["shards"] = content["shards"][:1]
    content["shards"][0]["frames"] = content["sequences"][0]["length"] = 10**12
    content["sequences"] = content["sequences"][:1]
    (packed / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(schema.DataError, match="frames in"):
        packed_reader.PackedRecording(packed)


def record_of(fields, content):
    """A record with a true checksum, whatever its header claims."""
    text = json.dumps(fields).encode()
    body = struct.pack("<I", len(text)) + text + content
    return body + struct.pack("<I", zlib.crc32(body))


@pytest.mark.parametrize("field", [
    {"dtype": "<f8", "shape": [10**6, 10**6], "encoding": "zlib"},
    {"dtype": "<f4", "shape": [4], "encoding": "zlib"},
    {"dtype": "|u1", "shape": [4, 4, 3], "encoding": "png"},
    {"dtype": "|u1", "shape": [4, 4, 3], "encoding": "recorded RGB"},
    {"dtype": "|u1", "shape": [4, 4], "encoding": "recorded None"},
    {"dtype": "|O", "shape": [1], "encoding": "raw"},
    {"dtype": "<f4", "shape": [-1], "encoding": "raw"},
    {"dtype": "nonsense", "shape": [1], "encoding": "raw"},
    {"dtype": "<f4", "shape": None, "encoding": "raw"},
])
def test_records_that_lie_are_data_errors_and_take_no_memory(field):
    bomb = zlib.compress(bytes(50_000_000), 9)
    record = record_of([{"name": "image", "bytes": len(bomb)} | field], bomb)
    tracemalloc.start()
    with pytest.raises(schema.DataError, match="here: damaged"):
        records.decode_frame(record, "here")
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()
    for header in ("text", 3, [3], [None], {"a": 1}):
        with pytest.raises(schema.DataError, match="here: damaged"):
            records.decode_frame(record_of(header, b""), "here")


def picture(suffix, size=(8, 6)):
    content = io.BytesIO()
    Image.radial_gradient("L").resize(size).convert("RGB").save(content, suffix)
    return content.getvalue()


@pytest.mark.parametrize("encoding", ["recorded RGB", "recorded L", "recorded classes", "recorded depth_m", "png"])
@pytest.mark.parametrize("suffix", ["png", "jpeg"])
def test_spoilt_bytes_of_pictures_are_data_errors(suffix, encoding):
    """Whatever their checksum says: changed, cut short, of another size or of a format that is not packed."""
    rng, whole = np.random.default_rng(0), picture(suffix)
    contents = [whole[:length] for length in range(0, len(whole), 40)]
    contents += [picture(suffix, (9, 6)), picture(suffix, (4000, 4000)), picture("bmp"),
                 b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\nshowpage\n"]
    for _ in range(60):
        spoilt = np.frombuffer(whole, np.uint8).copy()
        spoilt[rng.integers(0, len(spoilt), 3)] = rng.integers(0, 256, 3)
        contents.append(spoilt.tobytes())
    shape, dtype = ([6, 8, 3], "|u1") if encoding in ("recorded RGB", "png") else (
        [6, 8], "<f4" if "depth" in encoding else "|u1")
    refused = 0
    for content in contents:
        field = {"name": "image", "dtype": dtype, "shape": shape, "encoding": encoding, "bytes": len(content)}
        try:
            array = records.decode_frame(record_of([field], content), "here")["image"]
            assert array.shape == tuple(shape) and array.dtype == np.dtype(dtype)
        except schema.DataError as error:
            assert "here: damaged" in str(error)
            refused += 1
    assert refused >= 5


def test_a_spoilt_entry_of_a_shard_is_written_anew(source, packed):
    for content in ("", "[]", "[" * 100_000, '{"file": "../x"}', "null"):
        (packed / "shard-00001.json").write_text(content)
        assert packed_writer.pack(source, packed, frames_per_shard=5, workers=1)
        assert len(frames_of(packed_reader.PackedRecording(packed))) == 24
