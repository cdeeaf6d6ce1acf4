"""File p3_modules_1d: the parts of the reference's 1D model, in evaluation mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax.interop.parity import cases, drawing
from muvo_jax.model import decoders, rollout, world_model
from muvo_jax.nn import attention, layers, pyramid, resnet
from muvo_jax.types import StepNoise

TOLERANCE = 1e-4
STYLED_TOLERANCE = 5e-4  # adaptive instance norms amplify float32 noise
FUSION, LATENT = config_lib.TransformerFusion(), config_lib.VectorLatent()
CONFIG = config_lib.ModelConfig(numerics="reference", fusion=FUSION, latent=LATENT)
_EVAL = (drawing.EVAL,)
_FPN_CHANNELS = (128, 256, 512)
Checks = Iterator[cases.Check]


def backbones(context: cases.Context) -> Checks:
    for name, prefix, drawn, channels, size in (
            ("encoder_resnet18", "encoder.", "enc_img", 3, context.size("p3_1d", "image_hw")),
            ("range_view_encoder_resnet18", "range_view_encoder.", "enc_rv", 4, context.size("p3_1d", "range_hw"))):
        image = drawing.channels_last(context.draw(drawn, (1, channels, *size), "smooth_pm1"))
        maps = drawing.run(resnet.ResNet18(CONFIG.backbone_width, (2, 3, 4)), image, prefix=prefix, static=_EVAL)
        for level, value in enumerate(maps):
            yield cases.Check(f"{name}/feat{level}", drawing.channels_first(value), TOLERANCE)


def necks(context: cases.Context) -> Checks:
    sizes = context.size("p3_1d", "fpn_hw")
    maps = [drawing.channels_last(context.draw(f"fpn{level}", (1, channels, *size), "smooth_pm1"))
            for level, (channels, size) in enumerate(zip(_FPN_CHANNELS, sizes, strict=True))]
    for name, prefix, neck in (("DecoderDS", "feat_decoder", pyramid.DownsamplingPyramid),
                               ("Decoder", "feat_decoder_full", pyramid.UpsamplingPyramid)):
        rename = lambda key, prefix=prefix: key.replace("feat_decoder", prefix)
        out = drawing.run(neck(FUSION.token_channels), maps, where="camera/neck/", rename=rename, static=_EVAL)
        yield cases.Check(f"{name}/out", drawing.channels_first(out), TOLERANCE)


def transformer(context: cases.Context) -> Checks:
    shape = context.shape("transformer_encoder/out", "transformer_encoder/layer0") or context.size("p3_1d", "tokens")
    tokens = np.swapaxes(context.draw("tokens", shape, "normal"), 0, 1)
    size = (FUSION.heads, FUSION.hidden_channels, 0.0)
    first = drawing.run(attention.EncoderLayer(*size), tokens, where="fusion/transformer/layer0/", static=(None, 0))
    yield cases.Check("transformer_encoder/layer0", np.swapaxes(first, 0, 1), TOLERANCE)
    out = drawing.run(attention.TransformerEncoder(FUSION.layers, *size), tokens, where="fusion/transformer/")
    yield cases.Check("transformer_encoder/out", np.swapaxes(out, 0, 1), TOLERANCE)


def compression(context: cases.Context) -> Checks:
    """Two residual blocks and a mean; the second block of the FC fusion's lidar path halves its map too."""
    for name, channels, second_stride in (("image_feature_conv", 384, 1), ("lidar_feature_conv", 384, 1),
                                          ("lidar_state_conv", 64, 2)):
        rows, size = 2, context.size("p3_1d", f"{name}_hw")
        halved = context.shape(f"{name}/block0")
        if halved:
            rows = halved[0]
            size = size if halved[2:] == tuple(-(-side // 2) for side in size) else tuple(2 * n for n in halved[2:])
        x = drawing.channels_last(context.draw(f"{name}_in", (rows, channels, *size), "normal"))
        blocks = [resnet.BasicBlock(LATENT.fused_channels, stride=stride, project=stride == 2)
                  for stride in (2, second_stride)]
        first = drawing.run(blocks[0], x, prefix=f"{name}.0.", static=_EVAL)
        yield cases.Check(f"{name}/block0", drawing.channels_first(first), TOLERANCE)
        second = drawing.run(blocks[1], first, prefix=f"{name}.1.", static=_EVAL)
        yield cases.Check(f"{name}/out", jnp.mean(second, axis=(1, 2)), TOLERANCE)


def measurements(context: cases.Context) -> Checks:
    count, *_ = context.shape("speed_enc/out") or (4,)
    speed = context.draw("speed", (count, 1), "speed") / CONFIG.speed_scale_mps
    out = drawing.run(layers.Mlp((CONFIG.measurement_channels,) * 2), speed, where="speed/mlp/")
    yield cases.Check("speed_enc/out", jax.nn.relu(out), TOLERANCE)
    # The file feeds a map that is normalised already, of three different channels: enter behind the normalisation.
    count, *_ = context.shape("backbone_route/out") or (2,)
    route = drawing.channels_last(context.draw("route", (count, 3, *context.size("p3_1d", "route_hw")), "smooth_pm1"))
    (deepest,) = drawing.run(resnet.ResNet18(CONFIG.backbone_width, (4,)), route, prefix="backbone_route.backbone.",
                             static=_EVAL)
    pooled = jnp.mean(deepest, axis=(1, 2))
    out = drawing.run(layers.Dense(CONFIG.measurement_channels), pooled, where="route/linear/")
    yield cases.Check("backbone_route/out", out, TOLERANCE)


def decoded(context: cases.Context) -> Checks:
    count, *_ = context.shape("policy/out") or (context.size("p3_1d", "state_batch"),)
    state = context.draw("state", (count, LATENT.deterministic_channels + LATENT.stochastic_channels), "normal")

    def plane(entry: str, usual: tuple[int, ...], channels: int) -> decoders.PlaneDecoder:
        rows, columns = (context.shape(f"{entry}_1") or usual)[-2:]
        return decoders.PlaneDecoder((rows, columns), channels, CONFIG.decoder_channels)

    yield drawing.action_check("policy/out", decoders.ActionDecoder(), state, "decoders_action/", TOLERANCE)
    voxels = decoders.StyledDecoder(CONFIG.voxels.shape, 2, 2 * CONFIG.occupancy_channels, CONFIG.occupancy_channels,
                                    LATENT.occupancy_blocks)
    for module, rows, where, name, tolerance in (
            (plane("rgb_decoder/rgb", CONFIG.image_size, 3), state[:1], "decoders_image/", "rgb_decoder/rgb",
             TOLERANCE),
            (plane("lidar_re/lidar_reconstruction", context.size("p3_1d", "range_hw"), 4), state,
             "decoders_range_view/", "lidar_re/lidar_reconstruction", TOLERANCE),
            (voxels, state[:1], "decoders_occupancy/", "voxel_decoder/voxel", STYLED_TOLERANCE)):
        for scale, value in drawing.run(module, rows, where=where).items():
            yield cases.Check(f"{name}_{scale}", drawing.channels_first(value), tolerance)
    birds_eye = drawing.run(decoders.of_ground_plan(CONFIG, config_lib.BIRDS_EYE_CLASSES), state[:1],
                            where="decoders_birds_eye/")
    for entry, value in drawing.birds_eye_entries("bev_decoder", birds_eye, 1):
        yield cases.Check(entry, value, TOLERANCE)


def recurrent(context: cases.Context) -> Checks:
    sizes = transition_sizes(context, "rssm", "p3_1d", "rssm")
    yield from transition_checks(context, CONFIG, "rssm", "rssm", *sizes,
                                 embedding=context.draw("rssm_emb", (*sizes[:2], LATENT.embedding_channels), "normal"))


def transition_sizes(context: cases.Context, label: str, *path: str) -> tuple[int, int, int]:
    """Batch, observed steps and imagined ones, from the arrays of a transition's entries or else from pack.json."""
    batch, steps, imagined = (context.size(*path, name) for name in ("batch", "steps", "imagine"))
    observed, dreamt = (context.shape(f"{label}_sample0/{part}/mu", f"{label}_sample1/{part}/mu")
                        for part in ("posterior", "imagine"))
    return (*(observed[:2] if observed else (batch, steps)), dreamt[1] if dreamt else imagined)


def transition_checks(context: cases.Context, config: config_lib.ModelConfig, name: str, label: str, batch: int,
                      steps: int, imagined: int, *, embedding: np.ndarray,
                      rename: Callable[[str], str] | None = None,
                      moved: Callable[[Any], Any] = np.asarray) -> Checks:
    """Observes `steps` embeddings and imagines on, with the means and with drawn noise.

    Args:
      context, config: of the check and of the transition.
      name: of the inputs.
      label: the entries are called {label}_sample{0, 1}/...
      batch, steps, imagined: sizes.
      embedding: [batch, steps, ...].
      rename: applied to the reference's keys.
      moved: brings a latent [B, T, ...] into the layout of the file.
    """
    model = world_model.WorldModel(config)
    shapes = model.variable_shapes()["params"]["transition"]
    drawn = drawing.draw_variables({"params": {"transition": shapes}}, rename=rename)
    variables = jax.tree.map(jnp.asarray, {**drawn, "batch_stats": {}})
    shape = model.initial_state(batch).stochastic.shape
    actions = context.draw(f"{name}_act", (batch, steps + imagined, 2), "pm1")
    observe = jax.jit(lambda *args: rollout.filter_embeddings(model, *args))
    imagine_step = jax.jit(model.imagine_step)

    def drawn_noise(index: int) -> np.ndarray:
        if len(shape) == 2:
            return context.draw(f"{name}_noise_{index}", shape, "normal")
        tokens_first = (shape[1], shape[0], *shape[2:])  # as the reference keeps them
        return np.swapaxes(context.draw(f"{name}_noise_{index}", tokens_first, "normal"), 0, 1)

    for sampled in (False, True):
        entries = f"{label}_sample{int(sampled)}"
        noises = [drawn_noise(index) if sampled else np.zeros(shape, np.float32)
                  for index in range(2 * steps + imagined)]
        noise = StepNoise(jnp.asarray(np.stack(noises[0:2 * steps:2], 1)),
                          jnp.asarray(np.stack(noises[1:2 * steps:2], 1)), jnp.zeros((batch, steps), bool))
        is_first = np.broadcast_to(np.arange(steps)[None] == 0, (batch, steps))
        observed = observe(variables, jnp.asarray(embedding), jnp.asarray(actions[:, :steps]), is_first, noise)
        for kind, gaussian, used in (("prior", observed.prior, noise.prior),
                                     ("posterior", observed.posterior, noise.posterior)):
            for entry, value in (("hidden_state", observed.states.deterministic), ("mu", gaussian.mean),
                                 ("sigma", gaussian.std), ("sample", gaussian.sample(used))):
                yield cases.Check(f"{entries}/{kind}/{entry}", moved(value), TOLERANCE)
        state, dreamt = observed.last, []
        for step in range(imagined):
            state, prior = imagine_step(variables, noises[2 * steps + step], state, actions[:, steps + step])
            dreamt.append((state.deterministic, state.stochastic, prior.mean, prior.std))
        for entry, *values in zip(("hidden_state", "sample", "mu", "sigma"), *dreamt, strict=True):
            yield cases.Check(f"{entries}/imagine/{entry}", moved(np.stack(values, 1)), TOLERANCE)


GROUPS: tuple[cases.Group, ...] = (backbones, necks, transformer, compression, measurements, decoded, recurrent)
