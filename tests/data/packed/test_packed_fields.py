"""A pack says of fields, runs, labels, actions and scales what its source says; older packs are still read."""

import dataclasses
import json
import struct
import warnings
import zlib

import numpy as np
import pytest
import recording_writers as writers
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fitting, pipeline, schema, sources, windows
from muvo_jax.data.packed import reader as packed_reader
from muvo_jax.data.packed import records
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import writer as plain_writer

GRID = config_lib.VoxelGrid(shape=(16, 16, 16), voxel_size_m=1.0, origin_m=(-8.0, -8.0, -2.0))
STRIDE = 2
CONFIG = config_lib.override_all(presets.tiny(), {"data.stride": STRIDE, "data.frames": 4})


def opened(path, labels=()):
    """The recording, whatever it warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", schema.DataWarning)
        return sources.open_recording(path, labels=labels)


def assert_equal(source, packed):
    """Description, sequences, every field of every frame and every action."""
    assert packed.description == dataclasses.replace(source.description, kind=f"packed {source.description.kind}")
    assert packed.sequences == source.sequences
    for sequence in source.sequences:
        for index in range(sequence.length):
            left, right = source.read(sequence, index), packed.read(sequence, index)
            assert left.keys() == right.keys()
            for name in left:
                assert np.asarray(left[name]).dtype == np.asarray(right[name]).dtype, name
                np.testing.assert_array_equal(left[name], right[name], err_msg=name)
            np.testing.assert_array_equal(source.action(sequence, index), packed.action(sequence, index))


def batch_of(recording, split, heads=()):
    """The longest window of each sequence of the split that training would use, as evaluation sees it."""
    changes = {"model.heads": [*CONFIG.model.heads, *heads]} if heads else {}
    config = fitting.adapt(config_lib.override_all(CONFIG, changes), recording).config
    frames = pipeline.Frames(recording, config)
    found = windows.find_windows(recording, split, frames=4, stride=STRIDE, needs=frames.needs)
    firsts = {window.sequence.name: window for window in reversed(found)}
    return sorted(firsts), frames.batch([firsts[name] for name in sorted(firsts)], judged=True)


def assert_batches_equal(left, right):
    assert vars(left).keys() == vars(right).keys()
    for name, value in vars(left).items():
        assert (value is None) == (getattr(right, name) is None), name
        if value is not None:
            np.testing.assert_array_equal(value, getattr(right, name), err_msg=name)


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """Of four runs for training, b has no lidar, c no rewards and no depth, and nothing but that is missing."""
    root = writers.write_plain(tmp_path_factory.mktemp("uneven"), {
        "train/a": 10, "train/b": 10, "train/c": 10, "train/d": 10, "val_rl/e": 10})
    for path in (root / "train/b/lidar").iterdir():
        path.unlink()
    table = root / "train/c/frames.csv"
    table.write_text(table.read_text().replace("reward", "other_reward"))
    for image in root.glob("*/[abde]/image/*.png"):
        (image.parents[1] / "depth").mkdir(exist_ok=True)
        Image.fromarray(np.full((32, 64), 500 + int(image.stem), np.uint16)).save(
            image.parents[1] / "depth" / image.name)
    return root


@pytest.mark.parametrize("workers", [1, 2])
def test_runs_that_lack_fields_lack_them_packed(uneven, tmp_path, workers):
    with pytest.warns(schema.DataWarning, match="is missing in 1 of 5 runs"):
        assert packed_writer.pack(uneven, tmp_path / "out", frames_per_shard=16, workers=workers)
    source, packed = opened(uneven, schema.LABELS), opened(tmp_path / "out", schema.LABELS)
    assert {sequence.name: sequence.lacks for sequence in packed.sequences} == {
        "train/a": (), "train/b": ("points_m",), "train/c": ("depth_m", "reward"), "train/d": (), "val_rl/e": ()}
    assert_equal(source, packed)
    assert_equal(opened(uneven), opened(tmp_path / "out"))  # nobody asks for depth: c lacks rewards alone


def test_windows_of_a_pack_pass_by_what_those_of_its_source_do(uneven, tmp_path):
    with pytest.warns(schema.DataWarning):
        assert packed_writer.pack(uneven, tmp_path / "out", frames_per_shard=16, workers=1)
    for heads, names in (((), ["train/a", "train/c", "train/d"]), (("depth",), ["train/a", "train/d"])):
        labels = {"depth_m"} if heads else ()
        source, packed = (batch_of(opened(path, labels), "train", heads) for path in (uneven, tmp_path / "out"))
        assert source[0] == packed[0] == names
        assert_batches_equal(source[1], packed[1])


def test_moving_masks_labels_and_step_actions_survive(tmp_path):
    root, rng = tmp_path / "source", np.random.default_rng(0)
    plain_writer.write_description(root, name="all", rate_hz=10, splits=("train",), voxels=GRID,
                                   camera=schema.Camera.level(64, 32, 1.5, (1.0, 0.0, 2.0)), contract=CONFIG.contract,
                                   lidar=config_lib.RangeViewGeometry(),
                                   classes=("sky", "road", "vehicle", "pedestrian"),
                                   route_map=config_lib.RouteMap(0.3, 50.0, 31.0))
    writer = plain_writer.RunWriter(root, "train", "a")
    for number in range(9):
        instances = rng.integers(0, 3, GRID.shape[:2])
        writer.write({
            "frame_id": number, "timestamp_s": number / 10, "x_m": 0.5 * number, "y_m": 0.0, "yaw_rad": 0.0,
            "speed_mps": 5.0, "acceleration": rng.uniform(-1, 1), "steering": rng.uniform(-1, 1), "reward": 0.5,
            "is_terminal": False, "image": rng.integers(0, 255, (32, 64, 3), np.uint8),
            "image_moving_mask": rng.random((32, 64)) < 0.3, "occupancy_moving_mask": rng.random(GRID.shape) < 0.3,
            "depth_m": rng.uniform(1, 90, (32, 64)).astype(np.float32),
            "classes": rng.integers(0, 4, (32, 64), np.uint8), "points_m": rng.normal(0, 9, (50, 3)),
            "point_tags": rng.integers(0, 4, 50, np.uint8), "occupancy": rng.integers(0, 2, GRID.shape, np.uint8),
            "route_map": rng.integers(0, 255, (64, 64), np.uint8), "birds_eye_instances": instances.astype(np.int32),
            "birds_eye_classes": rng.integers(0, 4, GRID.shape[:2], np.uint8)})
    writer.close()
    assert packed_writer.pack(root, tmp_path / "out", frames_per_shard=4, workers=1)
    source, packed = (opened(path, schema.LABELS) for path in (root, tmp_path / "out"))
    assert source.description.modalities >= schema.LABELS | {"image_moving_mask", "occupancy_moving_mask"}
    assert_equal(source, packed)
    _, expected = batch_of(source, "train", ("depth", "semantic_image"))
    _, batch = batch_of(packed, "train", ("depth", "semantic_image"))
    assert_batches_equal(expected, batch)
    assert batch.image_moving_mask.any() and batch.depth_m is not None
    recorded = np.stack([packed.action(packed.sequences[0], index) for index in range(2 * 4)])
    np.testing.assert_allclose(batch.action[0], recorded.reshape(4, STRIDE, 2).mean(axis=1), rtol=1e-6)


def test_pictures_are_packed_as_the_camera_was_held(tmp_path):
    root = writers.write_plain(tmp_path / "source", {"train/a": 6})
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    for path in (root / "train/a/image").iterdir():
        path.unlink()
        top_is_bright = np.repeat(np.linspace(250, 5, 32).astype(np.uint8), 64 * 3).reshape(32, 64, 3)
        Image.fromarray(top_is_bright).save(path.with_suffix(".jpg"), exif=exif)
    assert packed_writer.pack(root, tmp_path / "out", workers=1)
    source, packed = opened(root), opened(tmp_path / "out")
    assert_equal(source, packed)
    image = packed.read(packed.sequences[0], 0)["image"]
    assert image[:4].max() < 60 and image[-4:].min() > 190


def save_in_every_way(folder):
    """The frames of a run as PNG and JPEG of every kind that is read, and a BMP that calls itself one."""
    rng = np.random.default_rng(0)
    smooth = Image.fromarray(rng.integers(0, 255, (4, 8, 3), np.uint8)).resize((64, 32))
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    ways = [(smooth, ".jpg", {}), (smooth, ".jpg", {"exif": exif}), (smooth.convert("L"), ".jpg", {}),
            (smooth.convert("CMYK"), ".jpg", {}), (smooth, ".jpeg", {"progressive": True}), (smooth, ".png", {}),
            (smooth, ".png", {"exif": exif}), (smooth.quantize(9), ".png", {}), (smooth.convert("RGBA"), ".png", {}),
            (smooth.convert("LA"), ".png", {}), (smooth.convert("1"), ".png", {})]
    for number, (picture, suffix, options) in enumerate(ways):
        picture.save(folder / f"{number:06d}{suffix}", **options)
    smooth.save(folder / f"{len(ways):06d}.png", format="BMP")
    return len(ways)


def test_recorded_pictures_are_packed_as_their_bytes(tmp_path):
    root = writers.write_plain(tmp_path / "source", {"train/a": 12})
    run = root / "train/a"
    for path in run.glob("image/*.png"):
        path.unlink()
        for folder, pixels in (("depth", np.full((32, 64), 500 + int(path.stem), np.uint16)),
                               ("classes", np.full((32, 64), int(path.stem) % 10, np.uint8))):
            (run / folder).mkdir(exist_ok=True)
            Image.fromarray(pixels).save(run / folder / path.name)
    kinds = save_in_every_way(run / "image")
    assert packed_writer.pack(root, tmp_path / "out", workers=1)
    source, packed = (opened(path, schema.LABELS) for path in (root, tmp_path / "out"))
    assert_equal(source, packed)
    shard = (tmp_path / "out/shard-00000.arrayrecord").read_bytes()
    images = sorted((run / "image").iterdir())
    assert [path.read_bytes() in shard for path in images] == [True] * kinds + [False]  # the BMP becomes a PNG
    assert all(path.read_bytes() in shard for folder in ("depth", "classes", "route_map")
               for path in (run / folder).iterdir())
    assert packed_writer.pack(tmp_path / "out", tmp_path / "again", workers=1)
    assert (tmp_path / "again/shard-00000.arrayrecord").read_bytes() == shard
    assert packed_writer.pack(root, tmp_path / "lossy", encoding=records.Encoding(jpeg_quality=50), workers=1)
    assert images[5].read_bytes() not in (tmp_path / "lossy/shard-00000.arrayrecord").read_bytes()


def grey_png(pixels, bits):
    """The bytes of a grey PNG of 1, 2, 4 or 8 bits."""
    rows = ["".join(f"{value:0{bits}b}" for value in row) for row in pixels.tolist()]
    raw = b"".join(b"\0" + int(row, 2).to_bytes(len(row) // 8, "big") for row in rows)
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    height, width = pixels.shape
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b""))


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_classes_are_the_numbers_that_are_stored_whatever_their_bits(tmp_path, bits):
    root = writers.write_plain(tmp_path / "source", {"train/a": 2})
    classes = (np.arange(32 * 64, dtype=np.uint8) % min(2**bits, 10)).reshape(32, 64)
    (root / "train/a/classes").mkdir()
    for number in range(2):
        (root / f"train/a/classes/{number:06d}.png").write_bytes(grey_png(classes, bits))
    assert packed_writer.pack(root, tmp_path / "out", workers=1)
    for path in (root, tmp_path / "out"):
        recording = opened(path, schema.LABELS)
        np.testing.assert_array_equal(recording.read(recording.sequences[0], 1)["image_classes"], classes)


@pytest.mark.parametrize("version", [1, 2])
def test_a_pack_from_before_is_still_read(tmp_path, monkeypatch, version):
    root = writers.write_plain(tmp_path / "source", {"train/a": 6})
    encode = records.encode_frame

    def encode_as_before(frame, encoding, pictures, _):
        record = encode(frame, encoding, pictures if version > 1 else ())
        size = 4 + int.from_bytes(record[:4], "little")
        header = json.dumps(json.loads(record[4:size])["fields"]).encode()
        record = len(header).to_bytes(4, "little") + header + record[size:-4]
        return record + zlib.crc32(record).to_bytes(4, "little")

    with monkeypatch.context() as before:
        before.setattr(records, "encode_frame", encode_as_before)
        assert packed_writer.pack(root, tmp_path / "out", workers=1)
    path = tmp_path / "out/manifest.json"
    content = json.loads(path.read_text()) | {"schema_version": version}
    assert "lacks" not in content["sequences"][0]  # as ever, where nothing is lacking
    del content["description"]["route_map"]
    path.write_text(json.dumps(content))
    with pytest.warns(schema.DataWarning, match="manifest.json: does not say the scale of its route maps; 0.75 m"):
        packed = sources.open_recording(tmp_path / "out")
    assert_equal(opened(root), packed)
    content["description"]["modalities"].remove("route_map")
    path.write_text(json.dumps(content))
    assert sources.open_recording(tmp_path / "out").description.route_map is None  # and nothing is warned of


@pytest.mark.parametrize(("change", "message"), [
    (lambda content: content["sequences"][0].update(lacks=["points"]), r"sequences\[0\]: lacks is \['points'\]"),
    (lambda content: content["sequences"][0].update(lacks="reward"), r"sequences\[0\]: lacks is reward, expected"),
    (lambda content: content["sequences"][0].update(lacks=[[]]), r"sequences\[0\]: lacks is"),
    (lambda content: content["sequences"][0].update(missing=[]), r"sequences\[0\]: expected split, name, start"),
    (lambda content: content["description"].update(route_map={"metres_per_px": -1.0}), "route_map.metres_per_px is -1"),
    (lambda content: content["description"].update(route_map={"scale": 1.0}), "route_map.*'scale' is unknown"),
])
def test_lacks_and_scales_that_cannot_be_are_refused(tmp_path, change, message):
    root = writers.write_plain(tmp_path / "source", {"train/a": 3})
    assert packed_writer.pack(root, tmp_path / "out", workers=1)
    path = tmp_path / "out/manifest.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(schema.DataError, match=f"manifest.json.*{message}"):
        packed_reader.PackedRecording(tmp_path / "out")
