"""KITTI folders of other people's kinds: what is found, what is refused by name."""

import datetime
import io
import shutil

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax.data import schema, sources
from muvo_jax.data.checkup import examination
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


def stored(root, number):
    """A drive in a folder whose name says nothing of it, with calibration beside it; pictures show their number."""
    drive = writers.write_kitti(root / f"disk{number}")
    moved = drive.parent.rename(root / f"disk{number}/store") / drive.name
    return moved.rename(moved.with_name("sync"))


def test_linked_drives_are_named_as_they_are_called_here(tmp_path):
    date = tmp_path / "rec/2011_09_26"
    date.mkdir(parents=True)
    for number in (1, 2):
        (date / f"2011_09_26_drive_000{number}_sync").symlink_to(stored(tmp_path, number))
    recording = sources.open_recording(tmp_path / "rec")
    assert {sequence.name for sequence in recording.sequences} == {
        "2011_09_26_drive_0001_sync", "2011_09_26_drive_0002_sync"}
    (date / "2011_09_30_drive_0033_sync").symlink_to(tmp_path / "disk1/store/sync")
    tested = sources.open_recording(date / "2011_09_30_drive_0033_sync")
    assert [(sequence.split, sequence.name) for sequence in tested.sequences] == [
        ("test", "2011_09_30_drive_0033_sync")]
    with pytest.raises(schema.DataError, match=r"drives 2011_09_26_\S+ and 2011_09_30_\S+ are one"):
        sources.open_recording(date)


def test_a_link_to_a_drive_may_be_called_otherwise(tmp_path):
    (tmp_path / "mine").symlink_to(writers.write_kitti(tmp_path))
    assert sources.open_recording(tmp_path / "mine").description.name == writers.DRIVE


def test_calibration_is_looked_for_beside_the_link_first(tmp_path):
    target = stored(tmp_path, 1)
    date = tmp_path / "rec/2011_09_26"
    date.mkdir(parents=True)
    (date / writers.DRIVE).symlink_to(target)
    place_m = lambda: np.array(sources.open_recording(date).description.camera.camera_to_ego)[:3, 3]
    np.testing.assert_allclose(place_m(), [0.3, 0.1, 1.65], atol=1e-6)  # of the target's, where there is no other
    for path in target.parent.glob("calib_*.txt"):
        (date / path.name).write_text(path.read_text().replace("T: 0 -0.08 -0.3", "T: 0 -0.08 -0.5"))
    np.testing.assert_allclose(place_m(), [0.5, 0.1, 1.65], atol=1e-6)


def test_two_folders_of_one_drive_are_refused(tmp_path):
    drive = writers.write_kitti(tmp_path)
    copy = shutil.copytree(drive.parent, tmp_path / "backup")
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / drive.name).symlink_to(drive)
    with pytest.raises(schema.DataError, match=rf"2011_09_26/{drive.name} and .*backup/{drive.name} are both drive"):
        sources.open_recording(tmp_path)
    shutil.rmtree(copy)
    for _ in range(2):
        assert len(sources.open_recording(tmp_path).sequences) == 2  # one training, one validating
        for path in drive.parent.glob("calib_*.txt"):  # to where only the link is
            path.rename(tmp_path / "links" / path.name)


@pytest.mark.parametrize(("step_s", "message"), [
    (3600, r"image_02/timestamps.txt: frames are 3600 s apart, expected at least 0.001 and at most 10 s"),
    (1e-6, r"image_02/timestamps.txt: frames are [\d.e-]+ s apart, expected at least 0.001"),
    (0.5, None)])
def test_time_stamps_that_are_no_drives_are_refused_by_name(tmp_path, step_s, message):
    drive = writers.write_kitti(tmp_path)
    start = datetime.datetime(2011, 9, 26, 13, 2, 25)
    stamps = [start + datetime.timedelta(seconds=frame * step_s) for frame in range(writers.FRAMES)]
    (drive / "image_02/timestamps.txt").write_text("\n".join(f"{stamp:%Y-%m-%d %H:%M:%S.%f}" for stamp in stamps))
    if message is None:
        assert kitti_reader.KittiRecording(drive).description.rate_hz == 2.0
        return
    with pytest.raises(schema.DataError, match=message):
        kitti_reader.KittiRecording(drive)


@pytest.mark.parametrize("name", ["velodyne_points/data/0000000003.bin", "oxts/data/0000000003.txt"])
def test_a_file_that_may_not_be_read_is_counted_and_the_rest_examined(tmp_path, name, monkeypatch):
    path = writers.write_kitti(tmp_path) / name
    opened = io.open

    def refusing(file, *arguments, **options):  # as the system does, but root as well
        if file == path:
            raise PermissionError(13, "Permission denied", str(path))
        return opened(file, *arguments, **options)

    monkeypatch.setattr(io, "open", refusing)
    checkup = examination.examine(sources.open_recording(tmp_path), frames=0, workers=1)
    told = [finding.text for finding in checkup.findings if path.name in finding.text]
    assert len(told) == 1 and "Permission denied" in told[0] and "11 of 12 frames" in checkup.facts["read"]


def test_a_drive_of_another_rate_is_warned_of(tmp_path):
    whole = writers.write_kitti(tmp_path)
    for number in (100, 101):
        thinned = whole.parent / f"2011_09_26_drive_0{number}_sync"
        shutil.copytree(whole, thinned)
        times = [f"2011-09-26 13:02:{25 + frame / 5:012.9f}" for frame in range(writers.FRAMES)]
        (thinned / "image_02/timestamps.txt").write_text("\n".join(times) + "\n")
    told = rf"{whole.name}: frames follow each other after 0\.1 s, .* after 0\.2 s"
    with pytest.warns(schema.DataWarning, match=told):
        sources.open_recording(tmp_path)


def test_a_few_pictures_take_no_scan_away(tmp_path):
    drive = writers.write_kitti(tmp_path)
    whole = drive.with_name("2011_09_26_drive_0100_sync")
    shutil.copytree(drive, whole)
    for path in sorted((drive / "image_02/data").iterdir())[1:]:
        path.unlink()
    shutil.copy(drive / "image_02/timestamps.txt", drive / "velodyne_points")
    with pytest.warns(schema.DataWarning, match=r"only 1 of 12 frames have a file in image_02, which is not used"):
        recording = sources.open_recording(drive)
    assert sum(sequence.length for sequence in recording.sequences) == 12 and recording.description.camera is None
    with (pytest.warns(schema.DataWarning, match="only 1 of 12 frames"),
          pytest.warns(schema.DataWarning, match=r"image_02/data: too few files, .* The drive is left out")):
        recording = sources.open_recording(tmp_path)
    assert {sequence.name for sequence in recording.sequences} == {whole.name}
