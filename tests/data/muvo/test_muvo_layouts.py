"""The MUVO layout as other people leave it: other suffixes and separators, lost rows, tags of newer simulators."""

import dataclasses
import shutil
import warnings

import numpy as np
import pytest
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.data import schema, sources
from muvo_jax.data.carla import recorder as carla_recorder
from muvo_jax.data.muvo import exporter as muvo_exporter
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.muvo import frame_pickle, safe_pickle
from muvo_jax.data.muvo import reader as muvo_reader
from muvo_jax.data.muvo import runs as muvo_runs
from muvo_jax.data.muvo import tags as muvo_tags
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer

FRAMES = 24
# What lies where, in the tags of CARLA up to 0.9.13 and from 0.9.14 on.
OLDER = {"road": 7, "car": 10, "person": 4, "sky": 13, "line": 6}
NEWER = {"road": 1, "car": 14, "person": 12, "sky": 11, "line": 24}


def write_run(folder, *, numbers=range(FRAMES), tags=None, suffix=".png", table_suffix=".png", separator="/",
              kinds=("image",)):
    """One run; every picture of frame k shows k. `tags` adds scans: half road, a quarter cars, a quarter people."""
    for kind in kinds:
        (folder / kind).mkdir(parents=True)
    rows = list(numbers)
    for number in rows:
        if "image" in kinds:
            Image.fromarray(np.full((32, 64, 3), number, np.uint8)).save(folder / f"image/image_{number:09d}{suffix}")
        if tags is not None:
            write_scan(folder, number, tags)
        if "routemap" in kinds:
            Image.fromarray(np.full((192, 192), number, np.uint8)).save(folder / f"routemap/routemap_{number:09d}.png")
    count = len(rows)
    columns = {"action": [np.array([0.3, 0.1, 0.0], np.float32)] * count, "reward": np.ones(count),
               "speed": [np.array([8.0], np.float32)] * count}
    names = {"image": table_suffix, **({"points_semantic": ".npy"} if tags is not None else {}),
             **({"routemap": ".png"} if "routemap" in kinds else {})}
    columns |= {f"{kind}_path": [f"{kind}{separator}{kind}_{number:09d}{ending}" for number in rows]
                for kind, ending in names.items()}
    (folder / muvo_runs.FRAME_FILE).write_bytes(frame_pickle.frame(columns))
    return folder


def write_scan(folder, number, tags):
    (folder / "points_semantic").mkdir(exist_ok=True)
    names = ["road"] * 100 + ["car"] * 50 + ["person"] * 50 + ["line"] * 4
    height_m = np.where(np.isin(names, ("road", "line")), -2.0, -0.5)
    points_m = np.stack([np.linspace(5, 30, len(names)), np.zeros(len(names)), height_m], axis=1).astype(np.float32)
    (folder / f"points_semantic/points_semantic_{number:09d}.npy").write_bytes(frame_pickle.npy_of_dict(
        {"points_xyz": np.asfortranarray(points_m), "ObjTag": np.array([tags[name] for name in names], np.uint8)}))


def layout(root, **run):
    for mode in ("train", "val0"):
        write_run(root / "trainval" / mode / "Town01" / "0000", **run)
    return root


def greys(recording, sequence):
    return [int(recording.read(sequence, index)["image"][0, 0, 0]) for index in range(sequence.length)]


@pytest.mark.parametrize("run", [{"suffix": ".jpg"}, {"suffix": ".PNG"}, {"separator": "\\"}],
                         ids=["JPEG instead of PNG", "upper case", "Windows separators"])
def test_files_are_found_under_other_suffixes_and_separators(tmp_path, run):
    recording = sources.open_recording(layout(tmp_path, **run))
    assert (recording.description.camera.width_px, recording.description.camera.height_px) == (64, 32)
    np.testing.assert_allclose(greys(recording, recording.sequences[0]), range(10, FRAMES), atol=1)


def test_a_folder_that_holds_nothing_that_the_table_names_is_refused(tmp_path):
    with pytest.raises(schema.DataError, match=r"image: holds image_000000000.bmp.*names image_000000000.png"):
        sources.open_recording(layout(tmp_path, suffix=".bmp"))


