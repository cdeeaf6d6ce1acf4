"""Drawing primitives shared by all pictures: colours, text, captions, legends, stacking, PNG and GIF files.

A picture is a uint8 array [rows, columns, 3]. Pillow draws text and writes files; nothing else is needed.
"""

from __future__ import annotations

import colorsys
import functools
import os
import pathlib
import unicodedata
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

BACKGROUND: Colour = (17, 19, 25)
PANEL: Colour = (28, 31, 40)
INK: Colour = (232, 234, 238)
FAINT_INK: Colour = (150, 156, 168)
OBSERVED: Colour = (92, 168, 236)
IMAGINED: Colour = (248, 160, 62)
TAG_COLOURS = {"observed": OBSERVED, "imagined": IMAGINED}

# Anchor colours, evenly spaced; both maps grow monotonically in brightness or hue so that they can be read back.
RANGE_COLOURS = ((255, 247, 188), (254, 196, 79), (241, 105, 60), (180, 40, 110), (88, 24, 116), (34, 16, 70))
HEIGHT_COLOURS = ((48, 62, 120), (44, 123, 182), (38, 168, 146), (136, 202, 88), (250, 216, 74), (240, 120, 60),
                  (205, 42, 62))


def class_colours(classes: int) -> np.ndarray:
    """uint8 [256, 3]: a colour for each class number, unlike its neighbours'; black for 255, unlabelled."""
    hues = [colorsys.hsv_to_rgb(0.618034 * index % 1.0, 0.55 + 0.3 * (index % 2), 0.95 - 0.3 * (index % 3 == 2))
            for index in range(classes)]
    table = np.zeros((256, 3), np.uint8)
    table[:classes] = (255.0 * np.asarray(hues)).round()
    return table


