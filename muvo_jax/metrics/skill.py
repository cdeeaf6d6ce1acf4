"""One number for how good imagined frames are, by which a run's best checkpoint is chosen.

A skill is 1 - error / error of a reference: 1 is perfect, 0 as good as the reference, below 0 worse. The reference is
the last observed frame as the motion of the car moves it, or as it is where that motion is unknown. The score is the
mean skill of what is imagined: squared error of the image (by its mean PSNR), Chamfer distance of the returns, and
1 - IoU+ above the road.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from muvo_jax import head as head_lib

_NOTHING = -1.0  # of a head that predicts nothing to be measured, such as no return at all: as bad as twice the error
REFERENCES = ("warp_last", "copy_last")  # the first that was judged
STATED = ("mean over the validation splits of 1 - error / error of the moved last frame, over image, points and voxels "
          "above the road, of imagined frames")


def skill(imagined: Mapping[str, Mapping[str, Any]]) -> float:
    """The score of one split, NaN where nothing can be compared.

    Args:
      imagined: source -> metric -> {"mean"}, as protocol.evaluate reports it.
    """
    reference = next((name for name in REFERENCES if name in imagined), None)
    if reference is None:
        return math.nan
    found = []
    for name, metric in head_lib.metrics().items():
        if metric.error is None:
            continue
        pair = [imagined[source].get(name, {}).get("mean", math.nan) for source in ("model", reference)]
        ours, theirs = map(metric.error, pair)
        if not (math.isfinite(theirs) and theirs > 0.0 and name in imagined["model"]):
            continue
        found.append(1.0 - ours / theirs if math.isfinite(ours) else _NOTHING)
    return sum(found) / len(found) if found else math.nan
