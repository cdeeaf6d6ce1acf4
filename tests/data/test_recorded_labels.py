"""Targets of the optional heads, from the town through its recording to a batch, and from the MUVO layout."""

import dataclasses

import numpy as np
import pytest
import recording_samples as samples

from muvo_jax import head as head_lib
from muvo_jax import presets
from muvo_jax.data import fitting, pipeline, prepare, schema
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.ops import camera, range_view
from muvo_jax.town import boxes, record, settings
from muvo_jax.town.simulator import Town

HEADS = ("image", "depth", "semantic_image", "semantic_range_view", "birds_eye")
CONFIG = dataclasses.replace(presets.tiny(), model=dataclasses.replace(presets.tiny().model, heads=HEADS),
                             loss=dataclasses.replace(presets.tiny().loss, image_instance=0.05))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """One run of the town, recorded for these heads."""
    folder = tmp_path_factory.mktemp("town")
    town_config = settings.from_config(CONFIG)
    record.describe(folder, town_config, ("train",))
    for _ in record.record_run(folder, Town(town_config), record.TownDrive("train", "000_day", 7, "clear_noon", 8)):
        pass
    return plain_reader.PlainRecording(folder, labels=prepare.labels(CONFIG))


def test_the_town_teaches_every_optional_head(recording):
    fitting.check_targets(CONFIG, recording.description)
    model = fitting.adapt(dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, stride=1)), recording)
    assert model.config.model.semantic_classes == len(boxes.CLASSES) == CONFIG.model.semantic_classes
    batch = pipeline.Frames(recording, model.config).batch([pipeline.windows_lib.Window(
        recording.sequences[0], 0, 2, 1)])
    for field, shape in head_lib.targets(CONFIG).items():
        assert getattr(batch, field).shape == (1, 2, *shape)
    raw = recording.read(recording.sequences[0], 0)
    # A scan hits what the camera sees there: points in view have the class of their pixel, but for edges.
    uv_px, depth_m = camera.project_to_image(raw["points_m"], raw["intrinsics"], raw["camera_to_ego"])
    height, width = raw["image_classes"].shape
    seen = (depth_m > 0) & (uv_px >= 0).all(axis=1) & (uv_px < (width, height)).all(axis=1)
    column, row = np.floor(uv_px[seen]).astype(int).T
    assert (raw["image_classes"][row, column] == raw["point_classes"][seen]).mean() > 0.9
    view = range_view.project(raw["points_m"], CONFIG.model.range_view)
    np.testing.assert_array_equal(batch.range_view_classes[0, 0] == prepare.UNLABELLED, view[..., 3] < 0)
    road_users = np.isin(batch.image_classes, (boxes.VEHICLE, boxes.PEDESTRIAN))
    assert batch.image_instance_mask.dtype == bool and road_users.any() and batch.image_moving_mask is None
    np.testing.assert_array_equal(batch.image_instance_mask, road_users)
    sky = batch.image_classes[0, 0] == boxes.SKY
    assert sky.any() and (batch.depth_m[0, 0][sky] == -1).all() and batch.depth_m.max() <= prepare.DEPTH_LIMIT_M


def test_a_depth_of_zero_is_no_target(recording):
    raw = recording.read(recording.sequences[0], 0)
    raw["depth_m"] = np.full_like(raw["depth_m"], 5.0)
    raw["depth_m"][:, :8] = 0.0
    depth_m = prepare.prepare_frame(raw, CONFIG)["depth_m"]
    assert set(np.unique(depth_m)) == {-1.0, 5.0}


def test_scores_are_told_where_road_users_move_and_training_is_not(recording):
    config = fitting.adapt(dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, stride=1)),
                           recording).config
    frames, window = pipeline.Frames(recording, config), pipeline.windows_lib.Window(recording.sequences[0], 0, 2, 1)
    assert not {name for name, value in vars(frames.batch([window])).items() if value is not None and "moving" in name}
    batch = frames.batch([window], judged=True)
    raw = recording.read(recording.sequences[0], 1)
    np.testing.assert_array_equal(batch.image_moving_mask[0, 1], raw["image_moving_mask"])
    assert batch.occupancy_moving_mask is None  # the model has no occupancy head


def test_the_ground_plan_holds_the_road_and_whole_vehicles(recording):
    frames = [recording.read(sequence, index) for sequence in recording.sequences for index in range(sequence.length)]
    grid = CONFIG.model.voxels
    ego = tuple(int(-grid.origin_m[axis] / grid.voxel_size_m) for axis in range(2))
    assert all(frame["birds_eye_classes"][ego] in (1, 2) for frame in frames)  # the expert keeps to the road
    for frame in frames:
        on_it, number = np.isin(frame["birds_eye_classes"], (3, 4)), frame["birds_eye_instances"]
        np.testing.assert_array_equal(number > 0, on_it)
        assert set(np.unique(number)) <= set(range(number.max() + 1))


def test_labels_are_read_only_where_asked_for(recording):
    usual = plain_reader.PlainRecording(next(iter(recording._runs.values())).folder.parents[1])
    assert not schema.LABELS & usual.read(usual.sequences[0], 0).keys()
    with pytest.raises(schema.DataError, match="head 'depth' learns from depth_m"):
        fitting.check_targets(dataclasses.replace(CONFIG, loss=presets.tiny().loss), usual.description)
    with pytest.raises(schema.DataError, match=r"loss\.image_instance is on and learns from image_instance_mask"):
        fitting.check_targets(CONFIG, usual.description)


def test_another_head_does_not_rename_the_recording():
    usual = settings.from_config(presets.tiny())
    assert record.fingerprint(usual, "tiny") != record.fingerprint(dataclasses.replace(usual, labels=True), "tiny")
    assert settings.from_config(CONFIG).labels and not usual.labels


def test_a_nearest_crop_shows_the_pixels_of_the_image():
    ramp = np.broadcast_to(np.arange(64, dtype=np.uint8)[:, None], (64, 128)).copy()
    intrinsics = np.eye(3, dtype=np.float32)
    smooth = camera.resize_crop(np.repeat(ramp[..., None], 3, axis=-1), intrinsics, (16, 64))[0][..., 0]
    nearest = camera.resize_crop_nearest(ramp, (16, 64))
    assert nearest.shape == (16, 64) and np.abs(nearest.astype(int) - smooth).max() <= 1


@pytest.mark.skipif(samples.MUVO_LAYOUT is None, reason="needs a recording in the MUVO layout (MUVO_LAYOUT)")
def test_the_muvo_layout_gives_all_labels():
    recording = muvo_reader.MuvoRecording(samples.MUVO_LAYOUT, labels=schema.LABELS)
    raw = recording.read(recording.sequences[0], 0)
    assert raw.keys() >= schema.LABELS and len(recording.description.classes) == 23
    assert raw["depth_m"].shape == raw["image_classes"].shape == raw["image"].shape[:2]
    assert raw["point_classes"].shape == raw["points_m"].shape[:1]
    np.testing.assert_array_equal(raw["image_instance_mask"], np.isin(raw["image_classes"], (4, 10)))
    plan, grid = raw["birds_eye_classes"], recording.description.voxels
    assert plan.shape == grid.shape[:2] and set(np.unique(plan)) <= {*range(8), 255}
    assert plan[grid.shape[0] // 2, grid.shape[1] // 2] in (1, 2)  # the ego stands on a road
    np.testing.assert_array_equal(raw["birds_eye_instances"] > 0, np.isin(plan, (3, 4)) & (plan != 255))
