"""File p1_losses_metrics: losses with their gradients, and metrics.

Inputs are drawn in torch's layout; the gradient is taken with respect to the input in that layout, so that the change
of layout is part of what is differentiated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import types
from muvo_jax.interop.parity import cases, drawing, rounding
from muvo_jax.metrics import image as image_metrics
from muvo_jax.metrics import occupancy, points, streaming
from muvo_jax.model import encoders
from muvo_jax.nn import resnet
from muvo_jax.objectives import classification, kl, perceptual, regression, scal, similarity
from muvo_jax.ops import nearest

LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 1e-4
IGNORED = 255
Checks = Iterator[cases.Check]


def _last(array: Any, axis: int = 2) -> jax.Array:
    """[..., C, *S] with C at `axis` -> [..., *S, C]"""
    return jnp.moveaxis(jnp.asarray(array), axis, -1)


def _loss(name: str, function: Callable[..., jax.Array], *args: np.ndarray,
          gradients: tuple[str, ...] = ("grad",)) -> Checks:
    """Value and gradients of function(*args), one gradient for each of the first arguments.

    Magnitudes, clipping, choices of the worst pixels or the nearest point have kinks, where a gradient may be another.
    """
    count = len(gradients)
    differentiate = jax.jit(jax.value_and_grad(function, argnums=tuple(range(count))))
    value, slopes = differentiate(*args)
    yield cases.Check(f"{name}/loss", value, LOSS_TOLERANCE)
    for index, (gradient, slope) in enumerate(zip(gradients, slopes, strict=True)):
        again = lambda index=index: (differentiate(*moved, *args[count:])[1][index]
                                     for moved in rounding.anew(args[:count]))
        yield cases.Check(f"{name}/{gradient}", slope, GRADIENT_TOLERANCE, again=again)


def divergence(context: cases.Context) -> Checks:
    """Balanced and plain Kullback-Leibler divergence with the reference's rule for the first step."""
    gradients = ("grad_posterior_mu", "grad_posterior_sigma", "grad_prior_mu", "grad_prior_sigma")
    for tag in ("1d", "2d"):
        shape = context.shape(f"kl0.75_{tag}/grad_prior_mu") or context.size("p1", f"kl_{tag}")
        moments = [context.draw(f"kl_{tag}_{side}_{moment}", shape, kind) for side in ("posterior", "prior")
                   for moment, kind in (("mu", "normal"), ("sigma", "sigma"))]
        if tag == "2d":
            moments = [np.swapaxes(moment, 2, 3) for moment in moments]  # (B, S, C, N): tokens are our third axis

        def balanced(*moments, balance):
            posterior, prior = types.Gaussian(*moments[:2]), types.Gaussian(*moments[2:])
            return kl.balanced_kl_sums(posterior, prior, balance=balance, numerics="reference").value()

        # The plain divergence lets both sides learn in full: the sum of the two one-sided gradients.
        plain = lambda *moments: balanced(*moments, balance=1.0) + balanced(*moments, balance=0.0)
        for name, function, factor in (
                ("kl0.75", lambda *moments: balanced(*moments, balance=0.75), 1.0),
                ("kl0.5", lambda *moments: balanced(*moments, balance=0.5), 1.0), ("prob", plain, 0.5)):
            for check in _loss(f"{name}_{tag}", function, *moments, gradients=gradients):
                got = np.asarray(check.got)
                if check.entry.endswith("loss"):
                    got = got * np.float32(factor)
                elif tag == "2d":
                    got = np.swapaxes(got, 2, 3)
                yield cases.Check(check.entry, got, check.tolerance)


def regressions(context: cases.Context) -> Checks:
    for name, prefix in (("regression", "act"), ("regression_c4", "reg3")):
        shape = context.shape(f"{name}_l1/grad", f"{name}_l2/grad") or context.size("p1", name)
        prediction, target = (context.draw(f"{prefix}_{side}", shape, "pm1") for side in ("pred", "tgt"))
        for norm, sums in (("l1", regression.l1_sums), ("l2", regression.l2_sums)):
            yield from _loss(f"{name}_{norm}", lambda prediction, target, sums=sums: sums(prediction, target).value(),
                             prediction, target)


