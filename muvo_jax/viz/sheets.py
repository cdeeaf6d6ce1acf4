"""Truth beside imagination: whole pages (PNG) and animations (GIF) made of the panels of panels.py.

Every frame carries the badge "observed" (the model saw the sensors) or "imagined" (it saw actions alone).
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.viz import canvas, panels

WIDE_PX = 384  # width of camera and range image
SQUARE_PX = 188  # side of the pictures from above: two of them and a gap are as wide as one camera


@dataclasses.dataclass(frozen=True)
class View:
    """One moment as arrays; what is missing is None.

    Attributes:
      image: uint8 or float in [0, 1], [H, W, 3].
      range_view: float32 [Hr, Wr, 4], metres.
      occupancy: uint8 [X, Y, Z], 0 empty, 1 occupied, 255 unknown.
      depth_m, image_classes, range_view_classes, birds_eye_classes: as in types.Batch, where optional heads draw them.
    """

    image: np.ndarray | None = None
    range_view: np.ndarray | None = None
    occupancy: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    image_classes: np.ndarray | None = None
    range_view_classes: np.ndarray | None = None
    birds_eye_classes: np.ndarray | None = None

    def beside(self, truth: View) -> View:
        """Without the optional maps that the truth lacks, so that their panels stand side by side."""
        names = ("depth_m", "image_classes", "range_view_classes", "birds_eye_classes")
        return dataclasses.replace(self, **{name: None for name in names if getattr(truth, name) is None})


@dataclasses.dataclass(frozen=True)
class Moment:
    """One frame of a dream.

    Attributes:
      truth: what was recorded.
      dreams: title -> what the model says, and what baselines say beside it.
      badge: "observed" or "imagined".
      time_s: since the last observed frame.
      action: float [2], applied from this frame to the next.
    """

    truth: View
    dreams: Mapping[str, View]
    badge: str
    time_s: float
    action: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """What all frames of a picture share: the sensors' geometry, the pace and the ranges of the colour scales."""

    grid: config_lib.VoxelGrid
    frame_s: float
    far_m: float = 60.0
    threshold_m: float = 1.0

    @property
    def extent_m(self) -> float:
        """Half the side of the bird's-eye view: that of the voxel grid, so that both show the same ground."""
        return self.grid.shape[0] * self.grid.voxel_size_m / 2.0

    @classmethod
    def of(cls, config: config_lib.Config) -> Scene:
        return cls(grid=config.model.voxels, frame_s=config.data.stride / config.contract.rate_hz,
                   threshold_m=config.evaluation.return_threshold_m)


def views_of_batch(batch: types.Batch, sample: int) -> list[View]:
    """The recorded frames of one window."""
    def at(field, frame):
        return None if field is None else np.asarray(field[sample, frame])
    names = [field.name for field in dataclasses.fields(View)]
    return [View(**{name: at(getattr(batch, name), frame) for name in names}) for frame in range(batch.frames)]


def views_of_frames(frames: Mapping[str, np.ndarray], sample: int | tuple[int, ...]) -> list[View]:
    """The decoded frames of one window: {head: [B, T, ...]}, occupancy as bool; `sample` may index more axes."""
    chosen = {name: np.asarray(value[sample]) for name, value in frames.items()}
    if "occupancy" in chosen:
        chosen["occupancy"] = chosen["occupancy"].astype(np.uint8)
    count = next(iter(chosen.values())).shape[0]
    return [View(**{name: value[frame] for name, value in chosen.items()}) for frame in range(count)]


def dream_frame(columns: Sequence[tuple[str, View]], scene: Scene, *, badge: str, caption: str,
                action: np.ndarray) -> np.ndarray:
    """One animation frame: a column for the truth and one for each prediction, the applied action below."""
    accent = canvas.TAG_COLOURS[badge]
    bodies = [canvas.caption(_view_column(view, scene), title, size_px=14) for title, view in columns]
    body = canvas.stack(bodies, axis=1, gap=18)
    strip = canvas.tag(f"{badge}   {caption}", accent, body.shape[1])
    parts = [strip, body, panels.action_bars(action, min(body.shape[1], 2 * WIDE_PX)),
             legend(columns[0][1], scene, body.shape[1])]
    return canvas.margin(canvas.frame(canvas.margin(canvas.stack(parts, axis=0), 8), accent, 2), 6)


