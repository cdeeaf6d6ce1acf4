"""A dream as one web page that opens by double click: sliders over time and sampled futures, pictures inside the file.

page.html beside this file is the page without its pictures. Nothing is fetched from anywhere.
"""

from __future__ import annotations

import base64
import io
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from muvo_jax.viz import sheets

_TEMPLATE = pathlib.Path(__file__).with_name("page.html")
_PLACE = "/*PAGE*/null"
_COLUMNS_PX = {"sensor": sheets.WIDE_PX, "above": sheets.SQUARE_PX, "ahead": sheets.WIDE_PX}


def write_page(path: str | os.PathLike, truth: Sequence[sheets.View], futures: Mapping[str, Sequence[sheets.View]],
               actions: np.ndarray, scene: sheets.Scene, *, context: int, title: str,
               beside: Mapping[str, Sequence[sheets.View]] | None = None) -> pathlib.Path:
    """Writes the page of one window: a column for the truth, one for the model's futures, one for each baseline.

    Args:
      path: of the page, such as RUN/dreams/NAME.html.
      truth: the recorded frames.
      futures: title -> decoded frames, as many as truth; more than one get a slider.
      actions: float [frames, 2]; action t is applied from t to t + 1.
      context: how many frames at the start were observed.
      title: of the page.
      beside: the same of baselines.
    """
    beside = beside or {}
    shown = sheets.pictures(truth[0])
    column = lambda branches: [[[_drawn(name, picture, views[frame], truth[frame], scene) for name, picture in shown]
                                for frame in range(len(truth))] for views in branches]
    page = {
        "title": title, "context": context, "futures": list(futures), "pace_ms": round(1000 * max(scene.frame_s, 0.3)),
        "columns": ["truth", "world model", *beside],
        "pictures": [{"name": picture.name, "view": picture.view} for _, picture in shown],
        "frames": [{"time_s": round((frame - context + 1) * scene.frame_s, 3),
                    "action": [round(float(value), 3) for value in actions[frame]]} for frame in range(len(truth))],
        "drawn": [column(one) for one in ([truth], futures.values(), *([views] for views in beside.values()))],
        "legend": _inline(sheets.legend(truth[0], scene, 3 * sheets.WIDE_PX))}
    text = json.dumps(page, separators=(",", ":")).replace("<", "\\u003c")  # a title may not end the script
    path = pathlib.Path(path).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, text), encoding="utf-8")
    return path


def _drawn(name: str, picture: Any, view: sheets.View, truth: sheets.View, scene: sheets.Scene) -> str | None:
    """The picture as an address that holds it; None where the view does not say it."""
    return _inline(picture.draw(view[name], scene, _COLUMNS_PX[picture.view])) if name in view else None


def _inline(picture: np.ndarray) -> str:
    """WebP: of these pictures half as large as PNG and sharper than JPEG, which mixes neighbouring colours."""
    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, format="WEBP", quality=80, method=4)
    return "data:image/webp;base64," + base64.b64encode(packed.getvalue()).decode("ascii")
