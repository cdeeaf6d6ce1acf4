"""Makes a trained run the model that ships as builtin:NAME: python experiments/builtin/seal.py RUN NAME

Its scores are those of RUN/evaluation.json, of full weights; `python -m muvo_jax.evaluate builtin:NAME` gives those of
what ships. RUN is trained by the command in docs/models.md. What ships is judged once more on SAMPLE_WINDOWS windows,
which a test recomputes (tests/training/test_builtin.py).
"""

import dataclasses
import json
import pathlib
import sys

import muvo_jax
from muvo_jax import config as config_lib
from muvo_jax.training import builtin, validation

SCORES = ("psnr_db", "chamfer_m", "chamfer_above_m", "iou_occ_above_observed", "iou_occ_movers", "iou_occ_observed",
          "iou_occ_all")
SAMPLE_WINDOWS = 8  # one of each drive


def _rounded(node):
    if isinstance(node, dict):
        return {name: _rounded(value) for name, value in node.items()}
    return [_rounded(value) for value in node] if isinstance(node, list) else node and round(node, 4)


def add_sample(name: str) -> None:
    """Writes into the card of builtin:NAME what it scores on a few windows (validation.sample_scores)."""
    scores = validation.sample_scores(muvo_jax.load(builtin.PREFIX + name), SAMPLE_WINDOWS)
    path = builtin.FOLDER / name / builtin.CARD
    card = json.loads(path.read_text(encoding="utf-8"))
    card["sample"] = {"windows": SAMPLE_WINDOWS, "imagined": _rounded(scores)}
    path.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def main(run: str, name: str) -> None:
    loaded = muvo_jax.load(run)
    # The held-out drives of both sizes are the same, and who looks at them need not record four times the others.
    loaded = dataclasses.replace(loaded, config=config_lib.override(loaded.config, "data.town_size", "default"))
    report = json.loads((loaded.folder / "evaluation.json").read_text(encoding="utf-8"))
    pick = lambda score: {name: value for name, value in score.items() if name in ("mean", "interval", "per_step")}
    scores = {split: {source: {name: pick(values[name]) for name in SCORES if name in values}
                      for source, values in entry["imagined"].items()}
              for split, entry in report["splits"].items() if split != "train"}
    card = {"protocol": report["protocol"],
            "card": {split: entry["card"] for split, entry in report["splits"].items() if split != "train"},
            "data": report["data"], "imagined": _rounded(scores)}
    folder = builtin.seal(loaded, builtin.FOLDER / name, card)
    add_sample(name)
    size = sum(path.stat().st_size for path in pathlib.Path(folder).iterdir())
    print(f"wrote {folder}, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
