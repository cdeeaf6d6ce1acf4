"""Data on its way to the device: projection, voxels, packing and reading, as ratios within one run.

    python experiments/speed/data.py [--recording=FOLDER] [--output=experiments/speed/data.md]

FOLDER is packed, such as one of the town at its default size; enlarged, its pictures make a folder of the paper's size.
Times are processor seconds of one thread, the least of several tries, so that a busy machine disturbs them little;
windows a second are by the clock.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import pathlib
import resource
import tempfile
import time
from collections.abc import Callable

import data_baselines
import numpy as np
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fitting, pipeline, prepare, schema, sources
from muvo_jax.data.packed import manifest, records
from muvo_jax.data.packed import writer as packed_writer
from muvo_jax.data.plain import writer as plain_writer
from muvo_jax.interop.weights_rule import make_input
from muvo_jax.ops import camera, range_view, voxels

ROAD_LINE = 6
FRAMES = 64
WINDOWS = 30


def seconds(work: Callable[[], object], tries: int = 5) -> float:
    """Processor time of the fastest try."""
    best = math.inf
    for _ in range(tries):
        start_s = time.process_time()
        work()
        best = min(best, time.process_time() - start_s)
    return best


def ratio_line(what: str, plain_s: float, ours_s: float) -> str:
    return f"| {what} | {1e3 * plain_s:.1f} ms | {1e3 * ours_s:.2f} ms | {plain_s / ours_s:.1f} |"


def projection() -> str:
    points_m = make_input("rv_cloud", (60000,), "cloud").astype(np.float32)
    geometry = config_lib.RangeViewGeometry()
    np.testing.assert_array_equal(data_baselines.project(points_m, geometry), range_view.project(points_m, geometry))
    return ratio_line("60 000 points to 64x1024, against float64 with a full sort",
                      seconds(lambda: data_baselines.project(points_m, geometry), 20),
                      seconds(lambda: range_view.project(points_m, geometry), 20))


def voxelisation() -> str:
    depth_m = make_input("vf_depth", (600, 960), "depth_m")
    pixel_tags = make_input("vf_sem", (600, 960), "labels23").reshape(-1).astype(np.uint8)
    lidar_m = make_input("rv_cloud", (60000,), "cloud")
    lidar_tags = make_input("vf_lsem", (60000,), "ints23").astype(np.uint8)
    grid = config_lib.VoxelGrid()
    seen_m, pixel = camera.reference_depth_points(depth_m, math.radians(110), (1.0, 0.0, 2.0))
    points_m, tags = np.concatenate([seen_m, lidar_m]), np.concatenate([pixel_tags[pixel], lidar_tags])
    return ratio_line("voxels of 600x960 depth + 60 000 points, against a loop over the voxels",
                      seconds(lambda: data_baselines.voxel_table(points_m, tags, grid, ROAD_LINE), 2),
                      seconds(lambda: voxels.voxel_table(points_m, tags, grid, winning_tag=ROAD_LINE)))


def psnr_db(left: np.ndarray, right: np.ndarray) -> float:
    error = np.mean(np.square(left.astype(np.float64) - right.astype(np.float64)))
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def packing(recording: schema.Recording) -> list[str]:
    """Sizes against quality, and frames per processor second of writing and reading."""
    sequence = recording.sequences[0]
    count = min(FRAMES, sequence.length)
    raw = [recording.read(sequence, index) for index in range(count)]
    lines = ["", "| shards | kB a frame | image PSNR, dB | points off by at most, m |", "|---|---|---|---|"]
    for encoding in (records.Encoding(), records.Encoding(95), records.Encoding(85), records.Encoding(85, True)):
        packed = [records.encode_frame(frame, encoding) for frame in raw]
        back = [records.decode_frame(record, "here") for record in packed]
        quality = min(psnr_db(a["image"], b["image"]) for a, b in zip(raw, back, strict=True))
        off_m = max(float(np.abs(a["points_m"] - b["points_m"]).max(initial=0)) for a, b in zip(raw, back, strict=True))
        name = f"JPEG {encoding.jpeg_quality}" if encoding.jpeg_quality else "PNG (default)"
        lines.append(f"| {name}{', points in half' * encoding.half_points} | {sum(map(len, packed)) / count / 1e3:.1f} "
                     f"| {'exact' if math.isinf(quality) else f'{quality:.1f}'} | {off_m:.3f} |")
    with tempfile.TemporaryDirectory() as folder:
        shard = packed_writer.Shard(0, ((sequence, 0, count),), "")
        write_s = seconds(lambda: list(packed_writer.write_shard(recording, pathlib.Path(folder), records.Encoding(),
                                                                 shard)), 2)
    reading_s = seconds(lambda: [recording.read(sequence, index) for index in range(count)], 2)
    encoded = [records.encode_frame(frame, records.Encoding()) for frame in raw]
    decode_s = seconds(lambda: [records.decode_frame(record, "here") for record in encoded], 2)
    return [*lines, "", f"Packing: {count / write_s:.0f} frames per processor second, reading the folder included. "
            f"Reading: {count / reading_s:.0f} from the folder, {count / decode_s:.0f} from shards."]


def peak_mib(folder: pathlib.Path, frames: int) -> float:
    """Peak memory of a process of its own that packs so many frames (those of one sequence again and again)."""
    recording = sources.open_recording(folder)
    sequence, per_shard = recording.sequences[0], manifest.FRAMES_PER_SHARD
    count = min(sequence.length, per_shard)
    parts = ((sequence, 0, count),) * math.ceil(per_shard / count)
    with tempfile.TemporaryDirectory() as out:
        for number in range(frames // per_shard):
            for _ in packed_writer.write_shard(recording, pathlib.Path(out), records.Encoding(),
                                               packed_writer.Shard(number, parts, "")):
                pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def packing_memory(folder: pathlib.Path) -> str:
    lengths = (2 * manifest.FRAMES_PER_SHARD, 10 * manifest.FRAMES_PER_SHARD)
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        peaks = [pool.apply(peak_mib, (folder, frames)) for frames in lengths]
    return "Peak memory of packing: " + ", ".join(f"{peak:.0f} MiB for {frames} frames" for peak, frames in
                                                  zip(peaks, lengths, strict=True)) + "."


def write_paper_size(recording: schema.Recording, folder: pathlib.Path) -> schema.Recording:
    """A plain recording of 960x600 pixels (enlarged, with grain), 60 000 points and the paper's voxels."""
    grid, lidar = config_lib.VoxelGrid(), config_lib.RangeViewGeometry()
    intrinsics = camera.intrinsics_from_fov(960, 600, math.radians(110))
    pinhole = schema.Camera(960, 600, tuple(map(tuple, intrinsics.tolist())),
                            tuple(map(tuple, camera.level_camera_to_ego(lidar.position_m).tolist())))
    plain_writer.write_description(folder, name="large", rate_hz=10.0, splits=("train",), camera=pinhole, lidar=lidar,
                                   voxels=grid, contract=recording.description.contract)
    writer, rng = plain_writer.RunWriter(folder, "train", "run"), np.random.default_rng(0)
    points_m = make_input("rv_cloud", (60000,), "cloud").astype(np.float32)
    occupancy = voxels.occupancy_target(points_m, np.array(lidar.position_m, np.float32), grid)
    for index in range(FRAMES):
        small = Image.fromarray(recording.read(recording.sequences[0], index % recording.sequences[0].length)["image"])
        image = np.asarray(small.resize((960, 600), Image.Resampling.BILINEAR)).astype(np.int16)
        image = np.clip(image + rng.integers(-2, 3, image.shape), 0, 255).astype(np.uint8)
        writer.write({"frame_id": index, "timestamp_s": index / 10, "x_m": 0.0, "y_m": 0.0, "yaw_rad": 0.0,
                      "speed_mps": 5.0, "acceleration": 0.0, "steering": 0.0, "reward": 1.0, "is_terminal": False,
                      "weather": "", "image": image, "points_m": points_m, "occupancy": occupancy,
                      "route_map": np.zeros((64, 64), np.uint8)})
    writer.close()
    return sources.open_recording(folder)


