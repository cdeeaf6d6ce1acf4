"""KITTI folders of other people's kinds: what is found, what is refused by name."""

import shutil

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax.data import schema, sources
from muvo_jax.data.kitti import reader as kitti_reader


def kitti_bytes(drive, name, change):
    path = drive / name
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize("name", [lambda k: f"{k:010d}.jpg", lambda k: f"{k:010d}.JPG", lambda k: f"{k:06d}.png"])
def test_kitti_pictures_may_be_jpeg_upper_case_or_padded_otherwise(tmp_path, name):
    drive = writers.write_kitti(tmp_path)
    for path in sorted((drive / "image_02/data").iterdir()):
        target = path.with_name(name(int(path.stem)))
        image = Image.open(path)
        image.load()
        path.unlink()
        image.save(target, quality=95) if target.suffix.lower() == ".jpg" else image.save(target)
    recording = sources.open_recording(drive)
    assert recording.description.camera is not None
    assert np.abs(recording.read(recording.sequences[0], 3)["image"].astype(int) - 30).max() <= 2


@pytest.mark.parametrize(("name", "change", "message"), [
    ("oxts/data/0000000000.txt", lambda c: b"\xef\xbb\xbf" + c, None),
    ("oxts/data/0000000000.txt", lambda c: c.replace(b"10.0", b"1000.0", 1), r"forward speed \(number 9\) is 1000"),
    ("oxts/data/0000000000.txt", lambda c: b"91 " + c.split(b" ", 1)[1], r"latitude .* is 91; .* degrees"),
    ("velodyne_points/data/0000000000.bin", lambda c: (np.frombuffer(c, np.float32) * 100).tobytes(),
     r"reflectance lies between 0 and 1"),
    ("velodyne_points/data/0000000000.bin", lambda c: (np.frombuffer(c, np.float32).reshape(-1, 4)
                                                        * np.float32([1e6, 1e6, 1e6, 1])).tobytes(), "points_m has"),
    ("../calib_cam_to_cam.txt", lambda c: c.replace(b"P_rect_02: 70.0", b"P_rect_02: 0.0"), "make no camera"),
    ("../calib_velo_to_cam.txt", lambda c: c.replace(b"T: 0 -0.08 -0.3", b"T: 0 -80 -300"), "make no camera: .*puts"),
])
def test_kitti_numbers_that_cannot_be_are_refused(tmp_path, name, change, message):
    drive = writers.write_kitti(tmp_path)
    kitti_bytes(drive, name, change)
    if message is None:
        recording = kitti_reader.KittiRecording(drive)
        assert recording.read(recording.sequences[0], 0)["speed_mps"] == 10.0
        return
    with pytest.raises(schema.DataError, match=message):
        recording = kitti_reader.KittiRecording(drive)
        recording.read(recording.sequences[0], 0)


def test_one_drive_with_more_takes_no_drive_away(tmp_path):
    drive = writers.write_kitti(tmp_path)
    for number in (100, 101):
        other = drive.with_name(f"2011_09_26_drive_0{number}_sync")
        shutil.copytree(drive, other)
        shutil.rmtree(other / "velodyne_points")
    with pytest.warns(schema.DataWarning, match="only 1 of 3 drives have velodyne_points: it is not used"):
        recording = kitti_reader.KittiRecording(tmp_path)
    assert len({sequence.name for sequence in recording.sequences}) == 3 and recording.description.lidar is None
