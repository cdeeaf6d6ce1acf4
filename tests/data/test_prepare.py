"""From raw frames to model inputs, and from presets to recordings."""

import copy
import dataclasses

import numpy as np
import pytest
import recording_writers as writers

from muvo_jax import config as config_lib
from muvo_jax import evaluate, presets
from muvo_jax.data import fitting, prepare, schema
from muvo_jax.data.kitti import reader as kitti_reader
from muvo_jax.data.plain import reader as plain_reader


@pytest.fixture
def kitti_recording(tmp_path):
    return kitti_reader.KittiRecording(writers.write_kitti(tmp_path, frames=24))


@pytest.fixture
def plain_recording(tmp_path):
    return plain_reader.PlainRecording(writers.write_plain(tmp_path))


def with_description(recording, **changes):
    changed = copy.copy(recording)
    changed.description = dataclasses.replace(recording.description, **changes)
    return changed


def test_kitti_gives_the_town_preset_its_sensors(kitti_recording):
    config, notes = fitting.adapt(presets.get("town"), kitti_recording)
    # 128x48 scaled to 256 columns has 96 rows, a multiple of 32
    assert config.model.image_size == (96, 256)
    lidar = config.model.range_view
    preset = presets.get("town").model.range_view
    # 2048 beams in 128 columns are 16 in each, too few of which a memory would hold
    assert (lidar.rows, lidar.columns) == (preset.rows, 2 * preset.columns)
    assert any("range views have 256 columns instead of 128" in note for note in notes)
    kept, _ = fitting.adapt(presets.get("town"), kitti_recording, keep={"model.range_view.columns"})
    assert kept.model.range_view.columns == preset.columns
    assert lidar.position_m == (0.0, 0.0, 1.73) and lidar.elevation_max_rad == kitti_reader.LIDAR.elevation_max_rad
    assert config.model.voxels == presets.get("town").model.voxels
    assert not config.model.route and config.model.speed
    assert config.contract.source == "derived"
    assert any("no occupancy is recorded" in note for note in notes)


@pytest.mark.parametrize(("rows", "fitted"), [(16, 32), (32, 32), (33, 64), (40, 64), (64, 64), (128, 64)])
def test_range_views_have_no_rows_that_no_beam_fills(kitti_recording, rows, fitted):
    lidar = dataclasses.replace(kitti_recording.description.lidar, rows=rows)
    other = with_description(kitti_recording, lidar=lidar)
    config, notes = fitting.adapt(presets.get("town"), other)
    assert config.model.range_view.rows == fitted  # the preset has 64, and networks take multiples of 32
    said = f"range views have {fitted} rows instead of 64: the lidar has {rows}, and more would be empty."
    assert (said in notes) == (fitted < 64)
    assert fitting.adapt(config, other).config == config
    for keep in ({"model.range_view.rows"}, fitting.OF_TRAINED):
        assert fitting.adapt(presets.get("town"), other, keep=keep).config.model.range_view.rows == 64
    trained = fitting.adapt(presets.get("town"), other, keep=fitting.OF_TRAINED).config.model.range_view
    assert trained.columns == presets.get("town").model.range_view.columns


def test_a_short_recording_gets_short_windows(kitti_recording):
    config, notes = fitting.adapt(presets.get("town"), kitti_recording)  # 16 frames train, 8 validate
    data = config.data
    assert (data.stride, data.context, data.horizon, data.frames) == (1, 4, 4, 8)
    assert any("short recording" in note and "16 frames" in note for note in notes)
    assert fitting.adapt(config, kitti_recording).config == config


def test_windows_of_a_trained_run_do_not_change_in_silence(kitti_recording):
    run = config_lib.override_all(fitting.adapt(presets.get("town"), kitti_recording).config, {
        "data.stride": 2, "data.context": 6})
    with pytest.warns(schema.DataWarning, match=r"judged with stride=1 \(2\), context=4 \(6\), in brackets"):
        evaluate.fit(run, kitti_recording, ())
    with pytest.warns(schema.DataWarning, match="judged with stride=1"):  # also where its training split is not read
        evaluate.fit(run, kitti_recording, (), splits=("val",))


