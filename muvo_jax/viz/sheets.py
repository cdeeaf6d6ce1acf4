"""Truth beside imagination: whole pages (PNG) and animations (GIF) made of the panels of panels.py.

Every frame carries the badge "observed" (the model saw the sensors) or "imagined" (it saw actions alone).
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.viz import canvas, panels

WIDE_PX = 384  # width of camera and range image
SQUARE_PX = 188  # side of the pictures from above: two of them and a gap are as wide as one camera
VIEWS = ("sensor", "above", "ahead")  # of a head.Picture
LEGEND = ("range", "height", "unknown")  # what a head.Picture may ask the page to explain

# One moment: head -> what it shows, as its field of types.Batch holds it; what is missing is not there.
View = dict[str, np.ndarray]


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
    """What all frames of a picture share: the sensors' geometry, the pace, the ranges of the colour scales, and from
    where to where the car reaches."""

    grid: config_lib.VoxelGrid
    frame_s: float
    far_m: float = 60.0
    threshold_m: float = 1.0
    ego_m: tuple[float, float] = panels.OVER_REAR_AXLE_M

    @property
    def extent_m(self) -> float:
        """Half the side of the bird's-eye view: that of the voxel grid, so that both show the same ground."""
        return self.grid.shape[0] * self.grid.voxel_size_m / 2.0

    @classmethod
    def of(cls, config: config_lib.Config) -> Scene:
        return cls(grid=config.model.voxels, frame_s=config.data.stride / config.contract.rate_hz,
                   threshold_m=config.evaluation.return_threshold_m,
                   ego_m=panels.ego_of(config.contract))


def views_of_batch(batch: types.Batch, sample: int) -> list[View]:
    """The recorded frames of one window."""
    fields = {name: value for name, frames in head_lib.shown().items()
              if frames.pictures and (value := getattr(batch, frames.field)) is not None}
    return [{name: np.asarray(value[sample, frame]) for name, value in fields.items()} for frame in range(batch.frames)]


def views_of_frames(frames: Mapping[str, np.ndarray], sample: int | tuple[int, ...]) -> list[View]:
    """The decoded frames of one window: {head: [B, T, ...]}, flags as 0 and 1; `sample` may index more axes.

    Raises:
      ValueError: where no head decodes any.
    """
    if not frames:
        raise ValueError(f"there is nothing to draw: none of the model's heads is one of "
                         f"{', '.join(head_lib.shown())}. Train with one of these (--with-heads=image).")
    chosen = {name: np.asarray(value[sample]) for name, value in frames.items()}
    chosen = {name: value.astype(np.uint8) if value.dtype == np.bool_ else value for name, value in chosen.items()}
    count = next(iter(chosen.values())).shape[0]
    return [{name: value[frame] for name, value in chosen.items()} for frame in range(count)]


def pictures(view: View, views: Sequence[str] = VIEWS) -> list[tuple[str, head_lib.Picture]]:
    """(head, picture) of these views that a moment has, in the order of heads."""
    return [(name, picture) for name, frames in head_lib.shown(tuple(view)).items() for picture in frames.pictures
            if picture.view in views]


def dream_frame(columns: Sequence[tuple[str, View]], scene: Scene, *, badge: str, caption: str,
                action: np.ndarray) -> np.ndarray:
    """One animation frame: a column for the truth, first, and one for each prediction, the applied action below."""
    accent = canvas.TAG_COLOURS[badge]
    truth = columns[0][1]
    bodies = [canvas.caption(_view_column(view, truth, scene), title, size_px=14) for title, view in columns]
    body = canvas.stack(bodies, axis=1, gap=18)
    strip = canvas.tag(f"{badge}   {caption}", accent, body.shape[1])
    parts = [strip, body, panels.action_bars(action, min(body.shape[1], 2 * WIDE_PX)),
             legend(truth, scene, body.shape[1])]
    return canvas.margin(canvas.frame(canvas.margin(canvas.stack(parts, axis=0), 8), accent, 2), 6)


def sensor_sheet(moments: Sequence[Moment], scene: Scene, *, title: str) -> np.ndarray | None:
    """What the sensors see, one moment a row: truth left, dreams right. None where nothing is seen so."""
    rows = []
    for moment in moments:
        groups = [canvas.stack(group, axis=1) for group in _side_by_side(moment, scene, ("sensor",), WIDE_PX).values()]
        if not groups:
            return None
        content = canvas.stack(groups, axis=0, gap=4)
        rows.append(canvas.stack([_moment(moment, content.shape[0]), content], axis=1))
    heads = [canvas.blank(20, 132), *(_heading(name, WIDE_PX) for name in ("truth", *moments[0].dreams))]
    page = [_heading(title, rows[0].shape[1], 17), canvas.stack(heads, axis=1), *rows,
            legend(moments[0].truth, scene, rows[0].shape[1], views=("sensor",))]
    return canvas.margin(canvas.stack(page, axis=0, gap=10))


