"""Every combination of lidar, camera, fusion and latent goes through the whole job: train, evaluate and dream."""

import itertools
import json

import pytest

from muvo_jax import command_line, presets, train
from muvo_jax import config as config_lib
from muvo_jax.training import screen

VARIANTS = ["-".join(parts).upper() for parts in itertools.product(
    config_lib.LIDAR_ENCODERS, config_lib.CAMERA_ENCODERS, config_lib.FUSIONS)]
CASES = [(variant, latent) for variant in VARIANTS for latent in config_lib.LATENTS
         if latent == "1d" or variant.endswith("TR")]
SMALL = ("train.steps=1", "train.validation_windows=1", "evaluation.windows=1", "evaluation.batch=1", "data.frames=2",
         "evaluation.chamfer_points=64")


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A cache folder with the recorded town, which all variants share."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setattr(command_line, "use_compilation_cache", lambda: None)
        command_line.open_data(presets.tiny(), screen.Screen())
        yield cache


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "latent"), CASES)
def test_variant_trains_evaluates_and_dreams(variant, latent, town, tmp_path):
    del town
    train.train(train.Options(preset="tiny", variant=variant, latent=latent, runs_dir=tmp_path, set=SMALL),
                screen.Screen())
    (run,) = tmp_path.iterdir()
    report = json.loads((run / "evaluation.json").read_text())
    assert report["variant"] == variant
    assert report["splits"]["val_rl"]["imagined"]["model"]["psnr_db"]["mean"] > 0
    assert list(run.glob("dreams/*.gif"))
