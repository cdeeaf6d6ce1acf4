"""Loss and metric curves as one PNG, drawn with pillow alone."""

from __future__ import annotations

import math
import os
import pathlib
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

from muvo_jax.viz import canvas

LINE_COLOURS = ((92, 168, 236), (248, 160, 62), (120, 200, 120), (228, 96, 120), (180, 140, 240), (220, 210, 90),
                (70, 210, 210), (240, 140, 200), (150, 150, 90), (170, 110, 70), (120, 120, 255), (200, 200, 210),
                (0, 160, 130), (255, 90, 40), (140, 40, 160), (90, 110, 60))
_BAND_OPACITY = 60  # of 255
_LEGEND_ROW_PX = 14
Series = tuple[Sequence[float], Sequence[float]]  # steps, values


def curve(series: Mapping[str, Series], title: str, *, size_px: tuple[int, int] = (220, 360),
          logarithmic: bool = False, unit: str = "",
          bands: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None) -> np.ndarray:
    """One plot with axes, ticks and a legend; values that are not finite leave a gap.

    Args:
      series: name -> (steps, values).
      logarithmic: logarithmic value axis; used only where all values are positive.
      bands: name of a series -> (low, high) at its steps, drawn behind it.
    """
    rows, columns = size_px
    bottom, left, right = 26, 52, 10
    entries = _legend(series, left, columns - right)
    top = 44 + _LEGEND_ROW_PX * max((row for row, _ in entries.values()), default=0)
    finite = [value for _, values in series.values() for value in values if math.isfinite(value)]
    finite += [value for band in (bands or {}).values() for values in band for value in values if math.isfinite(value)]
    steps = [step for xs, _ in series.values() for step in xs]
    picture = canvas.blank(rows, columns)
    picture[top : rows - bottom, left : columns - right] = np.array(canvas.PANEL, np.uint8)
    picture = canvas.write(picture, f"{title} [{unit}]" if unit else title, 4, 6, size_px=14)
    if not finite:
        return canvas.write(picture, "no finite value", rows // 2, columns // 2, colour=canvas.FAINT_INK, anchor="mm")
    logarithmic = logarithmic and min(finite) > 0.0
    scale = math.log10 if logarithmic else float
    low, high = scale(min(finite)), scale(max(finite))
    pad = 0.06 * (high - low) or max(abs(high) * 0.1, 0.1)
    low, high = low - pad, high + pad
    first, last = min(steps), max(max(steps), min(steps) + 1)

    def to_column(step):
        return left + (step - first) / (last - first) * (columns - right - left - 1)

    def to_row(value):
        return rows - bottom - 1 - (scale(value) - low) / (high - low) * (rows - bottom - top - 1)

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    for tick in _ticks(low, high):
        row = rows - bottom - 1 - (tick - low) / (high - low) * (rows - bottom - top - 1)
        draw.line([(left, row), (columns - right, row)], fill=(46, 50, 62))
        label = f"{10**tick:.3g}" if logarithmic else f"{tick:.4g}"
        draw.text((left - 5, row), label, fill=canvas.FAINT_INK, font=canvas.font(11), anchor="rm")
    for tick in _ticks(first, last):
        draw.text((to_column(tick), rows - bottom + 5), f"{tick:g}", fill=canvas.FAINT_INK, font=canvas.font(11),
                  anchor="ma")
    colours = {name: LINE_COLOURS[index % len(LINE_COLOURS)] for index, name in enumerate(series)}
    for name, (lows, highs) in (bands or {}).items():
        edges = [*zip(series[name][0], lows, strict=True), *reversed([*zip(series[name][0], highs, strict=True)])]
        if all(math.isfinite(value) for _, value in edges) and len(edges) > 3:
            draw.polygon([(to_column(step), to_row(value)) for step, value in edges],
                         fill=(*colours[name], _BAND_OPACITY))
    for name, (xs, values) in series.items():
        colour = colours[name]
        for run in _finite_runs(xs, values):
            line = [(to_column(step), to_row(value)) for step, value in run]
            if len(line) > 1:
                draw.line(line, fill=colour, width=2)
            else:
                draw.ellipse([line[0][0] - 2, line[0][1] - 2, line[0][0] + 2, line[0][1] + 2], fill=colour)
    picture = np.array(image)
    for name, (row, column) in entries.items():
        picture[32 + row * _LEGEND_ROW_PX : 35 + row * _LEGEND_ROW_PX, column : column + 14] = np.array(colours[name],
                                                                                                   np.uint8)
        picture = canvas.write(picture, name, 33 + row * _LEGEND_ROW_PX, column + 18, size_px=12,
                               colour=canvas.FAINT_INK, anchor="lm")
    return picture


def _legend(names: Iterable[str], left: int, right: int) -> dict[str, tuple[int, int]]:
    """Name -> (row of the legend, column in pixels)."""
    entries, row, column = {}, 0, left
    for name in names:
        width = 30 + canvas.text_width_px(name, 12)
        if column + width > right and column > left:
            row, column = row + 1, left
        entries[name] = (row, column)
        column += width
    return entries


def write_curves(path: str | os.PathLike, plots: Sequence[np.ndarray], title: str, per_row: int = 3) -> pathlib.Path:
    """A page of plots made by `curve`.

    Raises:
      ValueError: where there is no plot.
    """
    if not plots:
        raise ValueError(f"{path}: got no plots, expected at least one.")
    rows = [canvas.stack(plots[start : start + per_row], axis=1, gap=12) for start in range(0, len(plots), per_row)]
    page = canvas.stack(rows, axis=0, gap=14)
    return canvas.save_png(path, canvas.margin(canvas.caption(page, title, size_px=17)))


def _ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers inside [low, high]."""
    raw = (high - low) / most
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * magnitude for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * magnitude >= raw)
    start = math.ceil(low / step - 1e-9)
    return [index * step for index in range(start, math.floor(high / step + 1e-9) + 1)]


def _finite_runs(xs: Sequence[float], values: Sequence[float]) -> list[list[tuple[float, float]]]:
    runs: list[list[tuple[float, float]]] = [[]]
    for step, value in zip(xs, values, strict=True):
        if math.isfinite(value):
            runs[-1].append((step, value))
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]