def sensor_sheet(moments: Sequence[Moment], scene: Scene, *, title: str) -> np.ndarray | None:
    """Camera and range image, one moment a row: truth left, dreams right. None where there is neither."""
    rows = []
    for moment in moments:
        groups = [canvas.stack(group, axis=1) for group in _side_by_side(moment, scene, _wide_panels)]
        if not groups:
            return None
        content = canvas.stack(groups, axis=0, gap=4)
        rows.append(canvas.stack([_moment(moment, content.shape[0]), content], axis=1))
    heads = [canvas.blank(20, 132), *(_heading(name, WIDE_PX) for name in ("truth", *moments[0].dreams))]
    page = [_heading(title, rows[0].shape[1], 17), canvas.stack(heads, axis=1), *rows,
            legend(moments[0].truth, scene, rows[0].shape[1], heights=False)]
    return canvas.margin(canvas.stack(page, axis=0, gap=10))


def space_sheet(moments: Sequence[Moment], scene: Scene, *, title: str) -> np.ndarray | None:
    """Bird's-eye points and voxels, one moment a column: truth above, dreams below. None without both."""
    columns = []
    for moment in moments:
        parts = [part for group in _side_by_side(moment, scene, _space_panels) for part in group]
        if not parts:
            return None
        strip = canvas.tag(f"{moment.badge} {moment.time_s:+.1f} s", canvas.TAG_COLOURS[moment.badge], SQUARE_PX, 12)
        columns.append(canvas.stack([strip, *parts], axis=0, gap=5))
    first, names = moments[0].truth, [canvas.blank(20, 96)]
    for what, picture in zip(_space_names(first), _space_panels(first, scene), strict=True):
        names += [_row_name(what, who, picture.shape[0]) for who in ("truth", *moments[0].dreams)]
    body = canvas.stack([canvas.stack(names, axis=0, gap=5), *columns], axis=1, gap=8)
    page = [_heading(title, body.shape[1], 17), body, legend(first, scene, body.shape[1], ranges=False)]
    return canvas.margin(canvas.stack(page, axis=0, gap=10))


def legend(view: View, scene: Scene, columns: int, *, ranges: bool = True, heights: bool = True) -> np.ndarray:
    """Colour bars with units for what the page shows, wrapped to its width."""
    entries = []
    if ranges and view.range_view is not None:
        entries += [canvas.colour_bar(canvas.RANGE_COLOURS, "0 m", f"{scene.far_m:.0f} m", "range (square root)", 120),
                    canvas.swatch(panels.NO_RETURN, "no return")]
    low_m, high_m = panels.height_span(scene.grid)
    if heights and (view.occupancy is not None or view.range_view is not None):
        entries.append(canvas.colour_bar(canvas.HEIGHT_COLOURS, f"{low_m:.1f} m", f"{high_m:.1f} m", "height", 120))
    if heights and view.occupancy is not None:
        entries.append(canvas.swatch(panels.UNKNOWN, "unknown (truth)"))
    lines: list[list[np.ndarray]] = [[]]
    for entry in entries:
        if lines[-1] and sum(part.shape[1] + 18 for part in lines[-1]) + entry.shape[1] > columns:
            lines.append([])
        lines[-1].append(entry)
    rows = [canvas.stack(line, axis=1, gap=18) for line in lines if line]
    return canvas.stack(rows, axis=0, gap=4) if rows else canvas.blank(1, 1)


def write_dream(folder: str | os.PathLike, truth: Sequence[View], predictions: Mapping[str, Sequence[View]],
                actions: np.ndarray, scene: Scene, *, context: int, title: str, name: str = "dream",
                beside: Mapping[str, Sequence[View]] | None = None, most_moments: int = 8,
                animate: bool = True) -> list[pathlib.Path]:
    """Writes NAME.gif, NAME_sensors.png and NAME_space.png for one window.

    Args:
      truth: the recorded frames.
      predictions: title -> decoded frames, as many as truth (the sheets show the first entry).
      actions: float [frames, 2]; action t is applied from t to t + 1.
      context: how many frames at the start were observed.
      beside: the same of baselines, shown behind the predictions everywhere.
      most_moments: the sheets show at most this many frames, evenly spread, the last one included.
      animate: also write the animation.
    """
    folder = pathlib.Path(folder).expanduser()
    fitted = lambda several: {label: [view.beside(truth[frame]) for frame, view in enumerate(views)]
                              for label, views in several.items()}
    beside, predictions = fitted(beside or {}), fitted(predictions)
    first = next(iter(predictions))
    dreams = {first: predictions[first], **beside}
    moments = [Moment(truth[frame], {label: views[frame] for label, views in dreams.items()},
                      "observed" if frame < context else "imagined",
                      (frame - context + 1) * scene.frame_s, actions[frame]) for frame in range(len(truth))]
    written = []
    if animate:
        pictures = [dream_frame([("truth", moment.truth), *((label, views[frame])
                                                            for label, views in {**predictions, **beside}.items())],
                                scene, badge=moment.badge, caption=f"{moment.time_s:+.1f} s   {title}",
                                action=moment.action) for frame, moment in enumerate(moments)]
        written.append(canvas.save_gif(folder / f"{name}.gif", pictures, max(scene.frame_s, 0.3)))
    chosen = np.unique(np.linspace(0, len(truth) - 1, min(most_moments, len(truth))).round().astype(int))
    picked = [moments[frame] for frame in chosen]
    for suffix, page in (("sensors", sensor_sheet(picked, scene, title=title)),
                         ("space", space_sheet(picked, scene, title=title))):
        if page is not None:
            written.append(canvas.save_png(folder / f"{name}_{suffix}.png", page))
    return written