def space_sheet(moments: Sequence[Moment], scene: Scene, *, title: str) -> np.ndarray | None:
    """What lies around the car, one moment a column: truth above, dreams below. None where nothing shows it."""
    columns, names = [], [canvas.blank(20, 96)]
    for moment in moments:
        groups = _side_by_side(moment, scene, ("above", "ahead"), SQUARE_PX)
        if not groups:
            return None
        strip = canvas.tag(f"{moment.badge} {moment.time_s:+.1f} s", canvas.TAG_COLOURS[moment.badge], SQUARE_PX, 12)
        columns.append(canvas.stack([strip, *(part for group in groups.values() for part in group)], axis=0, gap=5))
        if moment is moments[0]:
            names += [_row_name(what, who, picture.shape[0]) for what, group in groups.items()
                      for who, picture in zip(("truth", *moment.dreams), group, strict=True)]
    body = canvas.stack([canvas.stack(names, axis=0, gap=5), *columns], axis=1, gap=8)
    page = [_heading(title, body.shape[1], 17), body,
            legend(moments[0].truth, scene, body.shape[1], views=("above", "ahead"))]
    return canvas.margin(canvas.stack(page, axis=0, gap=10))


def legend(view: View, scene: Scene, columns: int, *, views: Sequence[str] = VIEWS) -> np.ndarray:
    """Colour bars with units for what pictures of these views show, wrapped to the width of the page."""
    asked = {entry for _, picture in pictures(view, views) for entry in picture.legend}
    low_m, high_m = panels.height_span(scene.grid)
    bar = lambda colours, low, high, name: canvas.colour_bar(colours, low, high, name, 120)
    known = {"range": [bar(canvas.RANGE_COLOURS, "0 m", f"{scene.far_m:.0f} m", "range (square root)"),
                       canvas.swatch(panels.NO_RETURN, "no return")],
             "height": [bar(canvas.HEIGHT_COLOURS, f"{low_m:.1f} m", f"{high_m:.1f} m", "height")],
             "unknown": [canvas.swatch(panels.UNKNOWN, "unknown (truth)")]}
    entries = [entry for name in LEGEND if name in asked for entry in known[name]]
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
    beside = beside or {}
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
    # From the last one on: of a single moment that is the one.
    chosen = np.unique(np.linspace(len(truth) - 1, 0, min(most_moments, len(truth))).round().astype(int))
    picked = [moments[frame] for frame in chosen]
    for suffix, page in (("sensors", sensor_sheet(picked, scene, title=title)),
                         ("space", space_sheet(picked, scene, title=title))):
        if page is not None:
            written.append(canvas.save_png(folder / f"{name}_{suffix}.png", page))
    return written


def _side_by_side(moment: Moment, scene: Scene, views: Sequence[str], columns_px: int) -> dict[str, list[np.ndarray]]:
    """Name of each picture of the truth -> those of truth and dreams, blank where a dream does not say it."""
    groups: dict[str, list[np.ndarray]] = {}
    for name, picture in pictures(moment.truth, views):
        groups[picture.name] = [_drawn(name, picture, view, moment.truth, scene, columns_px)
                                for view in (moment.truth, *moment.dreams.values())]
    return groups


def _drawn(name: str, picture: head_lib.Picture, view: View, truth: View, scene: Scene, columns_px: int) -> np.ndarray:
    """A picture of the truth as another view has it, blank where that does not say it."""
    if name in view:
        return picture.draw(view[name], scene, columns_px)
    return canvas.blank(*picture.draw(truth[name], scene, columns_px).shape[:2])


def _heading(text: str, columns: int, size_px: int = 14) -> np.ndarray:
    strip = canvas.blank(size_px + 6, max(columns, canvas.text_width_px(text, size_px)))
    return canvas.write(strip, text, 1, 0, size_px=size_px)


def _moment(moment: Moment, rows: int) -> np.ndarray:
    """The left margin of a row: badge, time and action."""
    strip = canvas.tag(moment.badge, canvas.TAG_COLOURS[moment.badge], 132)
    clock = canvas.write(canvas.blank(22, 132), f"{moment.time_s:+.1f} s", 11, 2, size_px=15, anchor="lm")
    block = canvas.stack([strip, clock, panels.action_bars(moment.action, 132)], axis=0, gap=4)
    return block if block.shape[0] >= rows else canvas.stack([block, canvas.blank(rows - block.shape[0], 132)], 0, 0)


def _row_name(what: str, who: str, rows: int) -> np.ndarray:
    strip = canvas.write(canvas.blank(rows, 96), what, 2, 0, size_px=13)
    return canvas.write(strip, who, 20, 0, size_px=12, colour=canvas.FAINT_INK)


def _view_column(view: View, truth: View, scene: Scene) -> np.ndarray:
    """All of one moment, WIDE_PX wide: as the sensors see it, from above two side by side, then ahead."""
    draw = lambda kind, columns_px: [_drawn(name, picture, view, truth, scene, columns_px) for name, picture in
                                     pictures(truth, (kind,))]
    above = draw("above", SQUARE_PX)
    pairs = [canvas.stack(above[start:start + 2], axis=1, gap=WIDE_PX - 2 * SQUARE_PX)
             for start in range(0, len(above), 2)]
    return canvas.stack([*draw("sensor", WIDE_PX), *pairs, *draw("ahead", WIDE_PX)], axis=0, gap=6)