def test_an_empty_image_folder_is_a_recording_without_a_camera(tmp_path):
    root = layout(tmp_path)
    for path in root.rglob("*.png"):
        path.unlink()
    recording = sources.open_recording(root)
    assert recording.description.camera is None and recording.description.lidar is None
    assert "image" not in recording.read(recording.sequences[0], 0)


def test_lost_rows_are_gaps_and_times_follow_the_files(tmp_path):
    kept = [number for number in range(40) if number % 3]
    with pytest.warns(schema.DataWarning, match="time jumps by more than 1.5 periods at 12 of 26 frames"):
        recording = sources.open_recording(layout(tmp_path, numbers=kept))
    lengths = {sequence.length for sequence in recording.sequences}
    assert lengths == {1, 2}  # the first second ends inside a pair
    sequence = recording.sequences[1]
    assert greys(recording, sequence) == [13, 14]
    assert [recording.read(sequence, k)["timestamp_s"] for k in (0, 1)] == pytest.approx([1.2, 1.3])


def test_rows_in_another_order_are_refused_and_thinned_ones_ask_for_their_rate(tmp_path):
    shuffled = np.random.default_rng(0).permutation(FRAMES).tolist()
    with pytest.raises(schema.DataError, match=r"pd_dataframe.pkl, row \d+: frame \d+ comes after frame \d+.*Sort"):
        sources.open_recording(layout(tmp_path / "shuffled", numbers=shuffled))
    root = layout(tmp_path / "thinned", numbers=range(0, 60, 2))
    with pytest.raises(schema.DataError, match=r"numbered in steps of 2.*say rate_hz = 5 in sensors.toml"):
        sources.open_recording(root)
    (root / "sensors.toml").write_text("rate_hz = 5.0\n")
    recording = sources.open_recording(root)
    assert [(sequence.start, sequence.length) for sequence in recording.sequences] == [(5, 25), (5, 25)]
    assert recording.description.contract.rate_hz == 5.0


@pytest.mark.parametrize("below", ["", "trainval", "trainval/train", "trainval/train/Town01",
                                   "trainval/train/Town01/0000"])
def test_sensors_are_described_in_the_root_whatever_the_path(tmp_path, below):
    root = layout(tmp_path / "rec", tags=OLDER)
    (tmp_path / "sensors.toml").write_text("rate_hz = 99\n")  # of something else
    (root / "sensors.toml").write_text("rate_hz = 20.0\n[lidar]\nposition_m = [0.5, 0.0, 1.5]\n"
                                       "[action]\nkinematics = \"none\"\n[route_map]\nmetres_per_px = 0.25\n")
    described = sources.open_recording(root / below).description
    assert described.rate_hz == described.contract.rate_hz == 20.0 and described.lidar.position_m == (0.5, 0.0, 1.5)


@pytest.mark.parametrize(("text", "message"), [
    ("rate_hz = 20.0\n[action]\nrate_hz = 10.0\n", "rate_hz is 20, but action.rate_hz is 10"),
    ("tags = \"0.9.12\"\n", "tags is '0.9.12', expected"),
    ("rate = 20\n", "'rate' is unknown. Did you mean rate_hz"),
    ("rate_hz = -1\n", "rate_hz is -1.0; it must be above 0"),
])
def test_sensors_that_cannot_be_are_refused(tmp_path, text, message):
    (layout(tmp_path) / "sensors.toml").write_text(text)
    with pytest.raises(schema.DataError, match=f"sensors.toml.*{message}"):
        sources.open_recording(tmp_path)


@pytest.mark.parametrize("tags", [OLDER, NEWER, {**NEWER, "line": 1}], ids=["0.9.13", "0.9.14", "0.9.14 by the road"])
def test_tags_are_recognised_by_what_they_are_and_where(tmp_path, tags):
    recording = sources.open_recording(layout(tmp_path, tags=tags), labels={"point_classes"})
    classes = recording.read(recording.sequences[0], 0)["point_classes"]
    names = [muvo_files.CLASSES[index] for index in classes]
    line = "road line" if tags["line"] != 1 else "road"
    assert names == ["road"] * 100 + ["vehicle"] * 50 + ["pedestrian"] * 50 + [line] * 4


