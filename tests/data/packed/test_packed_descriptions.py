"""What the manifest of a pack says of its frames: types, what contradicts them, and what half precision cannot hold."""

import json
import shutil

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax.data import processes, schema
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.packed import records
from muvo_jax.data.packed import writer as packed_writer


@pytest.mark.parametrize(("change", "message"), [
    ({"rate_hz": None}, "rate_hz is None, expected"), ({"rate_hz": "10"}, "rate_hz is '10', expected"),
    ({"rate_hz": 0}, "rate_hz is 0.0; it must be"), ({"rate_hz": 20.0}, "rate_hz is 20, but contract.rate_hz is 10"),
    ({"splits": [1]}, "splits is .1., expected a list of different names"), ({"name": 5}, "name is 5, expected str"),
    ({"classes": [1, 2]}, "classes is .1, 2., expected a list of text"),
    ({"notes": "one"}, "notes is one, expected a list of text"),
    ({"modalities": ["image", "radar"]}, "modalities has radar, which are no recorded fields")])
def test_a_description_of_other_types_is_a_data_error(tmp_path, change, message):
    assert packed_writer.pack(writers.write_plain(tmp_path / "source"), tmp_path / "out", workers=1)
    path = tmp_path / "out/manifest.json"
    content = json.loads(path.read_text())
    content["description"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(schema.DataError, match=f"manifest.json: .*{message}"):
        packed_reader.PackedRecording(tmp_path / "out")


def test_frames_are_as_large_as_the_description_says(tmp_path):
    assert packed_writer.pack(writers.write_plain(tmp_path / "source"), tmp_path / "out", workers=1)
    path = tmp_path / "out/manifest.json"
    content = json.loads(path.read_text())
    content["description"]["camera"]["width_px"] = 96
    path.write_text(json.dumps(content))
    recording = packed_reader.PackedRecording(tmp_path / "out")
    with pytest.raises(schema.DataError, match=r"record 0: shape \[32, 64, 3\] of image, expected \[32, 96, 3\]"):
        recording.read(recording.sequences[0], 0)


def test_points_beyond_half_precision_are_refused(tmp_path):
    root = writers.write_plain(tmp_path / "source", {"train/a": 3})
    np.savez(root / "train/a/lidar/000001.npz", points_m=np.full((5, 3), 70000.0, np.float32))
    with pytest.raises(ValueError, match="points_m has a coordinate of 70000 m; float16 ends at 65504 m"):
        packed_writer.pack(root, tmp_path / "half", encoding=records.Encoding(half_points=True), workers=1)


def test_pictures_of_another_date_may_have_another_size(tmp_path):
    """As KITTI's have, each with its calibration."""
    source = tmp_path / "kitti"
    drive = writers.write_kitti(source)
    later = source / "2011_09_28"
    shutil.copytree(drive, later / "2011_09_28_drive_0001_sync")
    shutil.copy(drive.parent / "calib_velo_to_cam.txt", later)
    calibration = (drive.parent / "calib_cam_to_cam.txt").read_text()
    (later / "calib_cam_to_cam.txt").write_text(calibration.replace("1.280000e+02 4.800000e+01", "124 46").replace(
        f"{writers.FOCAL}", "71.5"))
    for path in later.glob("*/image_02/data/*"):
        Image.open(path).crop((0, 0, 124, 46)).save(path)
    assert packed_writer.pack(source, tmp_path / "out", workers=1)
    recording = packed_reader.PackedRecording(tmp_path / "out")
    sizes = {sequence.name: recording.read(sequence, 0)["image"].shape for sequence in recording.sequences}
    assert sizes == {drive.name: (48, 128, 3), "2011_09_28_drive_0001_sync": (46, 124, 3)}


def test_packing_again_leaves_the_manifest_where_it_is(tmp_path, monkeypatch):
    source = writers.write_plain(tmp_path / "source")
    assert packed_writer.pack(source, tmp_path / "out", workers=1)
    was_there = []
    shards = packed_writer._shards
    monkeypatch.setattr(packed_writer, "_shards", lambda *arguments: was_there.append(
        (tmp_path / "out/manifest.json").is_file()) or shards(*arguments))
    assert packed_writer.pack(source, tmp_path / "out", workers=1)
    assert was_there == [True]


def test_who_divides_the_shards_otherwise_waits(tmp_path):
    source = writers.write_plain(tmp_path / "source")
    (tmp_path / "out").mkdir()
    with processes.locked(tmp_path / "out/.packing-1-of-3", "packing"):
        with pytest.raises(BlockingIOError, match="another process is packing here now"):
            packed_writer.pack(source, tmp_path / "out", machine=0, machines=2, workers=1)
        assert not packed_writer.pack(source, tmp_path / "out", machine=0, machines=3, frames_per_shard=4, workers=1)