def spatial(context: cases.Context) -> Checks:
    """Regression of maps; a pixel is ignored where the target's first channel is 255, or outside an instance mask."""
    shape = context.shape("spatial_l1/grad", "spatial_l2/grad") or (2, 2, 3, *context.size("p1", "spatial_hw"))
    prediction, target = (context.draw(f"sp_{side}", shape, "normal") for side in ("pred", "tgt"))
    masks = {kind: context.draw(f"sp_{drawn}", (*shape[:2], 1, *shape[3:]), "mask")[:, :, 0]
             for kind, drawn in (("ignore", "ign"), ("imask", "imask"))}
    kept = {"": None, "_ignore": ~masks["ignore"], "_imask": masks["imask"]}
    for norm, sums in (("l1", regression.l1_sums), ("l2", regression.l2_sums)):
        for suffix, mask in kept.items():
            def value(prediction, target, sums=sums, mask=mask):
                return sums(_last(prediction), _last(target), mask).value()

            yield from _loss(f"spatial_{norm}{suffix}", value, prediction, target)
    nothing = regression.l1_sums(_last(prediction), _last(target), np.zeros_like(masks["ignore"])).value()
    yield cases.Check("spatial_l1_allignored/loss", nothing, LOSS_TOLERANCE)


def _voxel_sizes(context: cases.Context) -> tuple[int, ...]:
    """Batch, frames and the sides of the grid."""
    shape = context.shape("sem_scal_c2/grad", "voxel_ce_c2_plain/grad")
    return (*shape[:2], *shape[3:]) if shape else context.size("p1", "voxel_bsxyz")


def scene_class_affinity(context: cases.Context) -> Checks:
    batch, frames, *grid = _voxel_sizes(context)
    logits = 3 * context.draw("vox_pred2", (batch, frames, 2, *grid), "pm1")
    sums = lambda logits, target: scal.occupancy_sums(_last(logits), target[:, :, 0])
    for suffix, kind in (("", "voxel2"), ("_ign", "voxel2_ign")):
        target = context.draw("vox_tgt2", (batch, frames, 1, *grid), kind)
        yield from _loss(f"sem_scal_c2{suffix}", lambda *args: scal.semantic_scal(sums(*args)), logits, target)
        yield from _loss(f"geo_scal_c2{suffix}", lambda *args: scal.geometric_scal(sums(*args)), logits, target)
    empty = np.zeros((batch, frames, 1, *grid), np.uint8)
    yield from _loss("sem_scal_c2_allempty", lambda *args: scal.semantic_scal(sums(*args)), logits, empty)


def chamfer(context: cases.Context) -> Checks:
    def value(prediction, target):
        flat = lambda clouds: clouds.reshape(-1, *clouds.shape[2:])
        return 2.0 * jax.vmap(nearest.chamfer)(flat(prediction), flat(target)).mean()

    prediction, target = _clouds(context)
    noise = lambda: rounding.chamfer_gradient_noise(*(cloud.reshape(-1, *cloud.shape[2:])
                                                      for cloud in (prediction, target))).reshape(prediction.shape)
    for check in _loss("cd_loss", value, prediction, target):
        yield check if check.entry.endswith("/loss") else dataclasses.replace(check, again=None, noise=noise)


def _clouds(context: cases.Context) -> tuple[np.ndarray, np.ndarray]:
    shape = context.shape("cd_loss/grad") or (2, 2, context.size("p1", "chamfer_points"), 3)
    squashed = np.array([30.0, 30.0, 6.0], np.float32)
    prediction, target = (context.draw(f"cd_{side}", shape, "pm1") * squashed for side in ("pred", "tgt"))
    return prediction, target


def peak_signal_to_noise(context: cases.Context) -> Checks:
    prediction, target = _pictures(context)
    psnr = lambda *images: np.asarray(image_metrics.frame_psnr_db(*(_last(image) for image in images)))
    first, second = psnr(prediction, target), psnr(np.float32(0.9) * target, target)
    yield cases.Check("psnr_per_frame", first, LOSS_TOLERANCE)
    yield cases.Check("metric_psnr_1batch", first.mean(), LOSS_TOLERANCE)
    yield cases.Check("metric_psnr_2batches", (first.mean() + second.mean()) / 2, LOSS_TOLERANCE)


VOXEL_WEIGHTS = (1.0, 1.0, 1.0, 1.5, 2.0, 3.0, 1.0, 1.0, 1.0)
SEGMENTATION_WEIGHTS = (1.0, 1.0, 1.0, 2.0, 3.0, 1.0, 1.0, 1.0)
PERCEPTUAL_TOLERANCES = (1e-4, 1e-3)


