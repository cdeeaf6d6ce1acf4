"""Descriptions and names of other people's kinds: what cannot be is refused by name, small slips are read."""

import re

import numpy as np
import pytest
import recording_writers as writers

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import files, fitting, schema, sources
from muvo_jax.data.plain import reader as plain_reader


@pytest.mark.parametrize(("changes", "message"), [
    ({"rate_hz": "0"}, "rate_hz is 0.0; it must be above 0"),
    ({"rate_hz": "nan"}, "rate_hz is nan"),
    ({"rate_hz": "true"}, "rate_hz is True, expected a number"),
    ({"splits": '["train", "train"]'}, "splits is .*expected a list of different names"),
    ({"splits": "[1]"}, "splits is .*expected a list of different names"),
    ({"width_px": "0"}, "camera.width_px is 0; it must be at least 1"),
    ({"width_px": "true"}, "camera.width_px: got True, expected int"),
    ({"height_px": '"32"'}, "camera.height_px: got '32', expected int"),
    ({"intrinsics": "[[nan, 0, 32], [0, 32, 16], [0, 0, 1]]"}, "camera.intrinsics is .*it must be finite"),
    ({"intrinsics": "[[0, 0, 32], [0, 32, 16], [0, 0, 1]]"}, "camera.intrinsics have fx = 0 for 64 pixels"),
    ({"intrinsics": "[[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]]"}, "camera.intrinsics have fx = 0.5 for 64 pixels"),
    ({"intrinsics": "[[32, 0, 32000], [0, 32, 16], [0, 0, 1]]"}, "camera.intrinsics have cx = 32000"),
    ({"intrinsics": "[[32, 0, 32], [0, 32, 16], [0, 0, 0]]"}, r"camera.intrinsics are .*\[0, 0, 1\]\] in pixels"),
    ({"camera_to_ego": "[[0, 0, 2, 1], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]]"}, "camera_to_ego is .*a rotation"),
    ({"camera_to_ego": "[[0, 0, 1, 1500], [-1, 0, 0, 0], [0, -1, 0, 1600], [0, 0, 0, 1]]"},
     r"camera_to_ego puts the camera at \[1500.0, 0.0, 1600.0\]; each coordinate must be .* m"),
    ({"camera_to_ego": "[[0, 0, 1, 1], [1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]]"}, "camera_to_ego is .*a rotation"),
    ({"elevation_min_rad": "-25.0"}, "lidar.elevation_min_rad is -25.0; it must be .* rad"),
    ({"elevation_min_rad": "0.4"}, "lidar.elevation_min_rad is 0.4; it must be below elevation_max_rad, 0.1"),
    ({"rows": "0"}, "lidar.rows is 0"),
    ({"rows": "64.5"}, "lidar.rows: got 64.5, expected int"),
    ({"position_m": "[0.5, 0, 2000]"}, r"lidar.position_m is .*; it must be at least -30 and at most 30 m"),
    ({"voxel_size_m": "-1"}, "voxels.voxel_size_m is -1.0; it must be above 0"),
    ({"shape": "[16, 0, 16]"}, "voxels.shape is .*at least 1"),
    ({"accel_full_mps2": "0"}, "action.accel_full_mps2 is 0.0; it must be above 0"),
    ({"rate_hz": "1" + "0" * 400}, "rate_hz is a whole number of more than 64 bits; it must be at least -2"),
    ({"rate_hz": "1" + "0" * 5000}, "not valid TOML .*4300 digits"),
    ({"rate_hz": "0x1" + "0" * 5000}, "rate_hz is a whole number of more than 64 bits"),
    ({"accel_full_mps2": "1" + "0" * 400}, "action.accel_full_mps2 is a whole number of more than 64 bits"),
    ({"shape": f"[16, {2**63}, 16]"}, r"voxels.shape\[1\] is a whole number of more than 64 bits"),
    ({"source": '"measured"'}, "action.source: 'measured' is unknown"),
])
def test_descriptions_that_cannot_be_are_refused_by_name(tmp_path, changes, message):
    with pytest.raises(schema.DataError, match=f"recording.toml.*{message}"):
        plain_reader.PlainRecording(writers.write_plain(tmp_path, {"train/a": 2}, **changes))


