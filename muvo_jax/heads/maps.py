"""Optional heads that draw one value a pixel of a sensor: the depth, and what each pixel shows or hit."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax import head, types
from muvo_jax.config import ModelConfig
from muvo_jax.metrics import maps, streaming
from muvo_jax.model import decoders
from muvo_jax.objectives import classification, labels, regression


def _depth_losses(learned: head.Learned) -> dict[str, head.Sums]:
    """In units of range_scale_m, where nothing is measured too, so that the model learns where that is."""
    scale_m = learned.model.range_scale_m
    return {f"depth_{scale}": regression.l1_sums(learned.predictions[scale] / scale_m, target[..., None] / scale_m)
            for scale, target in labels.map_labels(learned.truth("depth_m")).items()}


def _depth_sums(judged: head.Judged) -> dict[str, streaming.Sums]:
    return {"frames": streaming.mean_sums(maps.depth_error_m(judged.frames, np.asarray(judged.truth.depth_m)))}


def _draw_depth(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import canvas, panels  # with Pillow, which imagining does not need
    return canvas.resize_hard(panels.depth_image(frame, far_m=scene.far_m), columns_px)


DEPTH = head.Head(
    targets=lambda model: {"depth_m": model.image_size},
    build=lambda model: decoders.of_image(model, 1), scales=head.SCALES, tokens="image", initial_bias=0.0,
    finish=lambda value, scale, config: value * config.range_scale_m,
    losses=_depth_losses, weights=lambda loss: head.scaled(loss, "depth"),
    frames=head.Frames(
        field="depth_m", of=lambda value, model: value[..., 0], sums=_depth_sums,
        metrics={"depth_error_m": head.Metric("frames", streaming.mean, "depth error", "m", 2, higher=False,
                                              on_screen=True)},
        pictures=(head.Picture("depth", _draw_depth, legend=("range",)),)))


def _semantic(name: str, field: str, size: Callable[[ModelConfig], tuple[int, ...]],
              decoder: Callable[[ModelConfig, int], linen.Module], tokens: str, *, on_screen: bool) -> head.Head:
    """A head that says the class of each pixel of a sensor; `name` is that of its weight and its share, too."""
    def losses(learned: head.Learned) -> dict[str, head.Sums]:
        loss = learned.loss
        return {f"{name}_{scale}": classification.cross_entropy_sums(
                    learned.predictions[scale], target, weights=loss.semantic_weights,
                    top_share=getattr(loss, f"{name}_share"))
                for scale, target in labels.map_labels(learned.truth(field)).items()}

    def sums(judged: head.Judged) -> dict[str, streaming.Sums]:
        truth = np.asarray(getattr(judged.truth, field))
        return {"frames": streaming.mean_sums(maps.share_right(judged.frames, truth))}

    label = f"{name.replace('_', ' ')}, share right"
    return head.Head(
        targets=lambda model: {field: size(model)}, build=lambda model: decoder(model, model.semantic_classes),
        scales=head.SCALES, tokens=tokens, losses=losses, weights=lambda loss: head.scaled(loss, name),
        frames=head.Frames(
            field=field, of=_most_likely, sums=sums,
            metrics={f"{name}_share": head.Metric("frames", streaming.mean, label, on_screen=on_screen)},
            pictures=(head.Picture(name.replace("_", " "), _draw_classes),)))


def _most_likely(logits: types.Array, model: ModelConfig) -> types.Array:
    del model
    return jnp.argmax(logits, axis=-1).astype(jnp.uint8)


def _draw_classes(frame: np.ndarray, scene, columns_px: int) -> np.ndarray:
    from muvo_jax.viz import canvas, panels
    del scene
    return canvas.resize_hard(panels.class_image(frame), columns_px)


SEMANTIC_IMAGE = _semantic(
    "semantic_image", "image_classes", lambda model: model.image_size, decoders.of_image, "image", on_screen=True)
SEMANTIC_RANGE_VIEW = _semantic(
    "semantic_range_view", "range_view_classes", lambda model: (model.range_view.rows, model.range_view.columns),
    decoders.of_range_view, "range_view", on_screen=False)
