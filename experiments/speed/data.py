"""Data on its way to the device: projection, voxels, packing and reading, as ratios within one run.

    python experiments/speed/data.py [--recording=FOLDER] [--output=experiments/speed/data.md]

Times are processor seconds of one thread, the least of several tries, so that a busy machine disturbs them little.
"""

from __future__ import annotations

import argparse
import math
import pathlib
import tempfile
import time
from collections.abc import Callable

import data_baselines
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import records, schema, shards, sources
from muvo_jax.interop.weights_rule import make_input
from muvo_jax.ops import camera, range_view, voxels

ROAD_LINE = 6
FRAMES = 64


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
        write_s = seconds(lambda: list(shards.write_shards(recording, pathlib.Path(folder), [0], count,
                                                           records.Encoding())), 2)
    reading_s = seconds(lambda: [recording.read(sequence, index) for index in range(count)], 2)
    encoded = [records.encode_frame(frame, records.Encoding()) for frame in raw]
    decode_s = seconds(lambda: [records.decode_frame(record, "here") for record in encoded], 2)
    return [*lines, "", f"Packing: {count / write_s:.0f} frames per processor second, reading the folder included. "
            f"Reading: {count / reading_s:.0f} from the folder, {count / decode_s:.0f} from shards."]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=pathlib.Path)
    parser.add_argument("--output", type=pathlib.Path)
    options = parser.parse_args()
    lines = ["| what | plain | here | ratio |", "|---|---|---|---|", projection(), voxelisation()]
    if options.recording is not None:
        lines += packing(sources.open_recording(options.recording))
    print("\n".join(lines))
    if options.output is not None:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