def cross_entropy(logits: jax.Array, target: jax.Array, **options: Any) -> jax.Array:
    """Of logits [B, S, C, *grid] and classes [B, S, 1, *grid]; options of classification.cross_entropy_sums."""
    return classification.cross_entropy_sums(_last(logits), target[:, :, 0], **options).value()


def _dice(logits: jax.Array, target: jax.Array, *, epsilon: float, naive: bool) -> jax.Array:
    """Of "not empty", arguments as `cross_entropy`."""
    frames = logits.shape[0] * logits.shape[1]
    filled, truth = 1.0 - jax.nn.softmax(logits, axis=2)[:, :, 0], (target[:, :, 0] != 0).astype(jnp.float32)
    return classification.dice_sums(filled.reshape(frames, -1), truth.reshape(frames, -1), epsilon=epsilon,
                                    naive=naive).value()


def _affinity_sums(logits: jax.Array, target: jax.Array, chosen: list[int]) -> scal.OccupancySums:
    """Where the classes `chosen` count as occupied and all others as empty; arguments as `cross_entropy`."""
    others = [index for index in range(logits.shape[2]) if index not in chosen]
    pair = [jax.nn.logsumexp(logits[:, :, np.array(classes)], axis=2) for classes in (others, chosen)]
    return scal.occupancy_sums(jnp.stack(pair, axis=-1), jnp.where(target == IGNORED, IGNORED, jnp.isin(
        target, np.array(chosen)))[:, :, 0])


def _semantic_scal(logits: jax.Array, target: jax.Array) -> jax.Array:
    """The affinity of each class against all others, averaged over the classes that occur."""
    each = [scal.geometric_scal(_affinity_sums(logits, target, [index])) for index in range(logits.shape[2])]
    occurs = jnp.stack([(target == index).any() for index in range(logits.shape[2])]).astype(jnp.float32)
    return (jnp.stack(each) * occurs).sum() / jnp.maximum(occurs.sum(), 1.0)


def _geometric_scal(logits: jax.Array, target: jax.Array) -> jax.Array:
    return scal.geometric_scal(_affinity_sums(logits, target, list(range(1, logits.shape[2]))))


def voxel_classes(context: cases.Context) -> Checks:
    """Cross-entropy, affinity and Dice terms of two and nine classes."""
    batch, frames, *grid = _voxel_sizes(context)
    for classes in (2, 9):
        logits = 3 * context.draw(f"vox_pred{classes}", (batch, frames, classes, *grid), "pm1")
        draw = lambda suffix, classes=classes: context.draw(f"vox_tgt{classes}", (batch, frames, 1, *grid),
                                                            f"voxel{classes}{suffix}")
        target = draw("")
        options: dict[str, dict[str, Any]] = {"plain": {}, "topk0.5": {"top_share": 0.5}, "poly1": {"poly": 2.0}}
        if classes == 9:
            options["weighted"] = {"weights": VOXEL_WEIGHTS}
            options["weighted_topk0.5"] = {"weights": VOXEL_WEIGHTS, "top_share": 0.5}
        for tag, option in options.items():
            loss = lambda *args, option=option: cross_entropy(*args, **option)
            yield from _loss(f"voxel_ce_c{classes}_{tag}", loss, logits, target)
        for epsilon, naive in ((1, True), (0.001, True), (0.001, False)):
            loss = lambda *args, epsilon=epsilon, naive=naive: _dice(*args, epsilon=epsilon, naive=naive)
            yield from _loss(f"dice_c{classes}_eps{epsilon}_naive{int(naive)}", loss, logits, target)
        if classes == 9:  # two classes are the library's own terms, see scene_class_affinity
            for suffix in ("", "_ign"):
                for term, function in (("sem_scal", _semantic_scal), ("geo_scal", _geometric_scal)):
                    yield from _loss(f"{term}_c9{suffix}", function, logits, draw(suffix))