def test_tags_that_do_not_tell_are_not_guessed(tmp_path):
    root = layout(tmp_path, tags=dict.fromkeys(OLDER, 3))
    with pytest.raises(schema.DataError, match=r"may be those of CARLA up to 0.9.13 or of 0.9.14.*Say tags = "):
        sources.open_recording(root, labels={"point_classes"})
    sources.open_recording(root)  # nobody asks for classes
    (root / "sensors.toml").write_text("tags = \"0.9.14\"\n")
    recording = sources.open_recording(root, labels={"point_classes"})
    assert set(recording.read(recording.sequences[0], 0)["point_classes"]) == {muvo_files.LAYOUT_TAGS[3]}
    with pytest.raises(schema.DataError, match="tag 77 is none of CARLA's"):
        sources.open_recording(layout(tmp_path / "wild", tags=OLDER | {"car": 77}), labels={"point_classes"})


def test_sky_and_what_is_occupied_follow_the_tag_set(tmp_path):
    file = tmp_path / "voxel.npy"
    for tag_set, tags in ((muvo_tags.OLDER, OLDER), (muvo_tags.NEWER, NEWER)):
        rows = np.array([[index, 0, 0, tag] for index, tag in enumerate(tags.values())], np.uint16)
        np.save(file, rows)
        occupied = muvo_files.read_voxels(file, muvo_reader.VOXELS,
                                          lambda found, path, chosen=tag_set: muvo_tags.to_layout(found, chosen, path))
        assert occupied[:5, 0, 0].tolist() == [1, 1, 1, 0, 1]
    with pytest.raises(schema.DataError, match="may be those of"):
        muvo_tags.to_layout(np.array([11]), None, file)


def test_one_run_with_more_files_takes_no_run_away(tmp_path):
    root = layout(tmp_path)
    write_run(root / "trainval/train/Town01/0001", tags=OLDER)
    with pytest.warns(schema.DataWarning, match=r"points_m is recorded in 1 of 3 runs"):
        recording = sources.open_recording(root)
    assert [sequence.length for sequence in recording.sequences] == [FRAMES - 10] * 3
    shutil.rmtree(root / "trainval/train/Town01/0001/image")
    with pytest.warns(schema.DataWarning, match=r"image is missing in 1 of 3 runs"):
        recording = sources.open_recording(root)
    assert [sequence.lacks for sequence in recording.sequences] == [(), ("image",), ()]


@pytest.mark.parametrize(("text", "expected"), [
    ("", muvo_reader.ROUTE_MAP),
    ("[route_map]\nmetres_per_px = 0.25\nego_row = 40\nego_column = 30\n", config_lib.RouteMap(0.25, 40.0, 30.0))])
def test_a_pack_keeps_the_scale_of_the_route_maps(tmp_path, text, expected):
    root = layout(tmp_path / "rec", kinds=("image", "routemap"))
    (root / "sensors.toml").write_text(text)
    assert packed_writer.pack(root, tmp_path / "out", workers=1)
    source, packed = sources.open_recording(root), sources.open_recording(tmp_path / "out")
    assert packed.description == dataclasses.replace(source.description, kind="packed MUVO CARLA")
    assert packed.description.route_map == expected and packed.sequences == source.sequences
    sequence = packed.sequences[-1]
    np.testing.assert_array_equal(packed.read(sequence, 3)["route_map"], source.read(sequence, 3)["route_map"])


