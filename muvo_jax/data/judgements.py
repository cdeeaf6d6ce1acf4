"""How a recording is judged: each function looks at one thing and returns findings in words (see checkup.py)."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, NamedTuple

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import alignment as alignment_lib
from muvo_jax.data import schema
from muvo_jax.ops import voxels

# A window of the paper: 12 frames, every second recorded one.
_WINDOW_FRAMES = 23
_MOVING_MPS, _TURNING_RADPS = 1.0, 0.02
_FEWEST_SAMPLES = 30
_MISALIGNED_RAD = math.radians(1.0)  # less is no problem, nor is what the lidar's beams cannot tell
_OPPOSED, _TOGETHER = -0.5, 0.5  # correlations


class Finding(NamedTuple):
    """Something about a recording: a "problem" should be mended before training, a "remark" should be known."""

    level: Literal["problem", "remark"]
    text: str


@dataclasses.dataclass(frozen=True)
class Motion:
    """Actions beside what was measured, of all stretches one after the other.

    Attributes:
      stretch: int [F], number of the stretch a frame belongs to.
      action: float64 [F, 2].
      speed_mps, yaw_rate_radps: float64 [F], NaN where not recorded.
      timestamp_s: float64 [F].
    """

    stretch: np.ndarray
    action: np.ndarray
    speed_mps: np.ndarray
    yaw_rate_radps: np.ndarray
    timestamp_s: np.ndarray

    @property
    def acceleration_mps2(self) -> np.ndarray:
        """From a frame to the next, NaN at the end of a stretch."""
        steps_s = np.diff(self.timestamp_s, append=np.nan)
        change = np.diff(self.speed_mps, append=np.nan) / np.where(steps_s > 0, steps_s, np.nan)
        return np.where(np.diff(self.stretch, append=-1) == 0, change, np.nan)


def of_splits(recording: schema.Recording) -> list[Finding]:
    found = []
    splits = recording.description.splits
    if "train" not in splits:
        found.append(Finding("problem", f"there is no split \"train\", only {', '.join(splits) or 'none'}."))
    if not any(split.startswith("val") for split in splits):
        found.append(Finding("remark", "there is no validation split: nothing can be judged on unseen drives."))
    for split in splits:
        longest = schema.longest(recording.sequences, split)
        if longest < _WINDOW_FRAMES:
            found.append(Finding("remark", f"the longest sequence of {split} has {longest} frames; the paper's windows "
                                           f"(12 frames, every second one) need {_WINDOW_FRAMES}."))
    return found


def of_actions(motion: Motion, contract: config_lib.ActionContract) -> list[Finding]:
    found = []
    action = motion.action
    if not len(action):
        return []
    for column, name in enumerate(("acceleration", "steering")):
        values = action[:, column]
        if not np.isfinite(values).all():
            found.append(Finding("problem", f"{name} is not finite in {int((~np.isfinite(values)).sum())} frames."))
        outside = int((np.abs(values) > 1 + 1e-6).sum())
        if outside:
            found.append(Finding("problem", f"{name} leaves [-1, 1] in {outside} of {len(values)} frames (largest "
                                            f"{np.nanmax(np.abs(values)):.3g}); scale it as the contract says."))
        elif np.nanstd(values) < 1e-3:
            found.append(Finding("remark", f"{name} hardly varies (standard deviation {np.nanstd(values):.1e})."))
    if np.isfinite(motion.speed_mps).any() and np.nanmin(motion.speed_mps) < -0.5:
        found.append(Finding("remark", f"the car drives backwards, at up to {-np.nanmin(motion.speed_mps):.1f} m/s."))
    sound = np.isfinite(action).all(axis=1)
    turning = sound & (motion.speed_mps > _MOVING_MPS) & np.isfinite(motion.yaw_rate_radps)
    if contract.source == "recorded":
        steer, turn = action[turning, 1], -motion.yaw_rate_radps[turning]
        found += _agreement("steering", "yaw rate to the right", steer, turn, 1e-3, _TURNING_RADPS)
        gained = sound & np.isfinite(motion.acceleration_mps2) & np.isfinite(motion.speed_mps)
        found += _agreement("acceleration", "change of speed", action[gained, 0], motion.acceleration_mps2[gained],
                            1e-2, 0.1)
        if contract.kinematics == "bicycle" and gained.sum() >= _FEWEST_SAMPLES:
            found += _gain(action[gained, 0], motion.acceleration_mps2[gained], contract)
    if not np.isfinite(motion.yaw_rate_radps).any():
        found.append(Finding("remark", "no yaw rate is recorded: the sign of steering could not be checked."))
    return found


def _agreement(name: str, measured: str, values: np.ndarray, motion: np.ndarray, least: float,
               least_motion: float) -> list[Finding]:
    """Whether an action and the motion it should cause go together."""
    if len(values) < _FEWEST_SAMPLES or values.std() < least or motion.std() < least_motion:
        return [Finding("remark", f"too little {name} or {measured} in the frames looked at to compare the two.")]
    correlation = float(np.corrcoef(values, motion)[0, 1])
    if correlation < _OPPOSED:
        return [Finding("problem", f"{name} has the wrong sign: its correlation with {measured} is {correlation:.2f}. "
                                   f"Positive steering turns right, positive acceleration speeds up.")]
    if correlation < _TOGETHER:
        return [Finding("remark", f"{name} and {measured} hardly go together (correlation {correlation:.2f}): is one "
                                  f"of them late, or of another unit?")]
    return [Finding("remark", f"{name} agrees with {measured} (correlation {correlation:.2f}).")]


def _gain(acceleration: np.ndarray, measured_mps2: np.ndarray, contract: config_lib.ActionContract) -> list[Finding]:
    expected = np.where(acceleration > 0, contract.accel_full_mps2, contract.brake_full_mps2) * acceleration
    if expected.std() < 0.1:
        return []
    gain = float((expected * measured_mps2).sum() / (expected ** 2).sum())
    if 0.5 < gain < 2.0 or gain <= 0:  # a wrong sign has its own finding
        return []
    return [Finding("problem", f"the car accelerates {gain:.2f} times what the action contract says; correct "
                               f"accel_full_mps2 and brake_full_mps2, or say kinematics = \"none\".")]


def of_time(motion: Motion, rate_hz: float) -> list[Finding]:
    steps_s = np.diff(motion.timestamp_s)[np.diff(motion.stretch) == 0]
    if not len(steps_s):
        return []
    if (steps_s <= 0).any():
        return [Finding("problem", f"time does not advance at {int((steps_s <= 0).sum())} of {len(steps_s)} frames.")]
    median_s = float(np.median(steps_s))
    if abs(median_s * rate_hz - 1) > 0.1:
        return [Finding("problem", f"frames are {median_s:.3f} s apart, but the description says {rate_hz:g} Hz.")]
    jitter_s = float(np.abs(steps_s - median_s).max())
    return [Finding("remark", f"time between frames varies by up to {1000 * jitter_s:.0f} ms.")] if (
        jitter_s > 0.2 * median_s) else []


class Figures:
    """Counts over all frames that were read."""

    def __init__(self, described: schema.RecordingDescription):
        self._described = described
        self._points: list[int] = []
        self._outside: list[float] = []
        self._road_m: list[float] = []
        self._in_voxels: list[float] = []
        self._images = self._dark = self._frozen = 0
        self._previous: np.ndarray | None = None

    def add(self, frame: schema.RawFrame) -> None:
        if "image" in frame:
            image = frame["image"]
            self._images += 1
            self._dark += int(image.max() - image.min() < 8)
            self._frozen += int(self._previous is not None and np.array_equal(image, self._previous)
                                and frame.get("speed_mps", 1.0) > _MOVING_MPS)
            self._previous = image
        if "points_m" not in frame or self._described.lidar is None:
            return
        points_m, lidar = frame["points_m"], self._described.lidar
        self._points.append(len(points_m))
        if not len(points_m):
            return
        relative_m = points_m - np.asarray(lidar.position_m, np.float32)[None]
        elevation_rad = np.arctan2(relative_m[:, 2], np.hypot(relative_m[:, 0], relative_m[:, 1]))
        margin_rad = (lidar.elevation_max_rad - lidar.elevation_min_rad) / lidar.rows
        self._outside.append(float(((elevation_rad < lidar.elevation_min_rad - margin_rad) |
                                    (elevation_rad > lidar.elevation_max_rad + margin_rad)).mean()))
        near = (np.abs(points_m[:, 1]) < 2.0) & (np.abs(points_m[:, 0]) < 12.0)
        if near.sum() > 20:
            self._road_m.append(float(np.median(points_m[near, 2])))
        if "occupancy" in frame and self._described.voxels is not None:
            self._in_voxels.append(_share_in_voxels(points_m, frame["occupancy"], self._described.voxels))

    def findings(self) -> list[Finding]:
        found = []
        if self._dark:
            found.append(Finding("problem", f"{self._dark} of {self._images} images are of one colour."))
        if self._frozen:
            found.append(Finding("problem", f"{self._frozen} of {self._images} images are copies of the one before, "
                                            f"although the car moves."))
        empty = self._points.count(0)
        if empty:
            found.append(Finding("problem", f"{empty} of {len(self._points)} scans are empty."))
        if self._points:
            found.append(Finding("remark", f"a scan has {int(np.median(self._points))} points "
                                           f"({min(self._points)} to {max(self._points)})."))
        if self._outside and np.mean(self._outside) > 0.05:
            found.append(Finding("problem", f"{np.mean(self._outside):.0%} of the points lie above or below the "
                                            f"lidar's described field of view; correct its elevation and position."))
        if self._road_m and abs(np.median(self._road_m)) > 0.5:
            found.append(Finding("problem", f"the road under the car is at z = {np.median(self._road_m):.2f} m, "
                                            f"expected about 0; correct the height of the points or of the lidar."))
        if self._in_voxels and np.mean(self._in_voxels) < 0.8:
            found.append(Finding("problem", f"only {np.mean(self._in_voxels):.0%} of the points lie in occupied "
                                            f"voxels; the grid is described wrongly, or they are of other frames."))
        return found


def _share_in_voxels(points_m: np.ndarray, occupancy: np.ndarray, grid: config_lib.VoxelGrid) -> float:
    index, inside = voxels.voxel_index(points_m, grid)
    return float((occupancy[tuple(index[inside].T)] == 1).mean()) if inside.any() else 0.0


def of_alignment(fit: alignment_lib.Alignment, recording: schema.Recording) -> list[Finding]:
    described = recording.description
    if not fit.is_known or described.camera is None or described.lidar is None:
        return [Finding("remark", "whether lidar and camera agree could not be measured (too few clear edges); look at "
                                  "the overlay.")]
    focal_px = described.camera.intrinsics[0][0]
    degrees = math.degrees(math.atan(math.hypot(fit.right_px, fit.down_px) / focal_px))
    place = f"{fit.right_px:+.0f} px to the right and {fit.down_px:+.0f} px down ({degrees:.1f} degrees)"
    least_px = focal_px * math.tan(_MISALIGNED_RAD)
    beams = math.hypot(fit.right_px / max(least_px, 1.5 * fit.column_px), fit.down_px / max(least_px, 1.5 * fit.row_px))
    if beams > 1 and fit.gain > 1.03:
        first = "the rotation in camera_to_ego" if fit.is_turn else "intrinsics and camera_to_ego"
        return [Finding("problem", f"lidar and camera are misaligned: the scan fits the picture best when moved by "
                                   f"{place}. Check {first}, and the time of both.")]
    row_degrees = math.degrees(math.atan(fit.row_px / focal_px))
    return [Finding("remark", f"lidar and camera agree: best fit when moved by {place}, where rows of the lidar are "
                              f"{row_degrees:.1f} degrees apart.")]