def spoil(old, new):
    def change(root):
        for table in root.glob("*/*/frames.csv"):
            assert old in table.read_text()
            table.write_text(table.read_text().replace(old, new))
    return change


def rename_folder(old, new):
    return lambda root: (root / old).rename(root / new)


@pytest.mark.parametrize(("change", "header", "message"), [
    (spoil("\n1,0.1,", "\n1_0,0.1,"), {}, "line 3: frame_id is '1_0', expected a whole number"),
    (spoil("\n1,0.1,", "\n\u0661,0.1,"), {}, "line 3: frame_id is '\u0661', expected a whole number"),
    (spoil("5.5", "5_5.0"), {}, "line 2: speed_mps is '5_5.0', expected a finite number"),
    (rename_folder("train/a/image", "train/a/Image"), {}, "train/a/Image: expected the name image. Rename"),
    (rename_folder("train", "Train"), {}, "Train: expected the name train, as recording.toml says. Rename"),
    (rename_folder("train/a/lidar", "train/a/LIDAR"), {}, "train/a/LIDAR: expected the name lidar. Rename"),
    (lambda root: None, {"splits": '["train", "../other"]'}, "splits has '../other', expected names of folders"),
    (lambda root: None, {"splits": '["train", "/etc"]'}, "splits has '/etc', expected names of folders"),
    (lambda root: None, {"splits": '["train", ".."]'}, "splits has '..', expected names of folders"),
])
def test_names_and_numbers_that_only_python_or_one_system_takes_are_refused(tmp_path, change, header, message):
    root = writers.write_plain(tmp_path, {"train/a": 2}, **header)
    change(root)
    with pytest.raises(schema.DataError, match=re.escape(message)):
        sources.open_recording(root)


def test_a_kitti_folder_in_another_case_and_an_array_that_calls_itself_an_archive_are_named(tmp_path):
    drive = writers.write_kitti(tmp_path / "kitti", 3)
    (drive / "image_02").rename(drive / "Image_02")
    with pytest.raises(schema.DataError, match=r"Image_02: expected the name image_02\. Rename the folder"):
        sources.open_recording(drive)
    with (tmp_path / "0.npz").open("wb") as file:
        np.save(file, np.zeros((5, 3), np.float32))
    with pytest.raises(schema.DataError, match=r"0.npz: a single array \(NPY\) under the name of an NPZ file"):
        files.read_npz(tmp_path / "0.npz", "points_m")


def test_one_rate_is_said_once(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 30}, rate_hz="20")
    assert plain_reader.PlainRecording(root).description.contract.rate_hz == 20.0  # the section does not say one
    path = root / "recording.toml"
    path.write_text(path.read_text().replace("[action]\n", "[action]\nrate_hz = 10.0\n"))
    with pytest.raises(schema.DataError, match=r"rate_hz is 20, but action.rate_hz is 10: a step would last two times"):
        plain_reader.PlainRecording(root)


def test_a_description_with_a_byte_order_mark_and_one_with_a_slip(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 2})
    path = root / "recording.toml"
    text = path.read_text()
    path.write_text("\ufeff" + text, encoding="utf-8")
    assert plain_reader.PlainRecording(root).description.name == "test"
    path.write_text(text.replace("[voxels]", "[voxel]"))
    with pytest.raises(schema.DataError, match=r"'voxel' is unknown. Did you mean voxels\?"):
        plain_reader.PlainRecording(root)


def test_route_maps_have_the_scale_that_the_recording_says(tmp_path):
    root = writers.write_plain(tmp_path, {"train/a": 30, "val_rl/b": 30})
    assert plain_reader.PlainRecording(root).description.route_map == config_lib.RouteMap()
    with (root / "recording.toml").open("a") as file:
        file.write("[route_map]\nmetres_per_px = 0.5\nego_row = 60\n")
    config = fitting.adapt(presets.tiny(), plain_reader.PlainRecording(root)).config
    assert config.data.route_map == config_lib.RouteMap(0.5, 60.0, 32.0)
