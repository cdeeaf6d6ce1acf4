"""Everything that is fixed about the town: sensors, traffic, speeds, weathers, splits and their sizes.

These numbers were written down before any model was tuned on the town and are not tuned with it.
"""

from __future__ import annotations

import dataclasses
import math

from muvo_jax import config as config_lib


@dataclasses.dataclass(frozen=True)
class Weather:
    """How the light falls. Colours are RGB in [0, 1].

    Attributes:
      sun_azimuth_rad, sun_elevation_rad: where the sun stands, in the frame of the map.
      sun, ambient: light from the sun and from the sky.
      zenith, horizon: colours of the sky.
      fog_per_m: extinction; fog has the colour of the horizon.
      wetness: 0 dry to 1 mirrors on the road.
      rain: streaks, 0 none to 1 many.
      clouds: 0 clear to 1 overcast.
    """

    sun_azimuth_rad: float
    sun_elevation_rad: float
    sun: tuple[float, float, float]
    ambient: tuple[float, float, float]
    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]
    fog_per_m: float
    wetness: float
    rain: float
    clouds: float


WEATHERS = {
    "clear_noon": Weather(0.6, 1.10, (0.62, 0.60, 0.55), (0.46, 0.48, 0.52), (0.25, 0.47, 0.82), (0.70, 0.82, 0.93),
                          0.0015, 0.0, 0.0, 0.25),
    "wet_noon": Weather(0.6, 1.10, (0.38, 0.38, 0.37), (0.50, 0.52, 0.55), (0.42, 0.53, 0.68), (0.74, 0.79, 0.84),
                        0.003, 0.8, 0.0, 0.6),
    "hard_rain_noon": Weather(0.6, 1.10, (0.08, 0.08, 0.09), (0.56, 0.58, 0.61), (0.45, 0.48, 0.53),
                              (0.62, 0.65, 0.68), 0.010, 1.0, 1.0, 1.0),
    "clear_sunset": Weather(2.6, 0.22, (0.72, 0.46, 0.22), (0.36, 0.34, 0.40), (0.30, 0.36, 0.60), (0.95, 0.66, 0.42),
                            0.0025, 0.0, 0.0, 0.35),
    "fog_morning": Weather(-1.2, 0.40, (0.18, 0.17, 0.15), (0.56, 0.57, 0.58), (0.66, 0.68, 0.71), (0.80, 0.81, 0.82),
                           0.022, 0.3, 0.0, 1.0),
    "overcast": Weather(0.2, 0.90, (0.12, 0.12, 0.12), (0.52, 0.53, 0.54), (0.58, 0.61, 0.65), (0.76, 0.78, 0.80),
                        0.003, 0.0, 0.0, 1.0),
    "clear_dusk": Weather(2.9, 0.06, (0.24, 0.14, 0.12), (0.30, 0.30, 0.42), (0.10, 0.13, 0.32), (0.62, 0.40, 0.42),
                          0.003, 0.0, 0.0, 0.3),
    "soft_rain_sunset": Weather(2.6, 0.22, (0.30, 0.20, 0.12), (0.42, 0.38, 0.40), (0.40, 0.40, 0.48),
                                (0.78, 0.60, 0.48), 0.007, 0.9, 0.4, 0.8),
}
TRAINING_WEATHERS = ("clear_noon", "wet_noon", "hard_rain_noon", "clear_sunset")
HELD_OUT_WEATHERS = ("fog_morning", "overcast", "clear_dusk", "soft_rain_sunset")


@dataclasses.dataclass(frozen=True)
class Split:
    """`runs` drives of `frames` frames each; run i has weather i modulo their number and its own route and traffic.

    The last `restless` of them are driven with bursts of braking, throttle and steering (driver.burst), in other towns,
    of seeds town seed + 1 and + 2 by turns.
    """

    runs: int
    frames: int
    weathers: tuple[str, ...]
    first_seed: int
    restless: int = 0


