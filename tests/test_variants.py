"""Every pair of lidar, camera, fusion and latent goes through the whole job together: train, evaluate and dream.

Of the 16 combinations these are the fewest that have all pairs; RV-WOB-TR-1d is that of test_cli's whole job. All 16
are built in test_presets and compared with the authors' numbers in model/test_reference_parity. Nearly all of the time
is compilation: XLA leaves most optimisations out here, convolutions are the plain ones, and the variants whose
occupancy decoder others have too go without it.
"""

import itertools
import json

import pytest

from muvo_jax import command_line, presets, train
from muvo_jax import config as config_lib
from muvo_jax.training import screen

CASES = [("PP-BEV-TR", "1d"), ("RV-BEV-FC", "1d"), ("PP-WOB-FC", "1d"), ("RV-WOB-AVG", "1d"), ("PP-BEV-AVG", "1d"),
         ("RV-BEV-TR", "2d"), ("PP-WOB-TR", "2d")]
SMALL = ("train.steps=1", "train.batch=1", "train.validation_windows=1", "data.frames=2", "model.convolution=xla",
         "evaluation.windows=1", "evaluation.batch=1", "evaluation.chamfer_points=64")


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A cache folder with the recorded town, which all variants share."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setattr(command_line, "prepare_compiler", lambda: None)
        command_line.open_data(presets.tiny(), screen.Screen())
        yield cache


def test_the_cases_have_every_pair():
    parts = [(*variant.lower().split("-"), latent) for variant, latent in [*CASES, ("RV-WOB-TR", "1d")]]
    axes = (config_lib.LIDARS, config_lib.CAMERAS, config_lib.FUSIONS, config_lib.LATENTS)
    for first, second in itertools.combinations(range(len(axes)), 2):
        # Only transformer fusion leaves tokens for the 2D latent.
        wanted = {(a, b) for a in axes[first] for b in axes[second] if not (b == "2d" and a in ("fc", "avg"))}
        assert wanted == {(part[first], part[second]) for part in parts}


@pytest.mark.slow
@pytest.mark.usefixtures("fast_compilation")
@pytest.mark.parametrize(("variant", "latent"), CASES)
def test_variant_trains_evaluates_and_dreams(variant, latent, town, tmp_path):
    del town
    occupancy = variant.startswith("RV-WOB") or latent == "2d"
    train.train(train.Options(preset="tiny", variant=variant, latent=latent, no_occupancy=not occupancy,
                              runs_dir=tmp_path, set=SMALL), screen.Screen())
    (run,) = tmp_path.iterdir()
    report = json.loads((run / "evaluation.json").read_text())
    assert report["variant"] == variant
    scores = report["splits"]["val_rl"]["imagined"]["model"]
    assert scores["psnr_db"]["mean"] > 0
    assert ("iou_occ_observed" in scores) == occupancy
    assert list(run.glob("dreams/*.gif"))
