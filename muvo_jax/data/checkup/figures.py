"""What the frames of a recording show one by one, counted: pictures, scans, voxels and labels (see examination.py)."""

from __future__ import annotations

import collections
import math

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.data import fields, schema
from muvo_jax.data.checkup import judgements
from muvo_jax.data.checkup.judgements import Finding
from muvo_jax.ops import camera as camera_ops
from muvo_jax.ops import voxels

_OCCUPANCY_VALUES = (voxels.EMPTY, voxels.OCCUPIED, voxels.UNKNOWN)
_EVERY = 8  # point of a scan is projected into the picture
_FEWEST_POINTS = 100  # of these, for shares to mean something
_LEAST_IN_PICTURE = 0.05
_LEAST_DEPTH_RATIO, _MOST_DEPTH_RATIO = 0.5, 2.0
_DEPTH_UNITS = {"millimetres": 10.0, "256ths of a metre": 2.56, "metres": 0.01, "decimetres": 0.1,
                "centimetres, in .npz": 100.0, "millimetres, in .npz": 1000.0}
_MANY_ZEROS = 0.01
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
        self._in_picture: list[float] = []
        self._depth_ratio: list[float] = []
        self._previous: dict[str, np.ndarray] = {}

    def add(self, frame: schema.RawFrame) -> None:
        self._counts["frames"] += 1
        if "image" in frame:
            self._add_image(frame["image"], float(frame.get("speed_mps", 1.0)))
        if "points_m" in frame and self._described.lidar is not None:
            self._add_points(frame["points_m"], self._described.lidar, float(frame.get("speed_mps", 1.0)))
            if {"image", "intrinsics"} <= frame.keys():
                self._add_projected(frame)
            if "occupancy" in frame and self._described.voxels is not None and len(frame["points_m"]):
                self._in_voxels.append(_share_in_voxels(frame["points_m"], frame["occupancy"], self._described.voxels))
        self._add_labels(frame)

    def merge(self, others: list[Figures]) -> Figures:
        for other in others:
            self._counts += other._counts
            for name in ("_points", "_outside", "_road_m", "_range_m", "_in_voxels", "_in_picture", "_depth_ratio"):
                getattr(self, name).extend(getattr(other, name))
            self._strange = other._strange | self._strange
        return self

    def findings(self) -> list[Finding]:
        return [*self._of_presence(), *self._of_images(), *self._of_scans(), *self._of_depth(), *self._of_labels()]

    def _add_image(self, image: np.ndarray, speed_mps: float) -> None:
        self._counts["image"] += 1
        self._counts["dark"] += int(image.max() - image.min() < 8)
        self._counts["frozen"] += self._is_frozen("image", image, speed_mps)

    def _is_frozen(self, name: str, values: np.ndarray, speed_mps: float) -> bool:
        """Whether a sensor gives what it gave the frame before, although the car moves."""
        before, self._previous[name] = self._previous.get(name), values
        return before is not None and speed_mps > judgements.MOVING_MPS and np.array_equal(values, before)

    def _add_points(self, points_m: np.ndarray, lidar: config_lib.RangeViewGeometry, speed_mps: float) -> None:
        self._points.append(len(points_m))
        if not len(points_m):
            return
        self._counts["frozen scans"] += self._is_frozen("points_m", points_m, speed_mps)
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

    def _add_projected(self, frame: schema.RawFrame) -> None:
        """How much of a scan the picture sees, as a share of what a lidar all around has in its field of view, and
        depth over the scan's."""
        points_m, (height_px, width_px) = frame["points_m"][::_EVERY], frame["image"].shape[:2]
        points_m = points_m[np.isfinite(points_m).all(axis=1)]
        if len(points_m) < _FEWEST_POINTS:
            return
        place_px, depth_m = camera_ops.project_to_image(points_m, frame["intrinsics"], frame["camera_to_ego"])
        inside = ((place_px >= 0) & (place_px < [width_px, height_px])).all(axis=1)  # not of NaN, behind the camera
        view_rad = 2 * math.atan(0.5 * width_px / float(frame["intrinsics"][0, 0]))
        self._in_picture.append(float(inside.mean()) * 2 * math.pi / view_rad)
        if "depth_m" not in frame or frame["depth_m"].shape != (height_px, width_px):
            return
        column, row = place_px[inside].astype(int).T
        recorded_m = frame["depth_m"][row, column]
        known = np.isfinite(recorded_m) & (recorded_m > 0)
        if known.sum() >= _FEWEST_POINTS // 4:
            self._depth_ratio.append(float(np.median(recorded_m[known] / depth_m[inside][known])))

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
            self._counts["depth pixels"] += depth_m.size
            self._counts["depth zeros"] += int((depth_m == 0).sum())
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
        if self._counts["frozen scans"]:
            found.append(Finding("problem", f"{self._counts['frozen scans']} of {len(self._points)} scans are copies "
                                            f"of the one before, although the car moves."))
        if self._in_picture and np.median(self._in_picture) < _LEAST_IN_PICTURE:
            found.append(Finding("problem", f"hardly a return of the lidar falls into the picture "
                                            f"({np.median(self._in_picture):.2%} of those in as wide a view); do "
                                            f"camera_to_ego and the points look the same way?"))
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

    def _of_depth(self) -> list[Finding]:
        found = []
        ratio = float(np.median(self._depth_ratio)) if self._depth_ratio else 1.0
        if not _LEAST_DEPTH_RATIO < ratio < _MOST_DEPTH_RATIO:
            unit = next((f" (written in {unit}?)" for unit, factor in _DEPTH_UNITS.items()
                         if 0.8 < ratio / factor < 1.25), "")
            found.append(Finding("problem", f"depth_m is {ratio:.3g} times what the scans say; a picture of depth "
                                            f"holds centimetres along the optical axis, an .npz file metres{unit}."))
        zeros, pixels = self._counts["depth zeros"], self._counts["depth pixels"]
        if zeros > _MANY_ZEROS * pixels:
            found.append(Finding("remark", f"depth is 0 in {zeros / pixels:.0%} of the pixels: they count as not "
                                           f"measured, and no head learns from them."))
        return found

    def _of_labels(self) -> list[Finding]:
        return [Finding("problem", f"{name} has values that it cannot have in {self._counts[f'strange {name}']} of "
                                   f"{self._counts['frames']} frames: {what}.")
                for name, what in sorted(self._strange.items())]


def _share_in_voxels(points_m: np.ndarray, occupancy: np.ndarray, grid: config_lib.VoxelGrid) -> float:
    index, inside = voxels.voxel_index(points_m, grid)
    return float((occupancy[tuple(index[inside].T)] == 1).mean()) if inside.any() else 0.0