def test_an_export_says_the_weather_and_the_town_of_each_run(tmp_path):
    source = tmp_path / "source"
    camera = schema.Camera.level(64, 32, 1.5, (1.0, 0.0, 2.0))
    plain_writer.write_description(source, name="CARLA", rate_hz=10, splits=("train", "val_rl"), camera=camera,
                                   lidar=muvo_reader.LIDAR, contract=muvo_reader.CONTRACT, classes=muvo_files.CLASSES,
                                   route_map=muvo_reader.ROUTE_MAP)
    weathers = {"Town03_000": "WetNoon", "Town06_001": "ClearSunset", "mine": ""}
    for run, weather in weathers.items():
        writer = plain_writer.RunWriter(source, "train", run)
        for number in range(3):
            writer.write({"frame_id": number, "timestamp_s": number / 10, "speed_mps": 5.0, "acceleration": 0.1,
                          "steering": 0.0, "weather": weather, "image": np.full((32, 64, 3), number, np.uint8),
                          "depth_m": np.full((32, 64), 5.0), "classes": np.full((32, 64), 10, np.uint8),
                          "points_m": np.ones((4, 3)), "point_tags": np.full(4, 4, np.uint8),
                          "route_map": np.zeros((64, 64), np.uint8)})
        writer.close()
    muvo_exporter.export(source, tmp_path / "out", town="Town05")
    tables = {run.folder.parent.name: safe_pickle.load_table(run.folder / muvo_runs.FRAME_FILE)
              for run in muvo_runs.find_runs(tmp_path / "out")}
    assert {town: set(table["weather"]) for town, table in tables.items()} == {
        "Town03": {"WetNoon"}, "Town06": {"ClearSunset"}, "Town05": {"ClearNoon"}}
    assert {town: set(table["town"]) for town, table in tables.items()} == {town: {town} for town in tables}
    recording = muvo_reader.MuvoRecording(tmp_path / "out", skipped_s=0.0, labels=frozenset(
        {"image_classes", "image_instance_mask", "point_classes"}))
    frame = recording.read(recording.sequences[0], 0)
    assert frame["image_instance_mask"].all() and (frame["point_classes"] == 4).all()


def linked(root, target, *, tone):
    """A run 0001 beside the real 0000 of training that is a link to a folder named 0000, all pictures of one tone."""
    write_run(target)
    for path in (target / "image").iterdir():
        Image.fromarray(np.full((32, 64, 3), tone, np.uint8)).save(path)
    (root / "trainval/train/Town01/0001").symlink_to(target)


def test_linked_runs_are_named_as_they_are_called_here(tmp_path):
    root = layout(tmp_path / "rec")
    linked(root, tmp_path / "elsewhere/Town01/0000", tone=200)
    recording = sources.open_recording(root)
    assert {sequence.name: greys(recording, sequence)[0] for sequence in recording.sequences} == {
        "train/Town01/0000": 10, "train/Town01/0001": 200, "val0/Town01/0000": 10}


def test_a_link_to_a_mode_is_that_mode_by_its_name_or_its_target(tmp_path):
    root = layout(tmp_path / "rec")
    for name, target in (("mine", root / "trainval/val0"), ("val1", root / "trainval/train")):
        (tmp_path / name).symlink_to(target)
    assert sources.open_recording(tmp_path / "mine").description.splits == ("val0",)
    assert sources.open_recording(tmp_path / "val1").description.splits == ("val1",)


@pytest.mark.parametrize(("link", "target", "name"), [("val0", "train", "val0/Town01/0000"),
                                                      ("train/Town01/0001", "0000", "train/Town01/0001")])
def test_one_folder_under_two_modes_or_names_is_refused(tmp_path, link, target, name):
    trainval = layout(tmp_path) / "trainval"
    shutil.rmtree(trainval / "val0")
    (trainval / link).symlink_to(target)
    with pytest.raises(schema.DataError, match=f"train/Town01/0000 and {name} are one folder, "):
        sources.open_recording(tmp_path)


def test_two_runs_of_one_name_are_refused(tmp_path):
    for name in ("monday", "tuesday"):
        write_run(tmp_path / name / "train/Town01/0000")
    with pytest.raises(schema.DataError, match=r"monday/.*0000 and .*tuesday/.*0000 are both run train/Town01/0000"):
        sources.open_recording(tmp_path)


def test_a_damaged_file_that_nobody_reads_takes_nothing_away(tmp_path):
    root = layout(tmp_path, tags=OLDER)
    for run in root.glob("trainval/*/*/*"):
        columns = dict(safe_pickle.load_table(run / muvo_runs.FRAME_FILE))
        columns["depth_semantic_path"] = [f"depth_semantic/{number}.png" for number in range(FRAMES)]
        (run / muvo_runs.FRAME_FILE).write_bytes(frame_pickle.frame(columns))
        (run / "depth_semantic").mkdir()
        for name in (*columns["depth_semantic_path"], columns["image_path"][0], columns["points_semantic_path"][6]):
            (run / name).write_bytes(b"half")  # of a kind that is not asked for, and in the first second
    recording = sources.open_recording(root, labels={"point_classes"})
    assert recording.description.camera.width_px == 64
    assert set(recording.read(recording.sequences[0], 0)["point_classes"]) == set(OLDER.values()) - {OLDER["sky"]}
    for scan in root.glob("trainval/*/*/*/points_semantic/*"):
        scan.write_bytes(b"half")
    with pytest.raises(schema.DataError, match=r"points_semantic_000000006.npy"):
        sources.open_recording(root, labels={"point_classes"})


