"""The paper-size model against numbers of the authors' PyTorch code, on weights that both sides generate by one rule.

Needs a folder of such numbers in the environment variable MUVO_GOLDEN (p3_modules_1d.npz, packs.py, weights_rule.py,
p4_full/1d_RV_WOB_TR_voxel.npz and manifests/); skipped without it. Run with  pytest -m slow -s  to see the errors.
"""

import functools
import importlib.util
import json
import os
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.interop import names
from muvo_jax.model import fusion, rollout, world_model
from muvo_jax.nn import attention, layers, norm, resnet
from muvo_jax.nn import pyramid as pyramid_lib
from muvo_jax.types import Batch, StepNoise

FOLDER = pathlib.Path(os.environ.get("MUVO_GOLDEN", "/nowhere"))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (FOLDER / "p3_modules_1d.npz").exists(),
                       reason="the environment variable MUVO_GOLDEN names no folder with p3_modules_1d.npz"),
]
CONFIG = config_lib.ModelConfig(numerics="reference")
MODEL = world_model.WorldModel(CONFIG)
EVAL = norm.Mode()


@functools.cache
def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@functools.cache
def pack(name):
    return load("packs").ParityPack(FOLDER / name)


@functools.cache
def seed():
    path = FOLDER / "pack.json"
    return json.loads(path.read_text())["seed"] if path.exists() else 0


def make_input(name, shape, kind):
    return load("weights_rule").make_input(name, shape, kind, seed())


@functools.cache
def variables():
    manifest = json.loads((FOLDER / "manifests" / "1d_RV_WOB_TR_voxel.json").read_text())
    state_dict = {key: load("weights_rule").make_param(key, entry["shape"]) for key, entry in manifest.items()}
    return jax.tree.map(jnp.asarray, names.convert_state_dict(state_dict, CONFIG))


def call(function, *args):
    """Runs a method of the network, given as a function of the bound network, on the converted weights."""
    run = lambda weights, *rest: world_model.Network(CONFIG).apply(weights, *rest, method=function)
    return jax.jit(run)(variables(), *args)


def channels_last(array):
    return np.moveaxis(array, 1, -1)


def torch_layout(array, lead):
    """[*lead, *S, C] -> [*lead, C, *S]"""
    return np.moveaxis(np.asarray(array), -1, lead)


def assert_parity(source, errors, tolerance):
    """Compares name -> array with the pack and asserts the tolerance, which may be given per name."""
    measured = {name: pack(source).error(name, np.asarray(value)) for name, value in errors.items()}
    for name, error in measured.items():
        print(f"{name:50s} {error:.1e}")
    limit = lambda name: max((value for part, value in tolerance.items() if part in name), default=1e-4)
    assert {name: error for name, error in measured.items() if not error < limit(name)} == {}


P3 = "p3_modules_1d.npz"


def test_backbones_and_necks():
    image = channels_last(make_input("enc_img", (1, 3, 320, 832), "smooth_pm1"))
    range_view = channels_last(make_input("enc_rv", (1, 4, 64, 1024), "smooth_pm1"))
    pyramid = [channels_last(make_input(f"fpn{level}", (1, *shape), "smooth_pm1")) for level, shape in
               enumerate(((128, 40, 104), (256, 20, 52), (512, 10, 26)))]
    params, stats = variables()["params"], variables()["batch_stats"]

    def run(module, part, sub, value):
        weights = {"params": params[part][sub], "batch_stats": stats[part][sub]}
        return jax.jit(lambda weights, value: module.apply(weights, value, EVAL))(weights, value)

    backbone = resnet.ResNet18(64, (2, 3, 4))
    out = {}
    for index, value in enumerate(run(backbone, "camera", "backbone", image)):
        out[f"encoder_resnet18/feat{index}"] = torch_layout(value, 1)
    for index, value in enumerate(run(backbone, "lidar", "backbone", range_view)):
        out[f"range_view_encoder_resnet18/feat{index}"] = torch_layout(value, 1)
    out["DecoderDS/out"] = torch_layout(run(pyramid_lib.DownsamplingPyramid(384), "camera", "neck", pyramid), 1)
    assert_parity(P3, out, {})


