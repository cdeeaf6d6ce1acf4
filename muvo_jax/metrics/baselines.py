"""What a prediction must beat: the last observed frame, and the mean of the training frames."""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import flax.struct
import jax
import numpy as np

from muvo_jax import types
from muvo_jax.head import SCALES
from muvo_jax.ops import resample

Frames = dict[str, np.ndarray]
SENSORS = ("image", "range_view", "occupancy")  # what baselines predict


def copy_last(batch: types.Batch, context: int, horizon: int) -> tuple[Frames, int]:
    """The last observed frame as the prediction of every later one.

    An unknown voxel copies as empty: a prediction has to say something about every voxel.

    Args:
      batch: windows of at least `context` frames.
      context: frames that were observed.
      horizon: frames to predict.

    Returns:
      {"image": float32 [B, horizon, H, W, 3] in [0, 1], "range_view": float32 [...] in metres, "occupancy": bool
      [...]}, as read-only views without the modalities that the batch lacks, and the number of voxels copied from
      unknown (of one frame per window).
    """
    last = {name: np.asarray(value[:, context - 1]) for name in SENSORS if (value := getattr(batch, name)) is not None}
    unknown = 0
    if "image" in last:
        last["image"] = last["image"].astype(np.float32) / 255.0
    if "occupancy" in last:
        unknown = int((last["occupancy"] == types.OCCUPANCY_UNKNOWN).sum())
        last["occupancy"] = last["occupancy"] == types.OCCUPANCY_OCCUPIED
    return {name: np.broadcast_to(value[:, None], (value.shape[0], horizon, *value.shape[1:]))
            for name, value in last.items()}, unknown


@flax.struct.dataclass
class TrainingMean:
    """Sums over training frames; every field is None for a modality that is absent.

    Attributes:
      frames: how many frames went in.
      image: float64 [H, W, 3], sum of pixel values 0..255.
      range_view: float64 [Hr, Wr, 4], sum over the frames in which the pixel has a return.
      returned: int64 [Hr, Wr], how many these are.
      occupied, known: {scale: int64 [X / scale, Y / scale, Z / scale]}, frames in which the voxel is occupied, and in
        which it is not unknown; coarse voxels as they are trained (objectives/labels.py).
      action: float64 [2], sum of squares.
    """

    frames: int = 0
    image: np.ndarray | None = None
    range_view: np.ndarray | None = None
    returned: np.ndarray | None = None
    occupied: dict[int, np.ndarray] | None = None
    known: dict[int, np.ndarray] | None = None
    action: np.ndarray | None = None

    def add(self, batch: types.Batch) -> TrainingMean:
        """With all frames of a batch."""
        sums: dict[str, Any] = {"frames": batch.batch_size * batch.frames,
                                "action": np.square(np.asarray(batch.action, np.float64)).sum(axis=(0, 1))}
        if batch.image is not None:
            sums["image"] = np.asarray(batch.image).sum(axis=(0, 1), dtype=np.float64)
        if batch.range_view is not None:
            range_view = np.asarray(batch.range_view)
            returned = range_view[..., 3] > 0.0
            sums["range_view"] = np.where(returned[..., None], range_view, 0.0).sum(axis=(0, 1), dtype=np.float64)
            sums["returned"] = returned.sum(axis=(0, 1), dtype=np.int64)
        if batch.occupancy is not None:
            coarse = {1: np.asarray(batch.occupancy)}
            for scale in SCALES[1:]:
                if any(side % 2 for side in coarse[scale // 2].shape[2:]):
                    break  # no decoder has such scales
                coarse[scale] = resample.pool_occupancy(coarse[scale // 2])
            count = lambda mask: mask.sum(axis=(0, 1), dtype=np.int64)
            sums["occupied"] = {scale: count(value == types.OCCUPANCY_OCCUPIED) for scale, value in coarse.items()}
            sums["known"] = {scale: count(value != types.OCCUPANCY_UNKNOWN) for scale, value in coarse.items()}
        before = {name: getattr(self, name) for name in sums}
        return dataclasses.replace(self, **{
            name: value if before[name] is None else jax.tree.map(operator.add, before[name], value)
            for name, value in sums.items()})

    def prediction(self) -> Frames:
        """The mean frame: {"image": float32 [H, W, 3] in [0, 1], "range_view": float32 [Hr, Wr, 4], "occupancy": bool}.

        A pixel of the range view is the mean of its returns where more than half of the frames return, and a hole
        (0, 0, 0, -1) elsewhere. A voxel is occupied where more than half of the frames that know it say so; one that no
        frame knows is empty.

        Raises:
          ValueError: where no frame went in.
        """
        if not self.frames:
            raise ValueError("training mean: no frame was added; add at least one batch before asking for the mean.")
        mean: Frames = {}
        if self.image is not None:
            mean["image"] = (self.image / (255.0 * self.frames)).astype(np.float32)
        if self.range_view is not None and self.returned is not None:
            hole = np.array([0.0, 0.0, 0.0, types.RANGE_NO_RETURN_M])
            returns = np.greater(2 * self.returned, self.frames)
            values = self.range_view / np.maximum(self.returned, 1)[..., None]
            mean["range_view"] = np.where(returns[..., None], values, hole).astype(np.float32)
        if self.occupied is not None and self.known is not None:
            mean["occupancy"] = 2 * self.occupied[1] > self.known[1]
        return mean
