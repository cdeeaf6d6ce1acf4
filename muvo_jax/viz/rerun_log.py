"""A file for the Rerun viewer (rerun.io): what was recorded, what a model makes of it, and baselines, in one space.

    ego                     stands where the car is, in the frame of the window's first observation
    ego/SOURCE/camera       pinhole; its picture below it
    ego/SOURCE/points       the range view as points
    ego/SOURCE/voxels       occupied ones as boxes
    range/SOURCE            the range view as a picture, m
    path                    where the car drives
    action/acceleration, action/steering, phase

Everything lies below the name of the window where there are several. Timelines: "frame" of the window, and "time" since
the last observed one. Written without a viewer or a screen.
"""

from __future__ import annotations

import importlib.util
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from muvo_jax import types
from muvo_jax.viz import canvas, panels, sheets

_POINT_RADIUS_M = 0.06


def check(path: pathlib.Path) -> None:
    """For the moment before anything takes long.

    Raises:
      ValueError: where Rerun is missing, or the file is not named *.rrd, by which its viewer knows it.
    """
    if importlib.util.find_spec("rerun") is None:
        raise ValueError("--rerun needs the Rerun SDK, which is not installed: pip install 'muvo_jax[viz]'")
    if path.suffix != ".rrd":
        raise ValueError(f"--rerun: got {path}, expected the name of a file FILE.rrd, such as {path.stem}.rrd")


class RerunLog:
    """A file that grows by windows; `close` completes it."""

    def __init__(self, path: pathlib.Path):
        """Begins the file; raises what `check` does."""
        check(path)
        self.path = path.expanduser()
        import rerun  # with pyarrow, which nothing else needs

        self._rerun: Any = rerun
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = rerun.RecordingStream("muvo_jax")
        self._stream.set_log_time_enabled(False)  # else the viewer would play the moments of writing
        self._stream.set_log_tick_enabled(False)
        self._stream.save(self.path)

    def close(self) -> pathlib.Path:
        """Writes what is left; returns the file."""
        self._stream.flush()
        self._stream.disconnect()
        return self.path

    def window(self, batch: types.Batch, sources: Mapping[str, Sequence[sheets.View]], scene: sheets.Scene, *,
               context: int, poses: np.ndarray | None = None, name: str = "") -> None:
        """Logs the first window of a batch.

        Args:
          batch: [B, T, ...]; its calibration and actions are read.
          sources: title -> T frames, "truth" among them; frames may lack what a source does not say.
          scene: the sensors' geometry and the pace.
          context: how many frames at the start were observed.
          poses: float [T, 3], forward and left (m) and turn to the left (rad) of the car in the frame of the first one;
            None where nobody knows.
          name: of the window, where the file has several.
        """
        rerun, stream, at = self._rerun, self._stream, _below(name)
        stream.log(at(), rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if poses is not None:
            line = np.pad(np.asarray(poses)[:, :2], ((0, 0), (0, 1)))
            stream.log(at("path"), rerun.LineStrips3D([line], radii=0.1, colors=canvas.IMAGINED), static=True)
        cameras = self._log_cameras(batch, sources, at)
        for frame, action in enumerate(np.asarray(batch.action[0])):
            stream.set_time("frame", sequence=frame)
            stream.set_time("time", duration=(frame - context + 1) * scene.frame_s)
            stream.log(at("phase"), rerun.TextLog("observed" if frame < context else "imagined"))
            stream.log(at("action", "acceleration"), rerun.Scalars(float(action[0])))
            stream.log(at("action", "steering"), rerun.Scalars(float(action[1])))
            if poses is not None:
                x, y, turn_rad = (float(part) for part in poses[frame])
                stream.log(at("ego"), rerun.Transform3D(translation=(x, y, 0.0), quaternion=rerun.Quaternion(
                    xyzw=(0.0, 0.0, np.sin(turn_rad / 2), np.cos(turn_rad / 2)))))
            for source, views in sources.items():
                self._log_view(views[frame], scene, at, source, cameras)

    def _log_cameras(self, batch: types.Batch, sources: Mapping[str, Sequence[sheets.View]], at) -> bool:
        """One pinhole for each source that has pictures; says whether the calibration is known."""
        if batch.intrinsics is None or batch.camera_to_ego is None or batch.image is None:
            return False
        camera_to_ego = np.asarray(batch.camera_to_ego[0])
        height, width = batch.image.shape[2:4]
        pinhole = self._rerun.Pinhole(image_from_camera=np.asarray(batch.intrinsics[0]), width=width, height=height)
        mounting = self._rerun.Transform3D(translation=camera_to_ego[:3, 3], mat3x3=camera_to_ego[:3, :3])
        for source, views in sources.items():
            if "image" in views[0]:
                self._stream.log(at("ego", source, "camera"), pinhole, mounting, static=True)
        return True

    def _log_view(self, view: sheets.View, scene: sheets.Scene, at, source: str, cameras: bool) -> None:
        """One frame of one source."""
        rerun, stream = self._rerun, self._stream
        if "image" in view:
            picture = rerun.Image(panels.camera(view["image"])).compress(jpeg_quality=90)
            stream.log(at("ego", source, "camera", "image") if cameras else at("image", source), picture)
        if "range_view" in view:
            seen = np.asarray(view["range_view"], np.float32)
            returned = seen[..., 3] > scene.threshold_m
            stream.log(at("range", source), rerun.DepthImage(np.where(returned, seen[..., 3], 0.0), meter=1.0))
            points_m = seen[returned][:, :3]
            stream.log(at("ego", source, "points"), rerun.Points3D(
                points_m, colors=_by_height(points_m[:, 2], scene), radii=_POINT_RADIUS_M))
        if "occupancy" in view:
            grid = scene.grid
            cells = np.argwhere(view["occupancy"] == types.OCCUPANCY_OCCUPIED)
            centres_m = np.asarray(grid.origin_m) + (cells + 0.5) * grid.voxel_size_m
            stream.log(at("ego", source, "voxels"), rerun.Boxes3D(
                centers=centres_m, half_sizes=np.full((len(cells), 3), grid.voxel_size_m / 2),
                colors=_by_height(centres_m[:, 2], scene), fill_mode="solid"))


def _by_height(height_m: np.ndarray, scene: sheets.Scene) -> np.ndarray:
    """The colours of `panels`."""
    return canvas.colour_map(panels.height_fraction(height_m, panels.height_span(scene.grid)), canvas.HEIGHT_COLOURS)


def _below(name: str):
    """A function from parts to the path of an entity below the window's name."""
    return lambda *parts: "/".join((*([name] if name else []), *(part.replace(" ", "_") for part in parts))) or "/"
