"""The camera's picture (paper section III-D)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import head, types
from muvo_jax.config import LastSeen, LossConfig, ModelConfig, VoxelGrid, as_kind
from muvo_jax.metrics import baselines, image, streaming
from muvo_jax.model import decoders, glimpse, tokens
from muvo_jax.objectives import labels, regression, similarity
from muvo_jax.ops import resample


def _losses(learned: head.Learned) -> dict[str, head.Sums]:
    loss = learned.loss
    sums: dict[str, head.Sums] = {}
    masks = labels.map_labels(learned.truth("image_instance_mask")) if loss.image_instance else None
    for scale, target in labels.image_labels(learned.truth("image")).items():
        prediction = learned.predictions[scale]
        sums[f"image_{scale}"] = regression.l1_sums(prediction, target)
        sums[f"image_squared_{scale}"] = regression.l2_sums(prediction, target)
        if masks is not None:
            sums[f"image_instance_{scale}"] = regression.l1_sums(prediction, target, masks[scale])
        if loss.image_similarity:
            sums[f"image_similarity_{scale}"] = similarity.dissimilarity_sums(prediction, target)
        if loss.image_perceptual:
            if learned.frozen is None:
                raise ValueError("losses: loss.image_perceptual is on, but there is no frozen image network. Train "
                                 "with --perceptual and --backbone-weights=PATH or --perceptual-from=RUN.")
            sums[f"image_perceptual_{scale}"] = learned.frozen.distance_sums(prediction, target)
    return sums


def _weights(loss: LossConfig) -> dict[str, float]:
    return head.scaled(loss, "image", "image_squared", "image_similarity", "image_perceptual", "image_instance")


def _average(mean: baselines.TrainingMean, config: ModelConfig) -> dict[int, types.Array]:
    del config
    return labels.image_labels(np.round(255.0 * mean.prediction()["image"]).astype(np.uint8))


def _sums(judged: head.Judged) -> dict[str, streaming.Sums]:
    target = np.asarray(judged.truth.image)
    psnr_db = np.asarray(image.frame_psnr_db(judged.frames, target))
    sums: dict[str, streaming.Sums] = {"frames": streaming.mean_sums(psnr_db)}
    if judged.truth.image_moving_mask is not None:
        sums["movers"] = image.masked_sums(judged.frames, target, np.asarray(judged.truth.image_moving_mask))
    return sums


def _error(frames: np.ndarray, truth: types.Batch, grid: VoxelGrid) -> np.ndarray:
    """The mean squared error."""
    del grid
    target = np.asarray(truth.image, np.float32) / 255.0
    return np.square(frames - target).mean(axis=(2, 3, 4), dtype=np.float64)


def _draw(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import canvas, panels  # with Pillow, which imagining does not need
    del scene
    return canvas.resize(panels.camera(frame), columns_px)


def _see(seen: glimpse.ImageGlimpse, config: ModelConfig) -> types.Array:
    del config
    return jnp.concatenate([seen.image - 0.5 * seen.covered, seen.covered], axis=-1)


def _compose(raw, seen: glimpse.ImageGlimpse, mean, config: ModelConfig) -> dict[int, types.Array]:
    """The average frame is put in the light of the newest image: at night it would fill every turn with daylight."""
    del config
    drawn, average = raw, mean(jax.tree.map(jnp.zeros_like, raw))
    usual = average[1].mean(axis=(1, 2), keepdims=True)
    light = jnp.where((seen.colour > 0.0) & (usual > 0.0), seen.colour / jnp.where(usual > 0.0, usual, 1.0), 1.0)
    moved, covered, result = seen.image, seen.covered, {}
    for scale in head.SCALES:
        if scale > 1:
            moved, covered = resample.mean_pool2(moved), resample.mean_pool2(covered)
        result[scale] = moved + (1.0 - covered) * light * average[scale] + drawn[scale]
    return result


HEAD = head.Head(
    targets=lambda model: {"image": (*model.image_size, 3)},
    term_targets={"image_instance_mask": head.TermTarget("image_instance", lambda model: model.image_size)},
    build=lambda model: decoders.of_image(model, 3), scales=head.SCALES, tokens="image", initial_bias=0.5,
    losses=_losses, weights=_weights, average=_average,
    guide=head.Guide(view="image", plane=lambda model: model.image_size,
                     width=lambda model: as_kind(model.first_guess, LastSeen).widths["image"],
                     channels=lambda model, scale: 3, shrink=tokens.IMAGE_SHRINK, see=_see, compose=_compose,
                     blurs=True),
    frames=head.Frames(
        field="image", of=lambda value, model: jnp.clip(value, 0.0, 1.0), sums=_sums, error=_error, error_name="image",
        metrics={"psnr_db": head.Metric("frames", streaming.mean, "PSNR", "dB", 2, on_screen=True, by_step=True,
                                        logged="imagined_psnr_db", error=lambda decibels: 10.0 ** (-decibels / 10.0)),
                 "psnr_movers_db": head.Metric("movers", image.masked_psnr_db, "PSNR of movers", "dB", 2)},
        pictures=(head.Picture("image", _draw),)))
