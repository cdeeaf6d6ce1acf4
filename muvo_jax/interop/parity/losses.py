"""Pack p1_losses_metrics: losses with their gradients, and metrics.

Inputs are drawn in torch's layout; the gradient is taken with respect to the input in that layout, so that the change
of layout is part of what is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import types
from muvo_jax.interop.parity import cases
from muvo_jax.metrics import image as image_metrics
from muvo_jax.objectives import kl, regression, scal
from muvo_jax.ops import nearest

LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 1e-4
IGNORED = 255
Checks = Iterator[cases.Check]


def _last(array: Any, axis: int = 2) -> jax.Array:
    """[..., C, *S] with C at `axis` -> [..., *S, C]"""
    return jnp.moveaxis(jnp.asarray(array), axis, -1)


def _loss(name: str, function: Callable[..., jax.Array], *args: np.ndarray, gradients: tuple[str, ...] = ("grad",),
          tolerances: tuple[float, float] = (LOSS_TOLERANCE, GRADIENT_TOLERANCE)) -> Checks:
    """Value and gradients of function(*args), one gradient for each of the first arguments."""
    arrays = [jnp.asarray(arg) for arg in args]
    value, slopes = jax.jit(jax.value_and_grad(function, argnums=tuple(range(len(gradients)))))(*arrays)
    yield cases.Check(f"{name}/loss", value, tolerances[0])
    for gradient, slope in zip(gradients, slopes, strict=True):
        yield cases.Check(f"{name}/{gradient}", slope, tolerances[1])


def divergence(context: cases.Context) -> Checks:
    """Balanced and plain Kullback-Leibler divergence with the reference's rule for the first step."""
    gradients = ("grad_posterior_mu", "grad_posterior_sigma", "grad_prior_mu", "grad_prior_sigma")
    for tag in ("1d", "2d"):
        shape = context.settings.size("p1", f"kl_{tag}")
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
    for name, prefix, shape in (("regression", "act", context.settings.size("p1", "regression")),
                                ("regression_c4", "reg3", context.settings.size("p1", "regression_c4"))):
        prediction, target = (context.draw(f"{prefix}_{side}", shape, "pm1") for side in ("pred", "tgt"))
        for norm, sums in (("l1", regression.l1_sums), ("l2", regression.l2_sums)):
            yield from _loss(f"{name}_{norm}", lambda prediction, target, sums=sums: sums(prediction, target).value(),
                             prediction, target)


def spatial(context: cases.Context) -> Checks:
    """Regression of maps; a pixel is ignored where the target's first channel is 255, or outside an instance mask."""
    size = context.settings.size("p1", "spatial_hw")
    prediction, target = (context.draw(f"sp_{side}", (2, 2, 3, *size), "normal") for side in ("pred", "tgt"))
    masks = {kind: context.draw(f"sp_{drawn}", (2, 2, 1, *size), "mask")[:, :, 0]
             for kind, drawn in (("ignore", "ign"), ("imask", "imask"))}
    kept = {"": None, "_ignore": ~masks["ignore"], "_imask": masks["imask"]}
    for norm, sums in (("l1", regression.l1_sums), ("l2", regression.l2_sums)):
        for suffix, mask in kept.items():
            def value(prediction, target, sums=sums, mask=mask):
                return sums(_last(prediction), _last(target), mask).value()

            yield from _loss(f"spatial_{norm}{suffix}", value, prediction, target)
    nothing = regression.l1_sums(_last(prediction), _last(target), np.zeros_like(masks["ignore"])).value()
    yield cases.Check("spatial_l1_allignored/loss", nothing, LOSS_TOLERANCE)


def scene_class_affinity(context: cases.Context) -> Checks:
    batch, frames, *grid = context.settings.size("p1", "voxel_bsxyz")
    logits = 3 * context.draw("vox_pred2", (batch, frames, 2, *grid), "pm1")
    sums = lambda logits, target: scal.occupancy_sums(_last(logits), target[:, :, 0])
    for suffix, kind in (("", "voxel2"), ("_ign", "voxel2_ign")):
        target = context.draw("vox_tgt2", (batch, frames, 1, *grid), kind)
        yield from _loss(f"sem_scal_c2{suffix}", lambda *args: scal.semantic_scal(sums(*args)), logits, target)
        yield from _loss(f"geo_scal_c2{suffix}", lambda *args: scal.geometric_scal(sums(*args)), logits, target)
    empty = np.zeros((batch, frames, 1, *grid), np.uint8)
    yield from _loss("sem_scal_c2_allempty", lambda *args: scal.semantic_scal(sums(*args)), logits, empty)


def chamfer(context: cases.Context) -> Checks:
    points = context.settings.size("p1", "chamfer_points")
    squashed = np.array([30.0, 30.0, 6.0], np.float32)
    prediction, target = (context.draw(f"cd_{side}", (2, 2, points, 3), "pm1") * squashed for side in ("pred", "tgt"))

    def value(prediction, target):
        flat = lambda clouds: clouds.reshape(-1, points, 3)
        return 2.0 * jax.vmap(nearest.chamfer)(flat(prediction), flat(target)).mean()

    yield from _loss("cd_loss", value, prediction, target)


def peak_signal_to_noise(context: cases.Context) -> Checks:
    prediction, target = _pictures(context)
    psnr = lambda *images: np.asarray(image_metrics.frame_psnr_db(*(_last(image) for image in images)))
    first, second = psnr(prediction, target), psnr(np.float32(0.9) * target, target)
    yield cases.Check("psnr_per_frame", first, LOSS_TOLERANCE)
    yield cases.Check("metric_psnr_1batch", first.mean(), LOSS_TOLERANCE)
    yield cases.Check("metric_psnr_2batches", (first.mean() + second.mean()) / 2, LOSS_TOLERANCE)


def _pictures(context: cases.Context) -> tuple[np.ndarray, np.ndarray]:
    size = context.settings.size("p1", "ssim_hw")
    target, noise = (context.draw(name, (2, 2, 3, *size), "smooth") for name in ("rgb_tgt", "rgb_pred"))
    return np.float32(0.7) * target + np.float32(0.3) * noise, target


GROUPS: tuple[cases.Group, ...] = (divergence, regressions, spatial, scene_class_affinity, chamfer,
                                   peak_signal_to_noise)