def test_windows_beyond_a_long_recording_are_refused(tmp_path):
    recording = kitti_reader.KittiRecording(writers.write_kitti(tmp_path, frames=180))  # 120 frames train, 60 validate
    run = config_lib.override(fitting.adapt(presets.get("town"), recording).config, "data.horizon", 40)
    with pytest.raises(schema.DataError, match="60 frames, but a window of"):
        evaluate.fit(run, recording, ("data.horizon",), splits=("val",))


def test_what_the_user_chose_is_kept(kitti_recording):
    preset = config_lib.override(presets.get("town"), "data.context", 2)
    data = fitting.adapt(preset, kitti_recording, keep={"data.context"}).config.data
    assert (data.context, data.horizon) == (2, 4)


def test_windows_that_fit_stay(plain_recording):
    assert fitting.adapt(presets.get("tiny"), plain_recording).config.data == presets.get("tiny").data


def test_sequences_shorter_than_the_window(tmp_path):
    recording = plain_reader.PlainRecording(writers.write_plain(tmp_path, {"train/a": 9, "val_rl/b": 7}))
    with pytest.raises(schema.DataError, match="'val_rl' has 7 frames, but a window of 8 frames at stride 1 needs 8"):
        fitting.adapt(presets.get("town"), recording)
    keep = {"data.frames": 8, "data.stride": 2}
    with pytest.raises(schema.DataError, match="'train' has 9 frames, but a window of 8 frames at stride 2 needs 15"):
        fitting.adapt(config_lib.override_all(presets.get("town"), keep), recording, keep=keep)


def test_recorded_voxels_route_and_contract_are_used(plain_recording):
    config, _ = fitting.adapt(presets.get("tiny"), plain_recording)
    assert config.model.voxels == plain_recording.description.voxels
    assert config.model.route and config.model.range_view.position_m == (0.5, 0.0, 2.0)
    frame = prepare.prepare_frame(plain_recording.read(plain_recording.sequences[0], 3), config)
    assert (frame["image"] == 3).all() and frame["image"].shape == (32, 64, 3)
    assert frame["range_view"].shape == (32, 64, 4) and frame["range_view"].dtype == np.float32
    assert (frame["occupancy"] == 255).all() and (frame["route_map"] == 3).all()
    assert frame["reward"] == 1.0 and not frame["is_terminal"]


def test_a_small_recorded_grid_gets_a_shallower_voxel_decoder(plain_recording):
    config, notes = fitting.adapt(presets.get("paper-occupancy"), plain_recording)
    assert config.model.latent.occupancy_blocks == 1 and any("voxel decoder" in note for note in notes)
    odd = config_lib.VoxelGrid(shape=(20, 16, 16))
    with pytest.raises(schema.DataError, match=r"20x16x16 .*multiple of 8"):
        fitting.adapt(presets.get("tiny"), with_description(plain_recording, voxels=odd))


def test_what_every_model_needs(plain_recording):
    for lacking in ({"points_m", "image"}, {"action"}):
        without = plain_recording.description.modalities - lacking
        with pytest.raises(schema.DataError, match="every model needs actions and, with their sensor's description"):
            fitting.adapt(presets.get("tiny"), with_description(plain_recording, modalities=without))


def test_a_model_without_the_sensor_that_a_recording_lacks(plain_recording):
    tiny, modalities = presets.get("tiny"), plain_recording.description.modalities
    blind = with_description(plain_recording, modalities=modalities - {"image", "intrinsics"}, camera=None)
    config, notes = fitting.adapt(tiny, blind)
    assert config.model.camera is None and config.model.lidar == tiny.model.lidar
    assert config.model.heads == ("range_view", "occupancy", "action")
    assert "no images are recorded: the model has no camera input and no head image." in notes
    assert fitting.adapt(config, blind).config == config
    raw = plain_recording.read(plain_recording.sequences[0], 0)
    assert not {"image", "intrinsics", "camera_to_ego"} & prepare.prepare_frame(raw, config).keys()

    config, _ = fitting.adapt(tiny, with_description(plain_recording, modalities=modalities - {"points_m"}))
    assert config.model.camera == tiny.model.camera and config.model.lidar is None
    assert config.model.heads == ("image", "occupancy", "action")  # occupancy is recorded
    config, notes = fitting.adapt(tiny, with_description(plain_recording, modalities=modalities - {
        "points_m", "occupancy"}, lidar=None, voxels=None))
    assert config.model.heads == ("image", "action")
    assert "no lidar scans are recorded: the model has no lidar input and no head occupancy, range_view." in notes
    raw.pop("points_m")
    assert "range_view" not in prepare.prepare_frame(raw, config)
    with pytest.raises(schema.DataError, match="lacks camera: nothing is left to see"):
        fitting.adapt(config_lib.override(tiny, "model.lidar", "none"), blind)


