"""What actions mean: the contract of a recording and the motion that follows from it."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Literal

from muvo_jax.limits import COUNT, Limits, above, check

RATE_HZ = above(0, 10_000, "Hz")
STEERING_RAD = Limits(0, 0.5 * math.pi, open_low=True, open_high=True, unit="rad")


@dataclasses.dataclass(frozen=True)
class ActionContract:
    """What the two numbers of an action mean, stored with every dataset and checkpoint.

    action = (acceleration, steering), each in [-1, 1]: acceleration > 0 is `accel_full_mps2` of throttle at 1, < 0 is
    `brake_full_mps2` of braking at -1; steering 1 turns the front wheels `steer_full_rad` to the right.

    Attributes:
      kinematics: "bicycle" where acceleration, steering and wheelbase describe the motion, else "none".
      source: "recorded" where the vehicle logged its actions, "derived" where they were computed from its motion.
      step_action: what stands for the recorded actions of a step of data.stride frames: their "mean", or the "first",
        as the reference takes it. A setting of the run; recordings say nothing of it.
    """

    accel_full_mps2: Annotated[float, above(0, 100, "m/s2")] = 3.0
    brake_full_mps2: Annotated[float, above(0, 100, "m/s2")] = 6.0
    steer_full_rad: Annotated[float, STEERING_RAD] = 0.6
    wheelbase_m: Annotated[float, above(0, 30, "m")] = 2.9
    rate_hz: Annotated[float, RATE_HZ] = 10.0
    kinematics: Literal["bicycle", "none"] = "bicycle"
    source: Literal["recorded", "derived"] = "recorded"
    step_action: Literal["mean", "first"] = "mean"

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """How one step of a model moves the car: the contract's bicycle for `periods` recorded periods."""

    contract: ActionContract = ActionContract()
    periods: Annotated[int, COUNT] = 1

    def __post_init__(self):
        check(self)
