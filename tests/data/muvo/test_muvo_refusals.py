"""Runs of the MUVO layout whose table or pictures hold what cannot be."""

import tracemalloc

import numpy as np
import pytest
from PIL import Image

from muvo_jax.data import schema
from muvo_jax.data.muvo import frame_pickle
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs


def write_table(folder, **changes):
    """A run of three rows and their pictures; `changes` replace or add columns."""
    (folder / "image").mkdir(parents=True)
    for number in range(3):
        Image.fromarray(np.full((32, 64, 3), number, np.uint8)).save(folder / f"image/image_{number:09d}.png")
    columns = {"action": [np.array([0.3, 0.1, 0.0], np.float32)] * 3, "speed": [np.array([8.0], np.float32)] * 3,
               "reward": np.ones(3), "image_path": [f"image/image_{number:09d}.png" for number in range(3)]}
    (folder / muvo_runs.FRAME_FILE).write_bytes(frame_pickle.frame(columns | changes))
    return folder


def nested(times, levels):
    """A list of lists of ... numbers, each of them one object that is referred to again and again."""
    cell = 0.5
    for _ in range(levels):
        cell = [cell] * times
    return cell


@pytest.mark.parametrize(("cell", "message"), [
    (nested(300, 3), r"column 'action' does not hold 3 real numbers a frame \(found a list of 300\)"),
    (nested(3, 2), r"does not hold 3 real numbers a frame \(found a list of 3\)"),
    (["1", "2", "3"], "does not hold 3 real numbers"),
    (np.zeros(3, np.complex64), r"does not hold 3 real numbers a frame \(found complex\d+\)"),
    (np.zeros(2, np.float32), "does not hold 3 real numbers"),
    (np.float32([0, 0, -1]), r"row 1: brake is -1, expected 0 to 1"),
    (np.float32([-0.5, 0, 0]), r"row 1: throttle is -0.5, expected 0 to 1"),
    (np.float32([40, 0, 0]), r"row 1: throttle is 40, expected 0 to 1"),
])
def test_actions_that_cannot_be_are_refused(tmp_path, cell, message):
    tracemalloc.start()
    try:
        run = write_table(tmp_path / "0000", action=[[0.3, 0.1, 0.0], cell, np.float32([0.3, 0.1, 0.0])])
        with pytest.raises(schema.DataError, match=message):
            muvo_reader.MuvoRecording(run, skipped_s=0.0)
        assert tracemalloc.get_traced_memory()[1] < 20e6  # bytes
    finally:
        tracemalloc.stop()


def test_cells_may_be_lists_numbers_and_pedals_a_rounding_beyond_their_ends(tmp_path):
    run = write_table(tmp_path / "0000", speed=[8.0, [8], np.float64([8.0])],
                      action=[[0, 0.1, np.float32(1.0005)], (1.0005, 0.1, 0), np.float64([-0.0005, 0.1, 0.5])])
    recording = muvo_reader.MuvoRecording(run, skipped_s=0.0)
    actions = np.array([recording.action(recording.sequences[0], index) for index in range(3)])
    np.testing.assert_allclose(actions, [[-1.0005, 0.1], [1.0005, 0.1], [-0.5, 0.1]], rtol=1e-6)


def test_a_path_that_is_a_list_is_refused_without_writing_it_out(tmp_path):
    run = write_table(tmp_path / "0000", image_path=[nested(300, 3)] * 3)
    with pytest.raises(schema.DataError, match="row 0: image_path is a list, expected a path inside the run"):
        muvo_reader.MuvoRecording(run)


@pytest.fixture
def labelled(tmp_path):
    """A run whose pictures of depth and classes have the size of its images, 64x32."""
    run = write_table(tmp_path / "0000", depth_semantic_path=[f"depth_semantic/{number}.png" for number in range(3)],
                      birdview_path=[f"birdview/{number}.png" for number in range(3)])
    for kind, pixels in (("depth_semantic", np.full((32, 64, 4), 7, np.uint8)),
                         ("birdview", np.ones((192, 192), np.uint16))):
        (run / kind).mkdir()
        for number in range(3):
            Image.fromarray(pixels).save(run / kind / f"{number}.png")
    (run / "sensors.toml").write_text("tags = \"0.9.13\"\n")
    return run


@pytest.mark.parametrize(("kind", "pixels", "message"), [
    ("depth_semantic", np.zeros((32, 32, 4), np.uint8), "1.png: 32x32 pixels, but the camera's images have 64x32"),
    ("birdview", np.full((192, 192), 1 << 8, np.uint16), "1.png: its numbers reach from 256 to 256, .* 8 bits"),
    ("birdview", np.ones((40, 50), np.uint16), r"1.png: an image \[40, 50\] of .*, expected \[192, 192\]"),
])
def test_labels_are_of_the_size_of_what_they_label(labelled, kind, pixels, message):
    recording = muvo_reader.MuvoRecording(labelled, skipped_s=0.0, labels=schema.LABELS)
    Image.fromarray(pixels).save(labelled / kind / "1.png")
    frame = recording.read(recording.sequences[0], 0)
    assert frame["depth_m"].shape == frame["image_classes"].shape == (32, 64) and "birds_eye_classes" in frame
    with pytest.raises(schema.DataError, match=message):
        recording.read(recording.sequences[0], 1)
