"""The pytrees that every part of muvo_jax exchanges.

Axes: B batch, T time, N branches or points, H W image rows and columns, C channels (always last), X Y Z voxels,
S stochastic channels, D deterministic channels. With the 2D latent [..., S] and [..., D] are tokens [..., N, C].

Ego frame: x forward, y left, z up, metres, origin on the ground under the ego vehicle.
Time: `action[t]` is applied from t to t+1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
ArrayLike = jax.Array | np.ndarray
Variables = Mapping[str, Any]  # {"params": ..., "batch_stats": ...}, plain nested dictionaries

OCCUPANCY_EMPTY = 0
OCCUPANCY_OCCUPIED = 1
OCCUPANCY_UNKNOWN = 255
RANGE_NO_RETURN_M = -1.0


class _Indexable:
    """Adds `state[:, ::4]`: the same index on every leaf."""

    def __getitem__(self, index):
        return jax.tree.map(lambda leaf: leaf[index], self)


@flax.struct.dataclass
class Batch(_Indexable):
    """Windows of consecutive observations, as the sensors gave them (the model normalises).

    A modality that the recording lacks is None, never a zero array.

    Attributes:
      action: float32 [B, T, 2], (acceleration, steering), each in [-1, 1]; steering > 0 is right. Where a step spans
        several recorded frames, the mean of theirs or the first, as config.ActionContract.step_action says.
      is_first: bool [B, T], true at the first step of a window and wherever a recording restarts.
      image: uint8 [B, T, H, W, 3], RGB.
      range_view: float32 [B, T, Hr, Wr, 4], x, y, z (ego frame, m) and range from the lidar (m);
        0, 0, 0 and -1 where nothing returned.
      points: float32 [B, T, N, 3], the scan, ego frame, m; only where PointPillars reads it.
      point_count: int32 [B, T], how many of the N rows are points; the others are ignored.
      occupancy: uint8 [B, T, X, Y, Z], 0 empty, 1 occupied, 255 unknown.
      route_map: uint8 [B, T, 64, 64], planned route from above, 255 on route; row 0 is farthest ahead.
      speed_mps: float32 [B, T].
      command, next_command: int32 [B, T], what the navigation says, 0 to 5, and what it will say then.
      target_m, next_target_m: float32 [B, T, 2], the places that the two commands belong to, seen from the ego.
      depth_m: float32 [B, T, H, W], along the optical axis of `image`; -1 where nothing is near enough to be measured.
      image_classes: uint8 [B, T, H, W], what each pixel shows; 255 unlabelled.
      image_instance_mask: bool [B, T, H, W], whether the pixel shows a vehicle or pedestrian.
      image_moving_mask: bool [B, T, H, W] and occupancy_moving_mask: bool [B, T, X, Y, Z], where road users on the move
        are; only scores read them.
      range_view_classes: uint8 [B, T, Hr, Wr], what each pixel of `range_view` hit; 255 where nothing returned.
      birds_eye_classes: uint8 [B, T, X, Y], what lies on each cell of the ground plan of `occupancy`; 255 unknown.
      birds_eye_instances: int32 [B, T, X, Y], the vehicle or pedestrian there, numbered from 1 in each frame; 0 none.
      reward: float32 [B, T].
      is_terminal: bool [B, T].
      ego_motion: float32 [B, T, 4], forward and left (m) in the ego frame of the window's frame before, turn to the
        left (rad) since then, and speed (m/s); the first three are meaningless where is_first.
      intrinsics: float32 [B, 3, 3], of the image as it is here, after resizing and cropping.
      camera_to_ego: float32 [B, 4, 4], camera frame (x right, y down, z forward) to ego frame.
    """

    action: ArrayLike
    is_first: ArrayLike
    image: ArrayLike | None = None
    range_view: ArrayLike | None = None
    points: ArrayLike | None = None
    point_count: ArrayLike | None = None
    occupancy: ArrayLike | None = None
    depth_m: ArrayLike | None = None
    image_classes: ArrayLike | None = None
    image_instance_mask: ArrayLike | None = None
    image_moving_mask: ArrayLike | None = None
    occupancy_moving_mask: ArrayLike | None = None
    range_view_classes: ArrayLike | None = None
    birds_eye_classes: ArrayLike | None = None
    birds_eye_instances: ArrayLike | None = None
    route_map: ArrayLike | None = None
    speed_mps: ArrayLike | None = None
    command: ArrayLike | None = None
    next_command: ArrayLike | None = None
    target_m: ArrayLike | None = None
    next_target_m: ArrayLike | None = None
    reward: ArrayLike | None = None
    is_terminal: ArrayLike | None = None
    ego_motion: ArrayLike | None = None
    intrinsics: ArrayLike | None = None
    camera_to_ego: ArrayLike | None = None

    @property
    def batch_size(self) -> int:
        return self.action.shape[0]

    @property
    def frames(self) -> int:
        return self.action.shape[1]

    def time_slice(self, start: int, stop: int) -> Batch:
        """The same windows, restricted to frames start..stop-1."""
        return self.map_frames(lambda value: value[:, start:stop])

    def map_frames(self, function: Callable[[ArrayLike], ArrayLike]) -> Batch:
        """Applies `function` to every field with a time axis; calibration has none and stays."""
        timed = {name: function(value) for name, value in vars(self).items()
                 if value is not None and name not in UNTIMED_FIELDS}
        return dataclasses.replace(self, **timed)

    def validate(self) -> Batch:
        """Checks dtypes, ranks and common prefixes (static under jit).

        Raises:
          ValueError: naming the field, what came and what was expected.
        """
        for name, (dtype, rank) in BATCH_FIELDS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.dtype != dtype or value.ndim != rank:
                raise ValueError(f"Batch.{name}: got {value.dtype}{list(value.shape)}, expected {np.dtype(dtype).name} "
                                 f"with {rank} axes (see muvo_jax.types.Batch).")
            prefix = 1 if name in UNTIMED_FIELDS else 2
            if value.shape[:prefix] != self.action.shape[:prefix]:
                raise ValueError(f"Batch.{name}: leading axes {value.shape[:prefix]} differ from those of action, "
                                 f"{self.action.shape[:prefix]}.")
        return self


UNTIMED_FIELDS = ("intrinsics", "camera_to_ego")  # one for each window
BATCH_FIELDS = {  # dtype, rank
    "action": (np.float32, 3), "is_first": (np.bool_, 2), "image": (np.uint8, 5), "range_view": (np.float32, 5),
    "points": (np.float32, 4), "point_count": (np.int32, 2), "command": (np.int32, 2), "next_command": (np.int32, 2),
    "target_m": (np.float32, 3), "next_target_m": (np.float32, 3), "occupancy": (np.uint8, 5),
    "route_map": (np.uint8, 4), "speed_mps": (np.float32, 2), "reward": (np.float32, 2),
    "depth_m": (np.float32, 4), "image_classes": (np.uint8, 4), "range_view_classes": (np.uint8, 4),
    "image_instance_mask": (np.bool_, 4), "image_moving_mask": (np.bool_, 4), "occupancy_moving_mask": (np.bool_, 5),
    "birds_eye_classes": (np.uint8, 4), "birds_eye_instances": (np.int32, 4),
    "is_terminal": (np.bool_, 2), "ego_motion": (np.float32, 3), "intrinsics": (np.float32, 3),
    "camera_to_ego": (np.float32, 3),
}


@flax.struct.dataclass
class Gaussian(_Indexable):
    """A diagonal Gaussian: mean and std, float32 [..., S]."""

    mean: Array
    std: Array

    def sample(self, noise: Array) -> Array:
        """mean + std * noise; zeros give the mean."""
        return self.mean + self.std * noise


@flax.struct.dataclass
class Motion(_Indexable):
    """The car in the ego frame of an earlier moment (x forward, y left).

    Attributes:
      pose: float32 [..., 3], x (m), y (m), yaw (rad, counter-clockwise).
      speed_mps: float32 [...].
    """

    pose: Array
    speed_mps: Array


@flax.struct.dataclass
class Vantage(_Indexable):
    """Where a state stands to what was observed: how decoders know from where they look at a Memory.

    Attributes:
      motion: Motion [...], the car in the ego frame of the memory's newest observation.
      first: int32 [...], the memory's first observation that belongs to this drive.
      last: int32 [...], the newest one that this state has seen.
      steps: int32 [...], imagined since then; at 0 the state is that of the observation `last` itself, which its
        decoders must not look up: their guess comes from the observations before it.
    """

    motion: Motion
    first: Array
    last: Array
    steps: Array


@flax.struct.dataclass
class Memory(_Indexable):
    """The last F observations as they came and where they were taken; held once, without axes of time or branches.

    Attributes:
      pose: float32 [B, F, 3], x, y, yaw of each in the ego frame of the newest, which is the last one.
      range_view: float32 [B, F, Hr, Wr, 4], as Batch.range_view; without lidar there is no memory.
      image: uint8 [B, F, H, W, 3], as Batch.image; None for a model without camera.
      intrinsics, camera_to_ego: float32 [B, 3, 3] and [B, 4, 4]; None without image.
      evidence: float32 [B, X', Y', 2 Z] for voxels, worked out once for many states (glimpse.with_evidence); or None.
      onward: float32 [B, S, X', Y', Z], beside it what moves, S steps ahead (glimpse.VoxelGlimpse); or None.
    """

    pose: Array
    range_view: Array
    image: Array | None = None
    intrinsics: Array | None = None
    camera_to_ego: Array | None = None
    evidence: Array | None = None
    onward: Array | None = None


@flax.struct.dataclass
class LatentState(_Indexable):
    """What the world model knows: the carry of the recurrence, for training, imagination, planning and live use.

    Attributes:
      deterministic: float32 [..., D], the recurrent state h; tokens [..., N, C] with the 2D latent.
      stochastic: float32 [..., S], the sampled state s; tokens [..., N, C] with the 2D latent.
      vantage: Vantage [...] of a model that keeps track of its motion (ModelConfig.tracks_motion), else None.
    """

    deterministic: Array
    stochastic: Array
    vantage: Vantage | None = None

    @property
    def features(self) -> Array:
        """float32 [..., D + S] ([..., N, 2 C] with the 2D latent), what decoders read: h first, as in the reference.

        Policies and rewards that want one vector for either latent take WorldModel.policy_features of it.
        """
        return jnp.concatenate([self.deterministic, self.stochastic], axis=-1)


@flax.struct.dataclass
class StepNoise(_Indexable):
    """Everything random in one observed step, drawn outside so that the step itself is deterministic.

    Attributes:
      prior, posterior: standard normal, of the shape of the stochastic state; zeros give the mean mode.
      use_prior: bool [...], true where the next step starts from the prior sample (the paper's RSSM dropout).
      dropout: typed keys [...] of the dropout inside the 2D latent's transformers; None switches it off.
    """

    prior: Array
    posterior: Array
    use_prior: Array
    dropout: Array | None = None


@flax.struct.dataclass
class Observed(_Indexable):
    """What `observe` returns, time on axis 1.

    Attributes:
      states: LatentState [B, T, ...], each with its posterior's sample, which is what decoders read (under the RSSM
        dropout of training, the recurrence itself may have gone on from the prior's).
      posterior, prior: Gaussian [B, T, S].
      memory: Memory [B, ...] of the window, for a model with first_guess="last_seen"; `decode` takes it.
    """

    states: LatentState
    posterior: Gaussian
    prior: Gaussian
    memory: Memory | None = None

    @property
    def last(self) -> LatentState:
        """The state after the last observed frame, where imagination starts."""
        return self.states[:, -1]


@flax.struct.dataclass
class Dream(_Indexable):
    """What `imagine` returns: H imagined steps, time on the axis after the batch (and branch) axes.

    Attributes:
      states: LatentState [B, H, ...] ([B, N, H, ...] with branches); step k is the state after action k.
      actions: float32 [B, H, 2], the actions that were applied.
      prior: Gaussian of each step.
    """

    states: LatentState
    actions: Array
    prior: Gaussian

    @property
    def features(self) -> Array:
        return self.states.features


@flax.struct.dataclass
class Predictions:
    """What `decode` returns: for each decoded head an array [..., *size / scale, channels] at one scale or several.

    `predictions.image` is the full size, `predictions.at_scale(2).image` half of it along every spatial axis. A head
    whose name Python keeps for itself, and one whose name is in a variable, is read with brackets:
    `predictions["continue"]`. Brackets take names only; `jax.tree.map(lambda leaf: leaf[:, 0], predictions)` indexes
    all arrays.

    Attributes:
      arrays: head -> scale (1, 2, 4; 1 is full size) -> float32 [..., *size / scale, channels].
      scale: the one that attributes and brackets read.
    """

    arrays: Mapping[str, Mapping[int, Array]]
    scale: int = flax.struct.field(pytree_node=False, default=1)

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads that have this scale."""
        return tuple(head for head, scales in self.arrays.items() if self.scale in scales)

    def scales(self, head: str) -> Mapping[int, Array]:
        """{scale: array} of a head.

        Raises:
          KeyError: if it was not decoded; names what was.
        """
        if head not in self.arrays:
            raise KeyError(f"the head {head!r} was not decoded; these were: {', '.join(self.arrays) or 'none'}.")
        return self.arrays[head]

    def at_scale(self, scale: int) -> Predictions:
        """The same predictions, read at 1 / scale of the size.

        Raises:
          ValueError: if no head has that scale; names those that there are.
        """
        found = sorted({found for scales in self.arrays.values() for found in scales})
        if scale not in found:
            raise ValueError(f"no decoded head has the scale {scale}; there are {', '.join(map(str, found))}.")
        return dataclasses.replace(self, scale=scale)

    def __getitem__(self, head: str) -> Array:
        if not isinstance(head, str):
            raise TypeError(f"predictions[{head!r}]: brackets take the name of a head, such as 'image'; to index all "
                            f"arrays use jax.tree.map(lambda leaf: leaf[index], predictions).")
        scales = self.scales(head)
        if self.scale not in scales:
            raise KeyError(f"the head {head!r} has no scale {self.scale}; it has {', '.join(map(str, scales))}.")
        return scales[self.scale]

    def __getattr__(self, name: str) -> Array:
        if name.startswith("_") or name == "arrays":  # asked for by copying and pickling, before the fields are there
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(f"Predictions.{name}: {error.args[0]}") from None

    def __contains__(self, head: object) -> bool:
        return head in self.heads

    def __iter__(self) -> Iterator[str]:
        return iter(self.heads)

    def __or__(self, other: Predictions) -> Predictions:
        """The heads of both."""
        return dataclasses.replace(self, arrays={**self.arrays, **other.arrays})
