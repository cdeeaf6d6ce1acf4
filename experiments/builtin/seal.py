"""Makes a trained run the model that ships as builtin:NAME: python experiments/builtin/seal.py RUN NAME

Its scores are those of RUN/evaluation.json, of full weights; `python -m muvo_jax.evaluate builtin:NAME` gives those of
what ships. RUN is trained by the command in docs/models.md.
"""

import json
import pathlib
import sys

import muvo_jax
from muvo_jax.training import builtin

SCORES = ("psnr_db", "chamfer_m", "chamfer_above_m", "iou_occ_above_observed", "iou_occ_movers", "iou_occ_observed",
          "iou_occ_all")


def _rounded(node):
    if isinstance(node, dict):
        return {name: _rounded(value) for name, value in node.items()}
    return [_rounded(value) for value in node] if isinstance(node, list) else node and round(node, 4)


def main(run: str, name: str) -> None:
    loaded = muvo_jax.load(run)
    report = json.loads((loaded.folder / "evaluation.json").read_text(encoding="utf-8"))
    pick = lambda score: {name: value for name, value in score.items() if name in ("mean", "interval", "per_step")}
    scores = {split: {source: {name: pick(values[name]) for name in SCORES if name in values}
                      for source, values in entry["imagined"].items()}
              for split, entry in report["splits"].items() if split != "train"}
    card = {"protocol": report["protocol"],
            "card": {split: entry["card"] for split, entry in report["splits"].items() if split != "train"},
            "data": report["data"], "imagined": _rounded(scores)}
    folder = builtin.seal(loaded, builtin.FOLDER / name, card)
    size = sum(path.stat().st_size for path in pathlib.Path(folder).iterdir())
    print(f"wrote {folder}, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