def segmentation(context: cases.Context) -> Checks:
    shape = context.shape("seg_plain/grad") or (2, 2, 8, *context.size("p1", "segmentation_hw"))
    for name, prefix, classes, option in (
            ("seg_plain", "seg", 8, {}), ("seg_weights", "seg", 8, {"weights": SEGMENTATION_WEIGHTS}),
            ("seg_topk0.25_weights", "seg", 8, {"weights": SEGMENTATION_WEIGHTS, "top_share": 0.25}),
            ("seg_poly1", "seg", 8, {"poly": 1.0}),
            ("seg9_topk0.5_voxelweights", "seg9", 9, {"weights": VOXEL_WEIGHTS, "top_share": 0.5})):
        logits = 3 * context.draw(f"{prefix}_pred", (*shape[:2], classes, *shape[3:]), "pm1")
        target = context.draw(f"{prefix}_tgt", (*shape[:2], 1, *shape[3:]), f"labels{classes}")
        options: dict[str, Any] = dict(option)
        loss = lambda *args, options=options: cross_entropy(*args, **options)
        yield from _loss(name, loss, logits, target)


def structural_similarity(context: cases.Context) -> Checks:
    prediction, target = _pictures(context)

    def mean(prediction, target):
        return similarity.frame_similarity(_last(prediction), _last(target)).mean()

    def mean_of_positive(prediction, target):
        return jax.nn.relu(similarity.frame_similarity(_last(prediction), _last(target))).mean()

    yield from _loss("ssim", mean, prediction, target)
    yield from _loss("ssim_nonneg", mean_of_positive, prediction, target)
    window = np.broadcast_to(similarity.window(), (3, 1, 11, 11))
    yield cases.Check("ssim_window", window, LOSS_TOLERANCE)
    both = (mean(prediction, target) + mean(np.float32(0.9) * target, target)) / 2
    yield cases.Check("metric_ssim_2batches", both, LOSS_TOLERANCE)


def chamfer_metrics(context: cases.Context) -> Checks:
    """Half of both mean distances; of all points, and of those near the vehicle."""
    prediction, target = (cloud.reshape(-1, *cloud.shape[2:]) for cloud in _clouds(context))
    batches = ((prediction, target), (target + np.float32(0.1), target))
    near = lambda cloud: cloud[((cloud >= (-20, -20, -2)) & (cloud <= (20, 20, 6))).all(axis=-1)]
    mean = lambda inner: np.mean([[points.chamfer_m(*(near(cloud) if inner else cloud for cloud in pair))
                                   for pair in zip(*clouds, strict=True)] for clouds in batches])
    yield cases.Check("metric_cd_1d_2batches", mean(False), LOSS_TOLERANCE)
    yield cases.Check("metric_cd_2d_2batches_full_inner", np.array([mean(False), mean(True)]), LOSS_TOLERANCE)


def class_scores(context: cases.Context) -> Checks:
    shape = context.size("p1", "ssc")
    for classes in (2, 9):
        truth = context.draw(f"ssc_true{classes}", shape, f"voxel{classes}_ign")
        keep = (context.draw(f"ssc_mix{classes}", shape, "uniform") < 0.7) & (truth != IGNORED)
        prediction = np.where(keep, truth, context.draw(f"ssc_pred{classes}", shape, f"voxel{classes}"))
        nonempty = context.draw(f"ssc_ne{classes}", shape, "uniform") < 0.5
        for tag, truths in (("batch1", [truth]), ("batch2", [truth, np.where(truth == IGNORED, 0, truth)]),
                            ("nonempty", [np.where(nonempty, truth, IGNORED)])):
            filled = _binary_scores(prediction, truths, range(1, classes))
            # A class that nowhere occurs and is nowhere predicted counts as 0.
            each = np.nan_to_num([_binary_scores(prediction, truths, [index])["iou_occ"] for index in range(classes)])
            overall = np.array([*(filled[name] for name in ("precision", "recall", "iou_occ")), each[1:].mean()])
            yield cases.Check(f"ssc_c{classes}_{tag}", overall, LOSS_TOLERANCE)
            yield cases.Check(f"ssc_c{classes}_{tag}_perclass", each, LOSS_TOLERANCE)


def _binary_scores(prediction: np.ndarray, truths: list[np.ndarray],
                   chosen: Sequence[int]) -> dict[str, float]:
    """Scores of occupancy over batches [N, *grid] of one prediction, where the classes `chosen` count as occupied."""
    sums = streaming.DriveSums()
    for truth in truths:
        target = np.where(truth == IGNORED, IGNORED, np.isin(truth, chosen))
        counted = occupancy.counts(np.isin(prediction, chosen)[:, None], target[:, None], unknown_is_empty=False)
        sums.add(("",) * len(truth), counted)
    return {name: float(score(sums.total())[0]) for name, score in occupancy.SCORES.items()}