def test_transformer_and_compression():
    tokens = np.swapaxes(make_input("tokens", (324, 2, 384), "normal"), 0, 1)
    params, stats = variables()["params"]["fusion"], variables()["batch_stats"]["fusion"]
    transformer = attention.TransformerEncoder(6, 8, 2048, 0.1)
    first = attention.EncoderLayer(8, 2048, 0.1)
    out = {
        "transformer_encoder/layer0": first.apply({"params": params["transformer"]["layer0"]}, tokens, None, 0),
        "transformer_encoder/out": transformer.apply({"params": params["transformer"]}, tokens),
    }
    out = {name: np.swapaxes(value, 0, 1) for name, value in out.items()}
    for sensor, size in (("image", (10, 26)), ("lidar", (2, 32))):
        name = f"{sensor}_compression"
        value = channels_last(make_input(f"{sensor}_feature_conv_in", (2, 384, *size), "normal"))
        weights = {"params": params[name], "batch_stats": stats[name]}
        out[f"{sensor}_feature_conv/out"] = fusion.Compression(512).apply(weights, value, EVAL)
    assert_parity(P3, out, {})


def test_measurements():
    speed_mps = make_input("speed", (4, 1), "speed")[:, 0]
    route = channels_last(make_input("route", (2, 3, 64, 64), "smooth_pm1"))
    # The pack feeds a map that is normalised already, with three different channels: enter behind the normalisation.
    params, stats = variables()["params"]["route"], variables()["batch_stats"]["route"]
    (deepest,) = resnet.ResNet18(64, (4,)).apply({"params": params["backbone"], "batch_stats": stats["backbone"]},
                                                 route, EVAL)
    route_vector = layers.Dense(16).apply({"params": params["linear"]}, jnp.mean(deepest, axis=(1, 2)))
    assert_parity(P3, {"speed_enc/out": call(lambda network, value: network.speed(value), speed_mps),
               "backbone_route/out": route_vector}, {})


def test_decoders():
    features = jnp.asarray(make_input("state", (2, 1536), "normal"))
    full = rollout.decode(MODEL, variables(), features, ("action", "range_view"))
    one = rollout.decode(MODEL, variables(), features[:1], ("image", "occupancy"))
    out = {"policy/out": full["action"][1]}
    for scale in (1, 2, 4):
        out[f"lidar_re/lidar_reconstruction_{scale}"] = torch_layout(full["range_view"][scale] / 50.0, 1)
        out[f"rgb_decoder/rgb_{scale}"] = torch_layout(one["image"][scale], 1)
        out[f"voxel_decoder/voxel_{scale}"] = torch_layout(one["occupancy"][scale], 1)
    assert_parity(P3, out, {"voxel": 5e-4})


@pytest.mark.parametrize("sampled", [False, True])
def test_recurrent_model(sampled):
    embedding = make_input("rssm_emb", (2, 6, 512), "normal")
    actions = make_input("rssm_act", (2, 12, 2), "pm1")
    draw = lambda index: make_input(f"rssm_noise_{index}", (2, 512), "normal") if sampled else np.zeros((2, 512), "f4")
    prior_noise = np.stack([draw(2 * step) for step in range(6)], 1)
    posterior_noise = np.stack([draw(2 * step + 1) for step in range(6)], 1)
    noise = StepNoise(jnp.asarray(prior_noise), jnp.asarray(posterior_noise), jnp.zeros((2, 6), bool))
    is_first = np.arange(6)[None] == np.zeros((2, 1))
    observed = rollout.filter_embeddings(MODEL, variables(), jnp.asarray(embedding), jnp.asarray(actions[:, :6]),
                                         jnp.asarray(is_first), noise)
    prefix = f"rssm_sample{int(sampled)}"
    out = {}
    for kind, gaussian, drawn in (("prior", observed.prior, prior_noise),
                                  ("posterior", observed.posterior, posterior_noise)):
        out |= {f"{prefix}/{kind}/hidden_state": observed.states.deterministic,
                f"{prefix}/{kind}/mu": gaussian.mean, f"{prefix}/{kind}/sigma": gaussian.std,
                f"{prefix}/{kind}/sample": gaussian.sample(drawn)}
    state, steps = observed.last, []
    for step in range(6):
        state, prior = MODEL.imagine_step(variables(), jnp.asarray(draw(12 + step)),
                                          jnp.asarray(actions[:, 6 + step]), state)
        steps.append((state.deterministic, state.stochastic, prior.mean, prior.std))
    for name, *values in zip(("hidden_state", "sample", "mu", "sigma"), *steps, strict=True):
        out[f"{prefix}/imagine/{name}"] = np.stack(values, 1)
    assert_parity(P3, out, {})