def colour_map(values: np.ndarray, anchors: Sequence[Colour]) -> np.ndarray:
    """Colours for values in [0, 1] (clipped; NaN counts as 0): float [...] -> uint8 [..., 3]."""
    position = np.clip(np.nan_to_num(values), 0.0, 1.0) * (len(anchors) - 1)
    table = np.asarray(anchors, np.float64)
    channels = [np.interp(position, np.arange(len(anchors)), table[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


@functools.lru_cache(maxsize=16)
def font(size_px: int):
    return ImageFont.load_default(size_px)


def plain(text: str) -> str:
    """Text in letters that the font has: without accents, "?" for other scripts (names may have any)."""
    bare = "".join(letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return bare.encode("ascii", "replace").decode()


def text_width_px(text: str, size_px: int = 13) -> int:
    return int(font(size_px).getlength(plain(text))) + 1


def write(picture: np.ndarray, text: str, row: int, column: int, *, size_px: int = 13, colour: Colour = INK,
          anchor: str = "la") -> np.ndarray:
    """Returns the picture with text at (row, column); `anchor` as pillow names it: "la" left top, "mm" centred."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((column, row), plain(text), fill=colour, font=font(size_px), anchor=anchor)
    return np.array(image)


def blank(rows: int, columns: int, colour: Colour = BACKGROUND) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.uint8), (rows, columns, 3)).copy()


def resize(picture: np.ndarray, columns: int) -> np.ndarray:
    """Scales to a width: whole-number enlargement keeps hard pixels, everything else is smoothed."""
    height, width = picture.shape[:2]
    if columns == width:
        return picture
    if columns % width == 0:
        factor = columns // width
        return np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)
    rows = max(1, round(height * columns / width))
    smooth = Image.Resampling.LANCZOS if columns < width else Image.Resampling.BICUBIC
    return np.array(Image.fromarray(picture).resize((columns, rows), smooth))


def resize_hard(picture: np.ndarray, columns: int) -> np.ndarray:
    """Scales to a width without mixing pixels, so that colours stay those of the legend."""
    rows = max(1, round(picture.shape[0] * columns / picture.shape[1]))
    from_row = ((np.arange(rows) + 0.5) * picture.shape[0] / rows).astype(np.int64)
    from_column = ((np.arange(columns) + 0.5) * picture.shape[1] / columns).astype(np.int64)
    return picture[from_row[:, None], from_column[None]]


def frame(picture: np.ndarray, colour: Colour, thickness: int = 2) -> np.ndarray:
    """The picture inside a coloured border."""
    rows, columns = picture.shape[:2]
    framed = blank(rows + 2 * thickness, columns + 2 * thickness, colour)
    framed[thickness:-thickness, thickness:-thickness] = picture
    return framed


def caption(picture: np.ndarray, text: str, *, size_px: int = 13, colour: Colour = INK) -> np.ndarray:
    """The picture below a line of text, widened where the text is longer."""
    header = blank(size_px + 6, max(picture.shape[1], text_width_px(text, size_px) + 4))
    return stack([write(header, text, 1, 1, size_px=size_px, colour=colour), picture], axis=0, gap=0)


def stack(pictures: Sequence[np.ndarray], axis: int, gap: int = 8, colour: Colour = BACKGROUND) -> np.ndarray:
    """Pictures below (axis 0) or beside (axis 1) each other, aligned at the top left."""
    other = 1 - axis
    extent = max(picture.shape[other] for picture in pictures)
    parts = []
    for index, picture in enumerate(pictures):
        if index and gap:
            parts.append(blank(gap, extent, colour) if axis == 0 else blank(extent, gap, colour))
        padded = blank(picture.shape[0] if axis == 0 else extent, extent if axis == 0 else picture.shape[1], colour)
        padded[: picture.shape[0], : picture.shape[1]] = picture
        parts.append(padded)
    return np.concatenate(parts, axis=axis)


def margin(picture: np.ndarray, pixels: int = 12) -> np.ndarray:
    return frame(picture, BACKGROUND, pixels)


def tag(text: str, colour: Colour, columns: int, size_px: int = 15) -> np.ndarray:
    """A filled strip with dark text: the badge that says observed or imagined."""
    strip = blank(size_px + 8, columns, colour)
    return write(strip, text, strip.shape[0] // 2, 6, size_px=size_px, colour=BACKGROUND, anchor="lm")


def colour_bar(anchors: Sequence[Colour], low: str, high: str, title: str, columns: int = 180) -> np.ndarray:
    """A horizontal legend: title, then a gradient between its two labels."""
    ends = text_width_px(low, 12) + text_width_px(high, 12) + 12
    lead = text_width_px(title, 12) + 10
    bar = blank(18, lead + ends + columns)
    start = lead + text_width_px(low, 12) + 6
    bar[3:15, start : start + columns] = colour_map(np.linspace(0.0, 1.0, columns), anchors)[None]
    bar = write(bar, title, 9, 0, size_px=12, colour=FAINT_INK, anchor="lm")
    bar = write(bar, low, 9, start - 5, size_px=12, colour=INK, anchor="rm")
    return write(bar, high, 9, start + columns + 5, size_px=12, colour=INK, anchor="lm")


def swatch(colour: Colour, text: str) -> np.ndarray:
    """A legend entry for one colour."""
    entry = blank(18, text_width_px(text, 12) + 24)
    entry[3:15, :14] = np.array(colour, np.uint8)
    return write(entry, text, 9, 19, size_px=12, colour=INK, anchor="lm")


def save_png(path: str | os.PathLike, picture: np.ndarray) -> pathlib.Path:
    """Writes a PNG, creating its folder; the file appears only when it is complete."""
    path = pathlib.Path(path).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    Image.fromarray(picture).save(partial, format="PNG", optimize=True)
    partial.replace(path)
    return path


def save_gif(path: str | os.PathLike, pictures: Sequence[np.ndarray], frame_s: float) -> pathlib.Path:
    """Writes an endless animation with one shared palette, so that still parts do not flicker.

    Args:
      pictures: uint8 [rows, columns, 3] each, all of one size.
      frame_s: how long each frame stays.

    Raises:
      ValueError: where there is nothing to write.
    """
    if not pictures:
        raise ValueError(f"{path}: got no frames, expected at least one.")
    path = pathlib.Path(path).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    samples = np.concatenate([picture[::2, ::2] for picture in pictures[:: max(1, len(pictures) // 6)]], axis=0)
    palette = Image.fromarray(samples).quantize(255, method=Image.Quantize.MEDIANCUT)
    frames = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    partial = path.with_name(path.name + ".part")
    frames[0].save(partial, format="GIF", save_all=True, append_images=frames[1:], loop=0, optimize=False,
                   duration=max(20, round(1000 * frame_s)))
    partial.replace(path)
    return path
