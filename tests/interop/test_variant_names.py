"""Every parameter of every variant of the reference has one counterpart of the same shape; both tell the variant."""

import pathlib
import re

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.interop import checkpoints, names
from muvo_jax.interop.parity import golden

LIDAR_ONLY = ("range_view", "action")
BEV, PP = {"camera": config_lib.BirdsEyeCamera()}, {"lidar": config_lib.PillarLidar()}
FC, TOKENS = {"fusion": config_lib.ConcatenationFusion()}, {"latent": config_lib.TokenLatent()}
VARIANTS = {
    "1d_RV_WOB_TR_voxel": {"heads": config_lib.HEADS},
    "1d_RV_WOB_TR_novoxel": {"heads": ("image", "range_view", "action")},
    "RV_BEV_TR": BEV,
    "PP_WOB_TR": PP,
    "PP_BEV_TR": {**PP, **BEV},
    "RV_WOB_FC": FC,
    "PP_WOB_FC": {**FC, **PP},
    "RV_BEV_FC": {**FC, **BEV},
    "PP_BEV_FC": {**FC, **PP, **BEV},
    "RV_WOB_TR_LARGE": {"fusion": config_lib.TransformerFusion(many_tokens=True)},
    "RV_WOB_TR_measurements": {"navigation": True},
    "RV_BEV_FC_measurements": {**FC, **BEV, "navigation": True},
    "2d_RV_WOB_TR_voxel": {**TOKENS, "heads": config_lib.HEADS},
    "2d_RV_BEV_TR": {**TOKENS, **BEV},
    "2d_PP_WOB_TR": {**TOKENS, **PP},
    "2d_measurements": {**TOKENS, "navigation": True},
    "2d_bevseg": {**TOKENS, "heads": ("range_view", "action", "birds_eye")},
    "2d_mobilevit": {**TOKENS, "backbone": "mobilevitv2_100", "heads": config_lib.HEADS},
}


def reference_config(name):
    return config_lib.ModelConfig(numerics="reference", **{"heads": LIDAR_ONLY, **VARIANTS[name]})


@pytest.mark.parametrize("name", VARIANTS)
def test_parameters_match_one_to_one(name):
    unused = "num_batches_tracked|encoder_layer|transformer_decoder_layer|bev_intrinsics"
    theirs = {key: shape for key, shape in golden.manifest(name).items() if not re.search(unused, key)}
    assert names.reference_shapes(reference_config(name)) == theirs


def stored(name, **filled):
    """A checkpoint of the variant's keys and shapes, zeros but for what is given."""
    zeros = {key: np.broadcast_to(np.float32(0), shape) for key, shape in golden.manifest(name).items()}
    return checkpoints.Stored(pathlib.Path(name), zeros | filled, {}, {})


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_are_recognised_by_their_keys_and_shapes(name):
    model = checkpoints.recognise(stored(name))
    assert model == reference_config(name)
    released = {"1d_RV_WOB_TR_voxel", "1d_RV_WOB_TR_novoxel", "2d_RV_WOB_TR_voxel", "2d_mobilevit"}
    assert (checkpoints.published_name(model) is not None) == (name in released)


def test_the_grid_of_a_birds_eye_camera_comes_from_the_checkpoint():
    matrix = np.array([[2.0, 0, 16], [0, -2.0, 32], [0, 0, 1]], np.float32)
    grid = checkpoints.recognise(stored("RV_BEV_FC", **{"frustum_pooling.bev_intrinsics": matrix})).camera.grid
    assert (grid.cells, grid.cell_m, grid.cells_behind) == (64, 0.5, 16)
