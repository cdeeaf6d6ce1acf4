"""Every combination of lidar, camera, fusion and latent goes through the whole job: train, evaluate and dream.

Nearly all of the time is compilation: XLA leaves most optimisations out here, convolutions are the plain ones, and the
variants whose occupancy decoder others have too go without it. `pytest -m slow tests/test_variants.py -n 2` keeps two
cores busy.
"""

import itertools
import json

import jax
import pytest

from muvo_jax import command_line, presets, train
from muvo_jax import config as config_lib
from muvo_jax.training import screen

VARIANTS = ["-".join(parts).upper() for parts in itertools.product(
    config_lib.LIDAR_ENCODERS, config_lib.CAMERA_ENCODERS, config_lib.FUSIONS)]
CASES = [(variant, latent) for variant in VARIANTS for latent in config_lib.LATENTS
         if latent == "1d" or variant.endswith("TR")]
SMALL = ("train.steps=1", "train.batch=1", "train.validation_windows=1", "data.frames=2", "model.convolution=xla",
         "evaluation.windows=1", "evaluation.batch=1", "evaluation.chamfer_points=64")


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A cache folder with the recorded town, which all variants share."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setattr(command_line, "use_compilation_cache", lambda: None)
        command_line.open_data(presets.tiny(), screen.Screen())
        yield cache


@pytest.fixture(scope="module", autouse=True)
def fast_compilation():
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.mark.slow
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