def perceptual_distances(context: cases.Context) -> Checks:
    """Distances of a ResNet-18's maps of the normalised pictures. Its ReLUs are kinks of the gradient."""
    shape = context.shape("perceptual_l2/grad") or (1, 2, 3, *context.size("p1", "perceptual_hw"))
    prediction, target = (context.draw(f"perc_{side}", shape, "smooth") for side in ("pred", "tgt"))
    network, weights = perceptual_network((shape[0] * shape[1], *shape[3:], 3))
    maps = lambda picture, weights: perceptual_maps(network, weights, picture)
    for level, value in enumerate(jax.jit(maps)(prediction, weights)):
        yield cases.Check(f"perceptual_feat{level}", drawing.channels_first(value), PERCEPTUAL_TOLERANCES[0])
    for name, norm, style in (("l2", "l2", False), ("l1", "l1", False), ("l2_style", "l2", True)):
        def distance(prediction, weights, norm=norm, style=style):
            features, wanted = (maps(picture, weights) for picture in (prediction, target))
            if (norm, style) == ("l2", False):
                return perceptual.distance_sums(features, wanted).terms("distance")["distance"]
            return _feature_distance(features, wanted, jnp.abs if norm == "l1" else jnp.square, style)

        differentiate = jax.jit(jax.value_and_grad(distance))
        # Several kinks must fall to the reference's sides at once: of the L1 in one of 32 roundings (160 tried).
        again = lambda differentiate=differentiate: (differentiate(prediction, moved)[1]
                                                     for moved in rounding.anew(weights, tries=256))
        value, slope = differentiate(prediction, weights)
        yield cases.Check(f"perceptual_{name}/loss", value, PERCEPTUAL_TOLERANCES[0])
        yield cases.Check(f"perceptual_{name}/grad", slope, PERCEPTUAL_TOLERANCES[1], again=again)


def _feature_distance(features: Any, wanted: Any, measure: Callable[[jax.Array], jax.Array], style: bool) -> jax.Array:
    """The reference's other distances: sums over levels, of the maps and (style) of their Gram matrices, squared."""
    pairs = list(zip(features, wanted, strict=True))
    total = jnp.stack([measure(ours - theirs).mean() for ours, theirs in pairs]).sum()
    if style:
        total += jnp.stack([jnp.square(_gram(ours) - _gram(theirs)).mean() for ours, theirs in pairs]).sum()
    return total


def _gram(maps: jax.Array) -> jax.Array:
    flat = maps.reshape(maps.shape[0], -1, maps.shape[-1])
    return jnp.einsum("npc,npd->ncd", flat, flat) / (flat.shape[1] * flat.shape[2])


def perceptual_network(shape: tuple[int, ...]) -> tuple[resnet.ResNet18, Any]:
    """The frozen network of the perceptual loss and its drawn weights, for pictures [N, H, W, 3] of `shape`."""
    network = resnet.ResNet18(64, (1, 2, 3, 4))
    shapes = jax.eval_shape(lambda picture: network.init(jax.random.key(0), picture, drawing.EVAL),
                            jax.ShapeDtypeStruct(shape, jnp.float32))
    return network, drawing.draw_variables(shapes, "perceptual_loss.model.")


def perceptual_maps(network: resnet.ResNet18, weights: Any, picture: jax.Array) -> Any:
    """Maps of pictures [B, S, 3, H, W] in [0, 1]."""
    flat = _last(picture).reshape(-1, *picture.shape[3:], 3)
    mean, std = (jnp.asarray(value, jnp.float32).reshape(1, 1, 1, 3)
                 for value in (encoders.IMAGENET_MEAN, encoders.IMAGENET_STD))
    return network.apply(weights, (flat - mean) / std, drawing.EVAL)


def _pictures(context: cases.Context) -> tuple[np.ndarray, np.ndarray]:
    shape = context.shape("ssim/grad") or (2, 2, 3, *context.size("p1", "ssim_hw"))
    target, noise = (context.draw(name, shape, "smooth") for name in ("rgb_tgt", "rgb_pred"))
    return np.float32(0.7) * target + np.float32(0.3) * noise, target


GROUPS: tuple[cases.Group, ...] = (
    divergence, regressions, spatial, scene_class_affinity, voxel_classes, segmentation, structural_similarity,
    peak_signal_to_noise, chamfer, chamfer_metrics, class_scores, perceptual_distances)