def _side_by_side(moment: Moment, scene: Scene,
                  panels_of: Callable[[View, Scene], list[np.ndarray]]) -> list[list[np.ndarray]]:
    """For each panel of the truth the pictures of truth and dreams, blank where a dream ends before it."""
    truth, *dreams = (panels_of(view, scene) for view in (moment.truth, *moment.dreams.values()))
    return [[picture, *(dream[index] if index < len(dream) else canvas.blank(*picture.shape[:2]) for dream in dreams)]
            for index, picture in enumerate(truth)]


def _heading(text: str, columns: int, size_px: int = 14) -> np.ndarray:
    strip = canvas.blank(size_px + 6, max(columns, canvas.text_width_px(text, size_px)))
    return canvas.write(strip, text, 1, 0, size_px=size_px)


def _moment(moment: Moment, rows: int) -> np.ndarray:
    """The left margin of a row: badge, time and action."""
    strip = canvas.tag(moment.badge, canvas.TAG_COLOURS[moment.badge], 132)
    clock = canvas.write(canvas.blank(22, 132), f"{moment.time_s:+.1f} s", 11, 2, size_px=15, anchor="lm")
    block = canvas.stack([strip, clock, panels.action_bars(moment.action, 132)], axis=0, gap=4)
    return block if block.shape[0] >= rows else canvas.stack([block, canvas.blank(rows - block.shape[0], 132)], 0, 0)


def _wide_panels(view: View, scene: Scene) -> list[np.ndarray]:
    pictures = []
    if view.image is not None:
        pictures.append(canvas.resize(panels.camera(view.image), WIDE_PX))
    if view.range_view is not None:
        coloured = panels.range_image(view.range_view, far_m=scene.far_m, threshold_m=scene.threshold_m)
        pictures.append(canvas.resize_hard(coloured, WIDE_PX))
    if view.depth_m is not None:
        pictures.append(canvas.resize_hard(panels.depth_image(view.depth_m, far_m=scene.far_m), WIDE_PX))
    for classes in (view.image_classes, view.range_view_classes):
        if classes is not None:
            pictures.append(canvas.resize_hard(panels.class_image(classes), WIDE_PX))
    return pictures


def _space_panels(view: View, scene: Scene) -> list[np.ndarray]:
    pictures = []
    if view.range_view is not None:
        points = view.range_view[view.range_view[..., 3] > scene.threshold_m][:, :3]
        pictures.append(panels.birds_eye(points, extent_m=scene.extent_m, side_px=SQUARE_PX,
                                         height_span_m=panels.height_span(scene.grid)))
    if view.occupancy is not None:
        pictures.append(panels.occupancy_from_above(view.occupancy, scene.grid, columns_px=SQUARE_PX))
        pictures.append(panels.occupancy_from_behind(view.occupancy, scene.grid, size_px=(96, SQUARE_PX)))
    if view.birds_eye_classes is not None:
        pictures.append(panels.ground_plan(view.birds_eye_classes, SQUARE_PX))
    return pictures


def _space_names(view: View) -> list[str]:
    points = ["points"] if view.range_view is not None else []
    voxels = ["voxels above", "voxels ahead"] if view.occupancy is not None else []
    return points + voxels + (["ground plan"] if view.birds_eye_classes is not None else [])


def _row_name(what: str, who: str, rows: int) -> np.ndarray:
    strip = canvas.write(canvas.blank(rows, 96), what, 2, 0, size_px=13)
    return canvas.write(strip, who, 20, 0, size_px=12, colour=canvas.FAINT_INK)


def _view_column(view: View, scene: Scene) -> np.ndarray:
    """All of one moment, WIDE_PX wide: camera, range image, points beside voxels from above, voxels ahead."""
    rows = _wide_panels(view, scene)
    from_above = _space_panels(dataclasses.replace(view, birds_eye_classes=None), scene)[:2]
    if from_above:
        rows.append(canvas.stack(from_above, axis=1, gap=WIDE_PX - 2 * SQUARE_PX))
    if view.occupancy is not None:
        rows.append(panels.occupancy_from_behind(view.occupancy, scene.grid, size_px=(150, WIDE_PX)))
    if view.birds_eye_classes is not None:
        rows.append(panels.ground_plan(view.birds_eye_classes, SQUARE_PX))
    return canvas.stack(rows, axis=0, gap=6)