def test_a_flat_image_is_taken_wider_than_the_preset(kitti_recording):
    config, notes = fitting.adapt(presets.get("tiny"), kitti_recording)
    # 128x48 has 24 rows at the preset's 64 columns and 36 at 96
    assert config.model.image_size == (32, 96) and any("become 96x32" in note for note in notes)


def test_the_scan_makes_the_occupancy_where_none_is_recorded(kitti_recording):
    config, _ = fitting.adapt(presets.get("tiny"), kitti_recording)
    raw = kitti_recording.read(kitti_recording.sequences[0], 0)
    raw["points_m"] = np.array([[9.0, 0.1, 1.73]], np.float32)
    occupancy = prepare.prepare_frame(raw, config)["occupancy"]
    # Voxels of 2 m from (-16, -16, -3): the ray runs along row y 8, layer z 2, from x 8 (lidar) to x 12 (the point).
    assert occupancy[12, 8, 2] == 1
    np.testing.assert_array_equal(occupancy[8:12, 8, 2], 0)
    assert (occupancy == 255).sum() == occupancy.size - 5


def test_the_intrinsics_follow_the_image(tmp_path, kitti_recording):
    config, _ = fitting.adapt(config_lib.override(presets.get("town"), "model.image_size", (64, 192)), kitti_recording)
    assert config.model.image_size == (64, 192)  # 128x48 -> 192x72, 8 rows cut off at the top
    frame = prepare.prepare_frame(kitti_recording.read(kitti_recording.sequences[0], 0), config)
    assert frame["image"].shape == (64, 192, 3)
    np.testing.assert_allclose(frame["intrinsics"], [[105, 0, 96], [0, 105, 36 - 8], [0, 0, 1]], rtol=1e-6)


@pytest.mark.parametrize(("chosen", "value"), [
    ("contract.accel_full_mps2", 9.0), ("contract.wheelbase_m", 1.0), ("model.voxels.voxel_size_m", 0.7),
    ("model.range_view.position_m", [0.0, 0.0, 9.0])])
def test_what_a_recording_says_cannot_be_set_otherwise(plain_recording, chosen, value):
    asked = config_lib.override(presets.tiny(), chosen, value)
    with pytest.raises(schema.DataError, match=rf"{chosen}.* is set to .*, but recording .* says .*Leave the setting"):
        fitting.adapt(asked, plain_recording, keep=(chosen,))
    fitted = fitting.adapt(asked, plain_recording).config
    assert fitting.adapt(fitted, plain_recording, keep=(chosen, "contract.step_action")).config == fitted


def test_a_frame_that_does_not_fit_is_named(plain_recording):
    config, _ = fitting.adapt(presets.get("tiny"), plain_recording)
    raw = plain_recording.read(plain_recording.sequences[0], 2)
    raw["image"] = raw["image"][:8]
    with pytest.raises(schema.DataError, match="frame 2: image of 8x64"):
        prepare.prepare_frame(raw, config)
    raw = plain_recording.read(plain_recording.sequences[0], 2)
    raw["occupancy"] = raw["occupancy"][:8]
    with pytest.raises(schema.DataError, match=r"frame 2: occupancy has shape \[8, 16, 16\]"):
        prepare.prepare_frame(raw, config)


def test_a_head_that_the_recording_cannot_teach_is_refused_by_name(kitti_recording):
    preset = presets.get("tiny")
    config = dataclasses.replace(preset, model=dataclasses.replace(preset.model, heads=("image", "birds_eye")))
    with pytest.raises(schema.DataError, match=r"head 'birds_eye' learns from birds_eye.* \(--heads=image\)"):
        fitting.check_targets(config, kitti_recording.description)