P4 = "p4_full/1d_RV_WOB_TR_voxel.npz"


@functools.cache
def full_batch():
    """The raw batch, cropped as the reference crops it, and the three actions to imagine with."""
    frames = pack(P4).shape("embedding")[1]
    image = make_input("full_image", (1, frames, 3, 600, 960), "image_u8")[..., 138:458, 64:896]
    route = make_input("full_route", (1, frames, 3, 192, 192), "route_u8")[:, :, 0, ::3, ::3]
    range_view = make_input("full_rv", (1, frames, 4, 64, 1024), "range_view")
    action = np.concatenate([make_input(f"full_{name}", (1, frames + 3, 1), "pm1")
                             for name in ("throttle", "steer")], -1)
    batch = Batch(action=action[:, :frames], is_first=np.arange(frames)[None] == 0,
                  image=np.ascontiguousarray(np.moveaxis(image, 2, -1)), range_view=np.moveaxis(range_view, 2, -1),
                  route_map=route, speed_mps=make_input("full_speed", (1, frames, 1), "speed")[..., 0])
    return batch, action[:, frames:]


def head_entries(prefix, predictions):
    out = {}
    for scale in (1, 2, 4):
        out[f"{prefix}/rgb_{scale}"] = torch_layout(predictions["image"][scale], 2)
        out[f"{prefix}/lidar_reconstruction_{scale}"] = torch_layout(predictions["range_view"][scale] / 50.0, 2)
        out[f"{prefix}/voxel_{scale}"] = torch_layout(predictions["occupancy"][scale], 2)
    action = predictions["action"][1]
    return out | {f"{prefix}/throttle_brake": action[..., :1], f"{prefix}/steering": action[..., 1:]}


def test_full_model():
    batch, future_actions = full_batch()
    key = jax.random.key(0)
    embedding, _ = jax.jit(lambda weights, batch: MODEL.encode(weights, batch))(variables(), batch)
    observed = rollout.observe(MODEL, variables(), key, batch, sampled=False)
    out = {"embedding": embedding}
    for kind, gaussian in (("prior", observed.prior), ("posterior", observed.posterior)):
        out |= {f"out/{kind}/hidden_state": observed.states.deterministic, f"out/{kind}/mu": gaussian.mean,
                f"out/{kind}/sigma": gaussian.std, f"out/{kind}/sample": gaussian.mean}
    out |= head_entries("out", rollout.decode(MODEL, variables(), observed.states))
    for name, driver in (("imagine", future_actions), ("imagine_policy", rollout.learned_policy(MODEL, variables()))):
        dream = rollout.imagine(MODEL, variables(), key, observed.last, driver, horizon=3, sampled=False)
        out |= {f"{name}/hidden": dream.states.deterministic, f"{name}/sample": dream.states.stochastic,
                f"{name}/state": dream.features, f"{name}/action": dream.actions}
        out |= head_entries(name, rollout.decode(MODEL, variables(), dream.states))
    assert_parity(P4, out, {"voxel": 1e-3})