def test_tags_beyond_a_byte_are_no_tags(tmp_path):
    root = layout(tmp_path, tags=OLDER)
    for path in root.glob("trainval/*/*/*/points_semantic/*.npy"):
        scan = safe_pickle.load_npy(path)
        path.write_bytes(frame_pickle.npy_of_dict(scan | {"ObjTag": scan["ObjTag"].astype(np.uint32) + 256}))
    with pytest.raises(schema.DataError, match=r"points_semantic_\d+.npy: ObjTag has 266, expected .* 0 to 255"):
        sources.open_recording(root, labels={"point_classes"})


def test_drives_recorded_in_carla_name_their_classes_and_scale(tmp_path):
    carla_recorder._describe(tmp_path, carla_recorder.Settings())
    header = plain_reader.read_header(tmp_path)
    assert tuple(header["classes"]) == muvo_files.CLASSES
    assert config_lib.parse(config_lib.RouteMap, header["route_map"], "route_map") == muvo_reader.ROUTE_MAP
    assert "vehicle" in header["classes"] and "pedestrian" in header["classes"]


def test_tags_of_two_simulators_are_not_read_as_one(tmp_path):
    write_run(tmp_path / "trainval/train/Town01/0000", tags=OLDER)
    write_run(tmp_path / "trainval/val0/Town01/0000", tags=NEWER)
    with pytest.raises(schema.DataError, match=r"run train/Town01/0000 has .* up to 0\.9\.13, val0/Town01/0000 those"):
        sources.open_recording(tmp_path, labels={"point_classes"})


def test_rows_that_name_files_of_two_frames(tmp_path):
    def open_with(change):
        shutil.rmtree(tmp_path, ignore_errors=True)
        for run in layout(tmp_path, tags=OLDER).glob("trainval/*/*/*"):
            columns = dict(safe_pickle.load_table(run / muvo_runs.FRAME_FILE))
            columns["points_semantic_path"] = change(list(columns["points_semantic_path"]))
            (run / muvo_runs.FRAME_FILE).write_bytes(frame_pickle.frame(columns))
        return sources.open_recording(tmp_path)

    with pytest.raises(schema.DataError, match="row 1 of points_semantic_path: frame 22 comes after frame 23"):
        open_with(lambda names: names[::-1])
    with pytest.raises(schema.DataError, match="row 1 of points_semantic_path: frame 3 comes after frame 3"):
        open_with(lambda names: names[3:4] * len(names))
    with pytest.warns(schema.DataWarning, match=r"24 of 24 rows name files of two numbers, such as row 0: "
                                                r"points_semantic_path is number 1, image_path 0"):
        open_with(lambda names: [*names[1:], names[-1].replace("023", "024")])


def test_frames_bear_the_number_of_their_files_and_runs_of_other_steps_are_warned_of(tmp_path):
    write_run(tmp_path / "trainval/train/Town01/0000", numbers=range(3, 51, 2))
    write_run(tmp_path / "trainval/val0/Town01/0000")
    (tmp_path / "sensors.toml").write_text("rate_hz = 5\n")
    with pytest.warns(schema.DataWarning, match="in steps of 1 in val0/Town01/0000 and in steps of 2 in train"):
        recording = sources.open_recording(tmp_path)
    first = next(sequence for sequence in recording.sequences if sequence.split == "train")
    assert int(recording.read(first, 0)["frame_id"]) == 3 + 2 * first.start


def test_a_backup_beside_the_recording_is_no_part_of_it(tmp_path):
    layout(tmp_path)
    write_run(tmp_path / "backup")
    (tmp_path / "trainval/train/Town01/.thumbs").mkdir()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = sources.open_recording(tmp_path)
    assert {sequence.name for sequence in recording.sequences} == {"train/Town01/0000", "val0/Town01/0000"}
