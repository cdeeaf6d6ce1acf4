"""A model that lacks camera or lidar fuses what is left; shapes alone are computed, nothing compiles."""


import jax
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.model import world_model
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import preparation, state
from muvo_jax.training import step as step_lib

HEADS = {"camera": ("range_view", "occupancy", "action"), "lidar": ("image", "action")}


def tiny(lacks, **model):
    config = presets.tiny()
    changes = {lacks: config_lib.NO_SENSOR, "heads": HEADS[lacks], **model}
    return config_lib.override_all(config, {f"model.{name}": value for name, value in changes.items()})


@pytest.mark.parametrize("lacks", ["camera", "lidar"])
def test_a_training_step_works_on_what_is_left(lacks):
    config = tiny(lacks)
    batch = preparation.expected_batch(config, 2)
    assert (batch.image is None, batch.range_view is None) == (lacks == "camera", lacks == "lidar")
    model = world_model.WorldModel(config.model)
    variables = model.variable_shapes()
    assert lacks not in variables["params"] and {"camera", "lidar"} & variables["params"].keys()
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    fresh = jax.eval_shape(lambda variables, key: state.create(variables, optimizer, key), variables,
                           jax.eval_shape(jax.random.key, 0))
    stacked = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), batch)
    body = step_lib.gradient_body(model, config)
    gradients, _, metrics = jax.eval_shape(lambda state, batch: body(state, batch, None), fresh, stacked)
    assert jax.tree.structure(gradients) == jax.tree.structure(variables["params"])
    assert ("psnr_db" in metrics) == (lacks == "lidar")


@pytest.mark.parametrize(("fusion", "latent", "lacks"), [("tr", "2d", "lidar"), ("fc", "1d", "camera"),
                                                         ("avg", "1d", "lidar")])
def test_every_fusion_embeds_one_sensor(fusion, latent, lacks):
    config = tiny(lacks, fusion=fusion, latent=latent)
    model = world_model.WorldModel(config.model)
    batch = preparation.expected_batch(config, 2)
    embedding, _ = jax.eval_shape(model.encode, model.variable_shapes(), batch)
    channels = config.model.fusion.token_channels if latent == "2d" else config.model.latent.embedding_channels
    assert embedding.shape[:2] == (2, config.data.frames) and embedding.shape[-1] == channels


def test_a_model_needs_a_sensor_and_its_batch():
    with pytest.raises(ValueError, match="both none"):
        tiny("camera", lidar="none")
    model = world_model.WorldModel(tiny("camera").model)
    image_alone = types.Batch(action=np.zeros((1, 2, 2), np.float32), is_first=np.zeros((1, 2), bool),
                              image=np.zeros((1, 2, *model.config.image_size, 3), np.uint8))
    with pytest.raises(ValueError, match=r"Batch\.range_view is None"):
        model.init(jax.random.key(0), image_alone)
    assert config_lib.NO_SENSOR not in config_lib.CAMERAS
