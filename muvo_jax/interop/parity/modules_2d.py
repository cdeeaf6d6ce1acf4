"""File p3_modules_2d: the parts of the reference's 2D model, in evaluation mode."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop import unused_modules
from muvo_jax.interop.parity import cases, drawing, modules_1d
from muvo_jax.model import decoders, latents
from muvo_jax.nn import resnet

TOLERANCE, STYLED_TOLERANCE = modules_1d.TOLERANCE, modules_1d.STYLED_TOLERANCE
FUSION = config_lib.TransformerFusion()
CONFIG = config_lib.ModelConfig(latent=config_lib.TokenLatent(), fusion=FUSION, numerics="reference")
# The file's small transition: 48 channels everywhere.
NARROW = dataclasses.replace(CONFIG, fusion=config_lib.TransformerFusion(token_channels=48))
Checks = Iterator[cases.Check]


def _narrow_key(key: str) -> str:
    return "rssm48." + key.removeprefix("rssm.")


def recurrent_units(context: cases.Context) -> Checks:
    """The inputs hold tokens before the batch."""
    shape = context.shape("gru_glo/out") or (33, 2, 384)
    state, x = (np.swapaxes(context.draw(name, shape, "normal"), 0, 1) for name in ("gg_h", "gg_x"))
    out = drawing.run(latents.TokenGRU(384), state, x, where="transition/gru/")
    yield cases.Check("gru_glo/out", np.swapaxes(out, 0, 1), TOLERANCE)
    shape = context.shape("gru_plain/out") or (11, 2, 48)
    state, x = (context.draw(name, shape, "normal") for name in ("gp_h", "gp_x"))
    out = drawing.run(unused_modules.PlainTokenGRU(48), state, x, prefix="gru_plain.")
    yield cases.Check("gru_plain/out", out, TOLERANCE)


def representations(context: cases.Context) -> Checks:
    for name, drawn, config, rename in (("representation_td384", "rep_mem", CONFIG, None),
                                        ("representation_td48", "rep_mem48", NARROW, _narrow_key)):
        memory = np.swapaxes(context.draw(drawn, context.size("p3_2d", drawn), "normal"), 0, 1)
        out = drawing.run(latents.TokenGaussianHead(config), memory, where="transition/prior/", rename=rename,
                          static=(None, 0))
        yield cases.Check(f"{name}/mu", np.swapaxes(out.mean, 0, 1), TOLERANCE)
        yield cases.Check(f"{name}/sigma", np.swapaxes(out.std, 0, 1), TOLERANCE)


def narrow_transition(context: cases.Context) -> Checks:
    yield from _transition(context, "48", NARROW, _narrow_key)


def transition(context: cases.Context) -> Checks:
    yield from _transition(context, "384", CONFIG, None)


def _transition(context: cases.Context, name: str, config: config_lib.ModelConfig, rename) -> Checks:
    sizes = modules_1d.transition_sizes(context, f"rssmtd{name}", "p3_2d", f"rssmtd{name}")
    tokens = context.size("p3_2d", f"rssmtd{name}", "tokens")
    _, channels = latents.TokenTransition.state_shapes(config)[0]
    embedding = context.draw(f"td{name}_emb", (*sizes[:2], channels, tokens), "normal")
    yield from modules_1d.transition_checks(
        context, config, f"td{name}", f"rssmtd{name}", *sizes, embedding=np.swapaxes(embedding, 2, 3), rename=rename,
        moved=lambda value: np.swapaxes(value, 2, 3))


def decoded(context: cases.Context) -> Checks:
    width = CONFIG.decoder_channels
    plane = lambda channels, stages: decoders.TokenDecoder(channels, width, width, stages)
    voxels = decoders.TokenDecoder(2, 2 * CONFIG.occupancy_channels, CONFIG.occupancy_channels, 1)
    for module, factor, usual, where, name, entry in (
            (plane(3, 2), 32, (10, 26), "decoders_image/", "rgb_decoder", "rgb"),
            (plane(4, 1), 16, (4, 64), "decoders_range_view/", "lidar_re", "lidar_reconstruction"),
            (voxels, 16, (12, 12, 4), "decoders_occupancy/", "voxel_decoder", "voxel")):
        grid = _grid(context, f"{name}/{entry}_1", factor) or usual
        tokens = drawing.channels_last(context.draw(f"{name}_in", (1, FUSION.token_channels, *grid), "normal"))
        for scale, value in drawing.run(module, tokens, where=where).items():
            tolerance = STYLED_TOLERANCE if name == "voxel_decoder" else TOLERANCE
            yield cases.Check(f"{name}/{entry}_{scale}", drawing.channels_first(value), tolerance)
    channels = config_lib.BIRDS_EYE_CLASSES + decoders.INSTANCE_CHANNELS
    birds_eye = decoders.TokenDecoder(channels, width, width, 1, head=decoders.BirdsEyeHead)
    # The file feeds the ground plan itself.
    grid = _grid(context, "bev_decoder/bev_segmentation_1", 16) or (12, 12)
    plan = drawing.channels_last(context.draw("bev_decoder_in", (1, FUSION.token_channels, *grid), "normal"))
    for entry, value in drawing.birds_eye_entries("bev_decoder", drawing.run(
            birds_eye, plan, where="decoders_birds_eye/"), 1):
        yield cases.Check(entry, value, TOLERANCE)
    count, *_ = context.shape("policy/out") or (3,)
    tokens = context.draw("pol_in", (count, FUSION.token_channels), "normal")
    yield drawing.action_check("policy/out", decoders.ActionDecoder(), tokens, "decoders_action/", TOLERANCE)


def _grid(context: cases.Context, entry: str, factor: int) -> tuple[int, ...] | None:
    """The grid of tokens that a decoder enlarges by `factor` to [1, C, *sides]."""
    shape = context.shape(entry)
    return tuple(side // factor for side in shape[2:]) if shape else None


def unused_style_decoders(context: cases.Context) -> Checks:
    for name, entry, module, grid in (
            ("style2d", "rgb", unused_modules.style_decoder_2d(3, (3, 4), 1), (3, 4)),
            ("style3d", "voxel", unused_modules.style_decoder_3d(2, (3, 3, 2), 16), (3, 3, 2))):
        style = drawing.channels_last(context.draw(f"{name}_in", (1, 16, *grid), "normal"))
        head = "rgb_head" if name == "style2d" else "segmentation_head"
        rename = lambda key, name=name, head=head: key.replace("voxel_decoder", name).replace("segmentation_head", head)
        for scale, value in drawing.run(module, style, where="decoders_occupancy/", rename=rename).items():
            yield cases.Check(f"{name}/{entry}_{scale}", drawing.channels_first(value), STYLED_TOLERANCE)


def backbone(context: cases.Context) -> Checks:
    image = context.draw("enc_rv", (1, 4, *context.size("p3_2d", "range_hw")), "smooth_pm1")
    maps = drawing.run(resnet.ResNet18(CONFIG.backbone_width, (1, 2, 3)), drawing.channels_last(image),
                       prefix="range_view_encoder.", static=(drawing.EVAL,))
    for level, value in enumerate(maps):
        yield cases.Check(f"range_view_encoder_resnet18_123/feat{level}", drawing.channels_first(value), TOLERANCE)


GROUPS: tuple[cases.Group, ...] = (recurrent_units, representations, narrow_transition, transition, decoded,
                                   unused_style_decoders, backbone)