SIZES = {
    "default": {
        # Twelve restless drives were added to the 24 (2026-11-28, before the model with a memory was tuned): three slow
        # sines about an expert's actions teach neither what a pedal does nor a street that looks otherwise.
        "train": Split(36, 100, TRAINING_WEATHERS, 1_000, restless=12),
        "val_rl": Split(8, 60, TRAINING_WEATHERS, 2_000),
        "val_ds": Split(8, 60, HELD_OUT_WEATHERS, 3_000),
    },
    "large": {  # for trainings of hours; the held-out drives are those of "default"
        "train": Split(144, 100, TRAINING_WEATHERS, 1_000, restless=48),
        "val_rl": Split(8, 60, TRAINING_WEATHERS, 2_000),
        "val_ds": Split(8, 60, HELD_OUT_WEATHERS, 3_000),
    },
    "tiny": {
        "train": Split(2, 12, TRAINING_WEATHERS, 1_000),
        "val_rl": Split(1, 12, TRAINING_WEATHERS, 2_000),
        "val_ds": Split(1, 12, HELD_OUT_WEATHERS, 3_000),
    },
}


@dataclasses.dataclass(frozen=True)
class TownConfig:
    """A town, its traffic and the sensors of the ego vehicle.

    Attributes:
      seed: of the map (roads, houses, trees, parked cars).
      camera_height_px, camera_width_px, camera_fov_rad: the camera looks ahead, level, from the lidar's position.
      camera_range_m, lidar_range_m: how far the sensors see solid things.
      blocks, block_m: a grid of blocks x blocks with streets this far apart (shortest, longest).
      missing_streets: share of streets that are left out.
      moving_cars, pedestrians: in the whole town.
      parked_share: share of taken parking slots.
      cruise_mps: speed that drivers like on a straight street (slowest, fastest).
      turn_mps: speed in a junction turn.
      route_m: length of the planned route; the drive ends with it.
      action_noise: standard deviation of the expert's smooth (acceleration, steering) noise.
      lane_wander_m: amplitude of the expert's slow swaying about the middle of the lane.
      labels: whether classes of lidar points and the ground plan from above are recorded too (labels.py).
    """

    seed: int = 0
    camera_height_px: int = 64
    camera_width_px: int = 256
    camera_fov_rad: float = math.radians(100)
    camera_range_m: float = 150.0
    lidar: config_lib.RangeViewGeometry = config_lib.RangeViewGeometry(rows=64, columns=256)
    lidar_range_m: float = 80.0
    voxels: config_lib.VoxelGrid = config_lib.VoxelGrid((48, 48, 16), 1.0, (-24.0, -24.0, -1.5))
    contract: config_lib.ActionContract = config_lib.ActionContract()
    blocks: int = 4
    block_m: tuple[float, float] = (58.0, 84.0)
    missing_streets: float = 0.15
    moving_cars: int = 26
    pedestrians: int = 36
    parked_share: float = 0.4
    cruise_mps: tuple[float, float] = (8.0, 10.0)
    turn_mps: float = 5.0
    route_m: float = 800.0
    action_noise: tuple[float, float] = (0.12, 0.03)
    lane_wander_m: float = 0.35
    labels: bool = False

    def __post_init__(self):
        if self.contract.kinematics != "bicycle":
            raise ValueError(f"The town drives by the bicycle model; contract.kinematics is "
                             f"{self.contract.kinematics!r}.")
        if self.blocks < 2:
            raise ValueError(f"blocks is {self.blocks}; a town needs at least 2.")


def from_config(config: config_lib.Config) -> TownConfig:
    """The town whose sensors have exactly the sizes that the model of `config` wants."""
    height, width = config.model.image_size
    return TownConfig(seed=config.data.town_seed, camera_height_px=height, camera_width_px=width,
                      lidar=config.model.range_view, voxels=config.model.voxels, contract=config.contract,
                      labels=not {"semantic_range_view", "birds_eye"}.isdisjoint(config.model.heads))
