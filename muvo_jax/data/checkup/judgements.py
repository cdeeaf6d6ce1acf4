"""How a recording is judged: each function looks at one thing and returns findings in words (see examination.py)."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, NamedTuple

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import schema, sequences
from muvo_jax.data.checkup import alignment as alignment_lib

# A window of the paper: 12 frames, every second recorded one.
_WINDOW_FRAMES = 23
MOVING_MPS = 1.0
_TURNING_RADPS = 0.02
_FEWEST_SAMPLES = 30
_MISALIGNED_RAD = math.radians(1.0)  # less is no problem, nor is what the lidar's beams cannot tell
_UNIT_FACTOR = 1.8  # a speed this many times too large or too small is of another unit
_SPEED_UNITS = {"km/h": 3.6, "mph": 2.237, "km/s": 0.001, "cm/s": 100.0}
_HEADING_M = 0.3  # a step so long has a direction
_OPPOSED, _TOGETHER = -0.5, 0.5  # correlations


class Finding(NamedTuple):
    """Something about a recording: a "problem" should be mended before training, a "remark" should be known."""

    level: Literal["problem", "remark"]
    text: str


@dataclasses.dataclass(frozen=True)
class DrivingLog:
    """Actions beside what was measured, of all stretches one after the other.

    Attributes:
      stretch: int [F], number of the stretch a frame belongs to.
      action: float64 [F, 2].
      speed_mps, yaw_rate_radps: float64 [F], NaN where not recorded.
      timestamp_s: float64 [F].
      pose: float64 [F, 3], x, y (m) and yaw (rad), NaN where a frame has none; None where no frame has.
    """

    stretch: np.ndarray
    action: np.ndarray
    speed_mps: np.ndarray
    yaw_rate_radps: np.ndarray
    timestamp_s: np.ndarray
    pose: np.ndarray | None = None

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
        longest = sequences.longest(recording.sequences, split)
        if longest < _WINDOW_FRAMES:
            found.append(Finding("remark", f"the longest sequence of {split} has {longest} frames; the paper's windows "
                                           f"(12 frames, every second one) need {_WINDOW_FRAMES}."))
    return found


def of_actions(motion: DrivingLog, contract: config_lib.ActionContract) -> list[Finding]:
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
    turning = sound & (motion.speed_mps > MOVING_MPS) & np.isfinite(motion.yaw_rate_radps)
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


def of_time(motion: DrivingLog, rate_hz: float) -> list[Finding]:
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


def of_units(motion: DrivingLog) -> list[Finding]:
    """Whether speed and yaw are of the units that the pose's change over time says."""
    if motion.pose is None or len(motion.pose) < 2:
        return []
    found = []
    steps_s = np.diff(motion.timestamp_s)
    usable = (np.diff(motion.stretch) == 0) & (steps_s > 0) & np.isfinite(motion.pose[1:]).all(axis=1) & np.isfinite(
        motion.pose[:-1]).all(axis=1)
    change = np.diff(motion.pose, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved_mps = np.hypot(change[:, 0], change[:, 1]) / steps_s
    speed_mps = np.abs(motion.speed_mps[:-1])
    moving = usable & (moved_mps > MOVING_MPS) & np.isfinite(speed_mps)
    if moving.sum() >= _FEWEST_SAMPLES:
        ratio = float(np.median(speed_mps[moving] / moved_mps[moving]))
        if not 1 / _UNIT_FACTOR < ratio < _UNIT_FACTOR:
            unit = next((f" ({unit}?)" for unit, factor in _SPEED_UNITS.items() if 0.8 < ratio / factor < 1.25), "")
            found.append(Finding("problem", f"speed_mps is {ratio:.2f} times what the pose moves by in a second; it "
                                            f"must be in m/s{unit}, the pose in metres."))
    far = usable & (np.hypot(change[:, 0], change[:, 1]) > _HEADING_M)
    course_rad = np.unwrap(np.arctan2(change[far, 1], change[far, 0]))
    turned_rad, yaw_rad = np.diff(course_rad), np.diff(motion.pose[:-1, 2][far])
    if len(turned_rad) >= _FEWEST_SAMPLES and np.abs(turned_rad).max() > _TURNING_RADPS:
        ratio = float((turned_rad * yaw_rad).sum() / max((turned_rad ** 2).sum(), 1e-12))
        if ratio > 0.5 * math.degrees(1.0):
            found.append(Finding("problem", f"yaw turns {ratio:.0f} times as much as the path: it must be in radians, "
                                            f"not degrees."))
    return found


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
