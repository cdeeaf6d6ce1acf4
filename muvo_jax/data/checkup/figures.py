"""What the frames of a recording show one by one, counted: pictures, scans, voxels and labels (see examination.py)."""

from __future__ import annotations

import collections

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import fields, schema
from muvo_jax.data.checkup import judgements
from muvo_jax.data.checkup.judgements import Finding
from muvo_jax.ops import voxels

_OCCUPANCY_VALUES = (voxels.EMPTY, voxels.OCCUPIED, voxels.UNKNOWN)
_FARTHEST_M, _NARROWEST_M = 400.0, 2.0  # where no lidar's typical return lies, if lengths are metres


class Figures:
    """Counts over the frames of one stretch, read in their order; `merge` adds those of others."""

    def __init__(self, described: schema.RecordingDescription):
        self._described = described
        self._counts: collections.Counter[str] = collections.Counter()
        self._points: list[int] = []
        self._outside: list[float] = []
        self._road_m: list[float] = []
        self._range_m: list[float] = []
        self._in_voxels: list[float] = []
        self._strange: dict[str, str] = {}  # field -> the first value that it cannot have
        self._previous: np.ndarray | None = None

    def add(self, frame: schema.RawFrame) -> None:
        self._counts["frames"] += 1
        if "image" in frame:
            self._add_image(frame["image"], float(frame.get("speed_mps", 1.0)))
        if "points_m" in frame and self._described.lidar is not None:
            self._add_points(frame["points_m"], self._described.lidar)
            if "occupancy" in frame and self._described.voxels is not None and len(frame["points_m"]):
                self._in_voxels.append(_share_in_voxels(frame["points_m"], frame["occupancy"], self._described.voxels))
        self._add_labels(frame)

    def merge(self, others: list[Figures]) -> Figures:
        for other in others:
            self._counts += other._counts
            for name in ("_points", "_outside", "_road_m", "_range_m", "_in_voxels"):
                getattr(self, name).extend(getattr(other, name))
            self._strange = other._strange | self._strange
        return self

    def findings(self) -> list[Finding]:
        return [*self._of_presence(), *self._of_images(), *self._of_scans(), *self._of_labels()]

    def _add_image(self, image: np.ndarray, speed_mps: float) -> None:
        self._counts["image"] += 1
        self._counts["dark"] += int(image.max() - image.min() < 8)
        self._counts["frozen"] += int(self._previous is not None and np.array_equal(image, self._previous)
                                      and speed_mps > judgements.MOVING_MPS)
        self._previous = image

    def _add_points(self, points_m: np.ndarray, lidar: config_lib.RangeViewGeometry) -> None:
        self._points.append(len(points_m))
        if not len(points_m):
            return
        relative_m = points_m - np.asarray(lidar.position_m, np.float32)[None]
        flat_m = np.hypot(relative_m[:, 0], relative_m[:, 1])
        elevation_rad = np.arctan2(relative_m[:, 2], flat_m)
        margin_rad = (lidar.elevation_max_rad - lidar.elevation_min_rad) / lidar.rows
        self._outside.append(float(((elevation_rad < lidar.elevation_min_rad - margin_rad) |
                                    (elevation_rad > lidar.elevation_max_rad + margin_rad)).mean()))
        self._range_m.append(float(np.quantile(flat_m, 0.9)))
        near = (np.abs(points_m[:, 1]) < 2.0) & (np.abs(points_m[:, 0]) < 12.0)
        if near.sum() > 20:
            self._road_m.append(float(np.median(points_m[near, 2])))

    def _add_labels(self, frame: schema.RawFrame) -> None:
        """Looks for values that a label cannot have."""
        classes = len(self._described.classes)
        for name in ("image_classes", "point_classes"):
            if name not in frame or not classes:
                continue
            known = frame[name][frame[name] != fields.UNKNOWN]  # type: ignore[literal-required]
            if known.size and known.max() >= classes:
                self._note(frame, name, f"class {int(known.max())}, but the recording names {classes} classes (0 to "
                                        f"{classes - 1})")
        if "occupancy" in frame and not np.isin(frame["occupancy"], _OCCUPANCY_VALUES).all():
            values = sorted(set(np.unique(frame["occupancy"]).tolist()) - set(_OCCUPANCY_VALUES))
            self._note(frame, "occupancy", f"{values[:5]}, expected 0 (empty), 1 (occupied) or 255 (unknown)")
        if "depth_m" in frame:
            depth_m = frame["depth_m"]
            if not (np.isposinf(depth_m) | (depth_m > 0)).any():
                self._note(frame, "depth_m", "no pixel that is measured")

    def _note(self, frame: schema.RawFrame, name: str, what: str) -> None:
        self._counts[f"strange {name}"] += 1
        self._strange.setdefault(name, f"frame {int(frame['frame_id'])} holds {what}")

    def _of_presence(self) -> list[Finding]:
        described = self._described
        return [Finding("remark", f"a {sensor} is described, but no frame has {what}.")
                for sensor, field, there, what in (("camera", "image", described.camera, "an image"),
                                                   ("lidar", "points_m", described.lidar, "a scan"))
                if there is not None and field not in described.modalities]

    def _of_images(self) -> list[Finding]:
        found, counts = [], self._counts
        if counts["dark"]:
            found.append(Finding("problem", f"{counts['dark']} of {counts['image']} images are of one colour."))
        if counts["frozen"]:
            found.append(Finding("problem", f"{counts['frozen']} of {counts['image']} images are copies of the one "
                                            f"before, although the car moves."))
        return found

    def _of_scans(self) -> list[Finding]:
        found = []
        empty = self._points.count(0)
        if empty:
            found.append(Finding("problem", f"{empty} of {len(self._points)} scans are empty."))
        if self._points:
            found.append(Finding("remark", f"a scan has {int(np.median(self._points))} points "
                                           f"({min(self._points)} to {max(self._points)})."))
        if self._outside and np.mean(self._outside) > 0.05:
            found.append(Finding("problem", f"{np.mean(self._outside):.0%} of the points lie above or below the "
                                            f"lidar's described field of view; correct its elevation and position."))
        usual_m = float(np.median(self._range_m)) if self._range_m else np.nan
        if usual_m > _FARTHEST_M or usual_m < _NARROWEST_M:
            found.append(Finding("problem", f"nine in ten points lie within {usual_m:.3g} m of the lidar, expected "
                                            f"{_NARROWEST_M:g} to {_FARTHEST_M:g}; are they in metres?"))
        elif self._road_m and abs(np.median(self._road_m)) > 0.5:
            found.append(Finding("problem", f"the road under the car is at z = {np.median(self._road_m):.2f} m, "
                                            f"expected about 0; correct the height of the points or of the lidar."))
        if self._in_voxels and np.mean(self._in_voxels) < 0.8:
            found.append(Finding("problem", f"only {np.mean(self._in_voxels):.0%} of the points lie in occupied "
                                            f"voxels; the grid is described wrongly, or they are of other frames."))
        return found

    def _of_labels(self) -> list[Finding]:
        return [Finding("problem", f"{name} has values that it cannot have in {self._counts[f'strange {name}']} of "
                                   f"{self._counts['frames']} frames: {what}.")
                for name, what in sorted(self._strange.items())]


def _share_in_voxels(points_m: np.ndarray, occupancy: np.ndarray, grid: config_lib.VoxelGrid) -> float:
    index, inside = voxels.voxel_index(points_m, grid)
    return float((occupancy[tuple(index[inside].T)] == 1).mean()) if inside.any() else 0.0