def windows_from_folder(recording: schema.Recording) -> str:
    """Training windows of 6 frames at the paper's size by the clock, and where a frame's processor time goes."""
    chosen = {"data.cache_gib": 0.0, "data.frames": 6, "data.context": 2, "data.horizon": 2, "data.stride": 1}
    wanted = config_lib.override_all(presets.get("paper-occupancy"), chosen)
    config = fitting.adapt(wanted, recording, keep=chosen).config
    frames = pipeline.Frames(recording, config)
    batches = pipeline.train_batches(frames, seed=0, batch=1)
    for _ in range(2 * pipeline.default_workers() + 4):  # what was read ahead
        next(batches)
    start_s = time.perf_counter()
    for _ in range(WINDOWS):
        next(batches)
    rate = WINDOWS / (time.perf_counter() - start_s)
    sequence = recording.sequences[0]
    raw = recording.read(sequence, 0)
    reading_s = seconds(lambda: recording.read(sequence, 0))
    preparing_s = seconds(lambda: prepare.prepare_frame(raw, config))
    return (f"From folders of {raw['image'].shape[1]}x{raw['image'].shape[0]} pixels: {rate:.1f} windows of "
            f"{config.data.frames} frames a second with {pipeline.default_workers()} threads. Processor time of a "
            f"frame: reading {1e3 * reading_s:.1f} ms, scaling and projecting {1e3 * preparing_s:.1f} ms.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=pathlib.Path)
    parser.add_argument("--output", type=pathlib.Path)
    options = parser.parse_args()
    lines = ["| what | plain | here | ratio |", "|---|---|---|---|", projection(), voxelisation()]
    if options.recording is not None:
        lines += packing(sources.open_recording(options.recording))
        lines += ["", packing_memory(options.recording)]
        with tempfile.TemporaryDirectory() as folder:
            large = write_paper_size(sources.open_recording(options.recording), pathlib.Path(folder))
            lines += ["", windows_from_folder(large)]
    print("\n".join(lines))
    if options.output is not None:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
