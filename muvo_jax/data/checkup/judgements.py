"""How a recording is judged: each function looks at one thing and returns findings in words (see examination.py)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
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
_PITCH_RAD, _LEAST_DOWN, _BACKWARDS = math.radians(45.0), -0.5, -0.5  # of cameras on cars
_OFF_CENTRE = 0.25  # of the picture's side; a crop may be the reason
_MISALIGNED_RAD = math.radians(1.0)  # less is no problem, nor is what the lidar's beams cannot tell
_UNIT_FACTOR = 1.8  # a speed this many times too large or too small is of another unit
_SPEED_UNITS = {"km/h": 3.6, "mph": 2.237, "km/s": 0.001, "cm/s": 100.0}
_LEAST_RATIO, _MOST_RATIO = 0.5, 2.0  # what is farther from what it should be is of another unit or scale
_HEADING_M = 0.3  # a step so long has a direction
_OPPOSED, _TOGETHER = -0.5, 0.5  # correlations


Level = Literal["problem", "remark"]


class Finding(NamedTuple):
    """Something about a recording: a "problem" should be mended before training, a "remark" should be known."""

    level: Level
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
        if contract.kinematics == "bicycle" and _is_of_unit(_yaw_rate_ratio(motion)):
            found += _turn_gain(motion, turning & (np.abs(action[:, 1]) <= 1.0), contract)
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
    if _is_of_unit(gain) or gain <= 0:  # a wrong sign has its own finding
        return []
    return [Finding("problem", f"the car accelerates {gain:.2f} times what the action contract says; correct "
                               f"accel_full_mps2 and brake_full_mps2, or say kinematics = \"none\".")]


def _turn_gain(motion: DrivingLog, turning: np.ndarray, contract: config_lib.ActionContract) -> list[Finding]:
    """Whether steering turns the car as the contract says, in the frames `turning` [F]."""
    if turning.sum() < _FEWEST_SAMPLES:
        return []
    measured_radps = motion.yaw_rate_radps[turning]
    wheel_rad = np.clip(motion.action[turning, 1] * contract.steer_full_rad, -1.5, 1.5)
    expected_radps = -motion.speed_mps[turning] * np.tan(wheel_rad) / contract.wheelbase_m
    if measured_radps.std() < _TURNING_RADPS or expected_radps.std() < 1e-6 or (
            np.corrcoef(expected_radps, measured_radps)[0, 1] < _TOGETHER):
        return []
    gain = float((expected_radps * measured_radps).sum() / (expected_radps ** 2).sum())
    if _is_of_unit(gain):
        return []
    unit = " Or is yaw_rate_radps in degrees per second?" if 0.8 < gain / math.degrees(1.0) < 1.25 else ""
    return [Finding("problem", f"the car turns {gain:.2f} times as fast as the action contract says; correct "
                               f"steer_full_rad (of the wheels, not of the steering wheel) and wheelbase_m, or say "
                               f"kinematics = \"none\".{unit}")]


def _is_of_unit(ratio: float | None) -> bool:
    """Whether what was measured is of the order that it should be, or nothing is known of it."""
    return ratio is None or _LEAST_RATIO < ratio < _MOST_RATIO


def _yaw_rate_ratio(motion: DrivingLog) -> float | None:
    """The recorded yaw rate over the change of yaw in a second; None where the car turns too little to tell."""
    if motion.pose is None or len(motion.pose) < 2:
        return None
    steps_s = np.diff(motion.timestamp_s)
    turned_rad = (np.diff(motion.pose[:, 2]) + np.pi) % (2 * np.pi) - np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        turned_radps = turned_rad / steps_s
        usable = (np.diff(motion.stretch) == 0) & (steps_s > 0) & (np.abs(turned_radps) > _TURNING_RADPS)
    usable &= np.isfinite(motion.yaw_rate_radps[:-1])
    if usable.sum() < _FEWEST_SAMPLES:
        return None
    return float(np.median(motion.yaw_rate_radps[:-1][usable] / turned_radps[usable]))


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
    rate_ratio = _yaw_rate_ratio(motion)
    if rate_ratio is not None and not _is_of_unit(rate_ratio):
        unit = " (degrees?)" if 0.8 < abs(rate_ratio) / math.degrees(1.0) < 1.25 else ""
        found.append(Finding("problem", f"yaw_rate_radps is {rate_ratio:.2f} times what yaw turns by in a second; it "
                                        f"must be in radians per second{unit}, to the left as yaw."))
    return found


def of_cameras(cameras: Iterable[tuple[np.ndarray, np.ndarray]], width_px: int, height_px: int) -> list[Finding]:
    """Whether cameras look as one on a car does: upright, not to the sky or the ground, through the picture's middle.

    Args:
      cameras: intrinsics [3, 3] and camera_to_ego [4, 4] of each; what several have is said once.
    """
    found: dict[str, Finding] = {}

    def say(what: str, level: Level, text: str) -> None:
        found.setdefault(what, Finding(level, text))

    for intrinsics, pose in cameras:
        down, ahead = pose[:3, 1], pose[:3, 2]
        pitch_rad = math.asin(float(np.clip(ahead[2], -1.0, 1.0)))
        if down[2] > _LEAST_DOWN:
            say("down", "problem", f"the camera's down axis, the second column of camera_to_ego, is "
                                   f"({', '.join(f'{value:.2f}' for value in down)}) in the ego frame, expected about "
                                   f"(0, 0, -1). Camera axes are x right, y down, z forward; is camera_to_ego "
                                   f"inverted, or of other axes?")
        elif abs(pitch_rad) > _PITCH_RAD:
            say("pitch", "problem", f"the camera looks {abs(math.degrees(pitch_rad)):.0f} degrees "
                                    f"{'up' if pitch_rad > 0 else 'down'}; check camera_to_ego, whose third column is "
                                    f"the optical axis.")
        elif ahead[0] < _BACKWARDS:
            say("back", "remark", "the camera looks backwards; where it should look ahead, turn camera_to_ego by half "
                                  "a turn.")
        for name, place_px, side_px in (("cx", intrinsics[0, 2], width_px), ("cy", intrinsics[1, 2], height_px)):
            if not 0 <= place_px <= side_px:
                say(name, "problem", f"{name} = {place_px:.4g} lies outside of {side_px} pixels; intrinsics must be "
                                     f"those of the stored pictures, {width_px}x{height_px}.")
            elif abs(place_px / side_px - 0.5) > _OFF_CENTRE:
                say(name, "remark", f"{name} = {place_px:.4g} lies far from the middle of {side_px} pixels; are "
                                    f"intrinsics those of pictures of {width_px}x{height_px}?")
    return list(found.values())


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
