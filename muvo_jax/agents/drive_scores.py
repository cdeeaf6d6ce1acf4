"""What drives were worth: success, metres and comfort, with 95 % intervals over the drives.

Shares have Wilson's interval, which says something at 16 of 16 too; means and ratios the bootstrap over drives of
metrics/streaming.py, in which all drivers meet the same draws of seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from muvo_jax.agents import closed_loop
from muvo_jax.metrics import streaming

QUANTILE = 1.959964  # of the standard normal distribution, for 95 %
HARD_MPS2 = 3.0  # acceleration that passengers do not call comfortable; RewardConfig.comfortable_mps2


def summarise(drives: Mapping[str, Sequence[closed_loop.Drive]], *, route_m: float, step_s: float,
              expert: str | None = None, seed: int = 0) -> dict[str, dict[str, Any]]:
    """Scores of each driver over drives of the same seeds.

    Args:
      drives: driver -> its drives, in the order of the seeds.
      route_m: length of a route.
      step_s: seconds of a step.
      expert: the driver against whose metres progress is measured, or None.
      seed: of the bootstrap's draws.

    Returns:
      driver -> {"drives": count, "success": share of drives without collision or loss of the route, "collisions",
      "lost": counts, "progress_m": mean metres, "route_share": the same over the route's length, "acceleration_mps2",
      "lateral_mps2": root mean squares along and across, "hard_share": share of steps in which both together exceed
      HARD_MPS2 (nan where the simulator says no speed and heading)}; with an expert "progress": metres of all drives
      over the expert's (nan where it stood still), and "seconds_share": steps driven over the expert's. Beside
      "success", "progress_m", "progress" and the comfort stands "..._interval": [low, high], 95 %, nan for the
      bootstrap of one drive.
    """
    scores = {}
    for name, runs in drives.items():
        sums = streaming.DriveSums()
        for index, one in enumerate(runs):
            values = {"drives": 1.0, "metres": one.progress_m, "steps": float(one.steps), **comfort_sums(one, step_s)}
            if expert is not None:
                other = drives[expert][index]
                values |= {"expert_m": other.progress_m, "expert_steps": float(other.steps)}
            sums.add([str(index)], {part: np.array([[value]]) for part, value in values.items()})
        success = sum(one.unharmed for one in runs)
        found: dict[str, Any] = {
            "drives": len(runs), "success": success / len(runs), "success_interval": wilson(success, len(runs)),
            "collisions": sum(one.end.collided for one in runs), "lost": sum(one.end.lost for one in runs)}
        for score, (of_sums, has_interval) in _SCORES.items():
            if expert is None and score in ("progress", "seconds_share"):
                continue
            summary = streaming.summary(sums, of_sums, seed)
            found[score] = summary["mean"]
            if has_interval:
                found[f"{score}_interval"] = summary["interval"]
        scores[name] = found | {"route_share": found["progress_m"] / route_m}
    return scores


def comfort_sums(drive: closed_loop.Drive, step_s: float) -> dict[str, float]:
    """Sums over the steps of a drive: squares of the accelerations along and across, m2/s4, and of the hard steps."""
    speed_mps = np.array([situation.speed_mps for situation in drive.situations])
    heading_rad = np.array([situation.heading_rad for situation in drive.situations])
    along = np.diff(speed_mps) / step_s
    turn_rad = (np.diff(heading_rad) + math.pi) % (2 * math.pi) - math.pi
    across = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * turn_rad / step_s
    squares = along**2 + across**2
    hard = np.where(np.isnan(squares), np.nan, squares > HARD_MPS2**2)
    return {"along": float((along**2).sum()), "across": float((across**2).sum()), "hard": float(hard.sum())}


def wilson(count: int, total: int) -> list[float]:
    """Wilson's score interval, 95 %, of a share of `count` in `total` > 0: [low, high]."""
    share, square = count / total, QUANTILE**2
    middle = (share + square / (2 * total)) / (1 + square / total)
    half = QUANTILE / (1 + square / total) * math.sqrt(share * (1 - share) / total + square / (4 * total**2))
    return [max(0.0, middle - half), min(1.0, middle + half)]


def _ratio(numerator: str, denominator: str) -> Callable[[streaming.Sums], np.ndarray]:
    return lambda sums: streaming.divide_or_nan(sums[numerator], sums[denominator])


def _root(numerator: str) -> Callable[[streaming.Sums], np.ndarray]:
    return lambda sums: np.sqrt(streaming.divide_or_nan(sums[numerator], sums["steps"]))


# score -> (what it is of the sums over drives, whether its interval is wanted)
_SCORES = {"progress_m": (_ratio("metres", "drives"), True), "progress": (_ratio("metres", "expert_m"), True),
           "seconds_share": (_ratio("steps", "expert_steps"), False), "acceleration_mps2": (_root("along"), True),
           "lateral_mps2": (_root("across"), True), "hard_share": (_ratio("hard", "steps"), True)}
