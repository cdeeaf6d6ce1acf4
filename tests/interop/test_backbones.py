"""Image networks from files as torchvision and timm name them; the files are written here."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch_writer

from muvo_jax import presets, safetensors_file, train
from muvo_jax.interop import backbones, weights_rule
from muvo_jax.interop.parity import golden
from muvo_jax.model import world_model
from muvo_jax.training import optimizer, preparation, state
from muvo_jax.training import step as step_lib

TINY = presets.tiny().model
WIDE = dataclasses.replace(TINY, backbone_width=64, heads=("image", "action"))


def image_network(manifest):
    """timm's name -> array, of the image encoder in a manifest of the reference, whose last layers are as in timm."""
    return {key.removeprefix("encoder."): weights_rule.make_param(key, shape)
            for key, shape in golden.manifest(manifest).items() if key.startswith("encoder.")}


@pytest.fixture(scope="module")
def resnet():
    return image_network("1d_RV_WOB_TR_novoxel") | {"fc.weight": np.zeros((1000, 512), np.float32)}


@pytest.fixture(scope="module")
def resnet_file(resnet, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "resnet18.safetensors"
    safetensors_file.save(path, resnet)
    return path


def test_every_encoder_starts_from_the_file_and_says_so(resnet, resnet_file):
    fresh = world_model.WorldModel(WIDE).init(jax.random.key(0))
    filled, notes = backbones.load_into(fresh, backbones.read(resnet_file), WIDE)
    assert [note.partition(":")[0] for note in notes] == ["camera/backbone", "lidar/backbone", "route/backbone"]
    assert "first convolution from 3 to 4 channels" in notes[1] and "first" not in notes[0]
    params = filled["params"]
    for module in ("camera", "lidar", "route"):
        np.testing.assert_array_equal(params[module]["backbone"]["layer3_1"]["conv2"]["kernel"],
                                      resnet["layer3.1.conv2.weight"].transpose(2, 3, 1, 0))
        np.testing.assert_array_equal(filled["batch_stats"][module]["backbone"]["bn1"]["var"],
                                      resnet["bn1.running_var"])
    first = resnet["conv1.weight"].transpose(2, 3, 1, 0)
    np.testing.assert_allclose(params["lidar"]["backbone"]["conv1"]["kernel"],
                               first[:, :, [0, 1, 2, 0]] * np.float32(0.75), rtol=1e-6)
    np.testing.assert_array_equal(params["fusion"]["combine"]["kernel"], fresh["params"]["fusion"]["combine"]["kernel"])


def test_mobilevit_is_read_in_both_of_timms_spellings_and_from_within_a_wrapper(tmp_path):
    tensors = image_network("2d_mobilevit")
    tensors = {f"module.backbone.{key.replace('stages_', 'stages.')}": value for key, value in tensors.items()}
    path = tmp_path / "mobilevitv2_100.pth"
    torch_writer.write_zip(path, {"state_dict": torch_writer.tensors(tensors), "epoch": 300})
    backbone = backbones.read(path)
    assert backbone.kind == "mobilevitv2_100"
    maps = jax.eval_shape(lambda: backbones.frozen_encoder(backbone).maps(jnp.zeros((1, 64, 128, 3))))
    assert [leaf.shape[-1] for leaf in maps] == [128, 256, 384, 512]
    with pytest.raises(backbones.BackboneError, match="holds mobilevitv2_100, the model's image encoder is resnet18"):
        backbones.load_into({"params": {}}, backbone, WIDE)


def test_a_file_that_does_not_fit_is_named_with_what_was_expected_and_found(resnet, resnet_file, tmp_path):
    fresh = world_model.WorldModel(TINY).init(jax.random.key(0))
    with pytest.raises(backbones.BackboneError, match=r"conv1.weight is \[64, 3, 7, 7\]\), but the model "
                                                      r"expected model.backbone_width=4\. .*backbone_width=64"):
        backbones.load_into(fresh, backbones.read(resnet_file), TINY)
    short = resnet | {"layer2.0.conv1.weight": resnet["layer2.0.conv1.weight"][:64]}
    safetensors_file.save(tmp_path / "short.safetensors", short)
    with pytest.raises(backbones.BackboneError, match=r"short.*layer2.0.conv1.weight is \[64, 64, 3, 3\], the "
                                                      r"perceptual network expected \[128, 64, 3, 3\]"):
        backbones.frozen_encoder(backbones.read(tmp_path / "short.safetensors"))
    two = {f"{student}.{key}": value for key, value in resnet.items() for student in ("student", "teacher")}
    safetensors_file.save(tmp_path / "two.safetensors", two)
    with pytest.raises(backbones.BackboneError, match=r"two.*expected one image network, found 2: resnet18 under"):
        backbones.read(tmp_path / "two.safetensors")
    deeper, other = tmp_path / "resnet34.safetensors", tmp_path / "alexnet.safetensors"
    safetensors_file.save(deeper, resnet | {"layer1.2.conv1.weight": resnet["layer1.0.conv1.weight"]})
    with pytest.raises(backbones.BackboneError, match=r"resnet34.*1 are strange \(layer1.2.conv1.weight\)"):
        backbones.read(deeper)
    safetensors_file.save(other, {"features.0.weight": np.zeros((64, 3, 11, 11), np.float32)})
    with pytest.raises(backbones.BackboneError, match=r"alexnet.*found 1 tensors such as features.0.weight"):
        backbones.read(other)


def test_the_perceptual_term_needs_a_network_and_says_which(resnet_file):
    with pytest.raises(ValueError, match=r"--backbone-weights=PATH .* or --perceptual-from=RUN"):
        train.configure(train.Options(preset="tiny", perceptual=True))
    config, _, _ = train.configure(train.Options(preset="tiny", perceptual_from=resnet_file))
    assert config.loss.image_perceptual == train.PERCEPTUAL_WEIGHT
    assert train.frozen_encoder(config).source == f"resnet18 of {resnet_file}"
    assert train.frozen_encoder(presets.tiny()) is None
    with pytest.raises(ValueError, match=r"train\.perceptual_from names no network"):
        train.frozen_encoder(train.configure(train.Options(preset="tiny", set=("loss.image_perceptual=0.1",)))[0])
    with pytest.raises(ValueError, match=r"no head predicts any \(heads action\): add --with-heads=image"):
        train.configure(train.Options(preset="tiny", heads="action", perceptual_from=resnet_file))
    with pytest.raises(ValueError, match="--backbone-weights and --init contradict"):
        train.configure(train.Options(backbone_weights=resnet_file, init=resnet_file.parent))


def test_the_encoder_of_a_run_takes_part_in_a_training_step():
    config = dataclasses.replace(presets.tiny(), model=dataclasses.replace(TINY, heads=("image", "action")))
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, image_perceptual=0.1))
    model = world_model.WorldModel(config.model)
    variables = model.init(jax.random.key(0))
    frozen = backbones.frozen_encoder_of_run(variables, config.model, "a run")
    body = step_lib.gradient_body(model, config, frozen)
    batch = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype),
                         preparation.expected_batch(config, 2))
    fresh = state.create(variables, optimizer.make_optimizer(config.optimizer, 4), jax.random.key(1))
    gradients, _, metrics = jax.eval_shape(lambda batch: body(fresh, batch, None), batch)
    assert {f"image_perceptual_{scale}" for scale in (1, 2, 4)} <= set(metrics)
    assert jax.tree.structure(gradients) == jax.tree.structure(model.variable_shapes()["params"])
