"""Terms of the reference for heads that no default trains, and its metrics of occupancy by class, for parity.

Class logits are [..., classes] with integer targets [...]; pictures are [N, H, W, C] in [0, 1].
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

IGNORED = 255
_LOG_FLOOR = -100.0
_SSIM_SIZE, _SSIM_SIGMA, _SSIM_C1, _SSIM_C2 = 11, 1.5, 0.01 ** 2, 0.03 ** 2


def cross_entropy(logits: jax.Array, target: jax.Array, *, weights: tuple[float, ...] | None = None,
                  top_share: float | None = None, poly: float = 0.0) -> jax.Array:
    """Mean cross-entropy over pixels, not divided by the weights' sum.

    Args:
      logits: [F, P, classes], F frames of P pixels.
      target: int [F, P].
      weights: of each class.
      top_share: of each frame only the int(share * P) largest losses count.
      poly: adds poly * (1 - exp(-loss)) to each pixel's unweighted loss.
    """
    logarithm = jax.nn.log_softmax(logits, axis=-1)
    loss = -jnp.take_along_axis(logarithm, target.astype(jnp.int32)[..., None], axis=-1)[..., 0]
    if weights is not None:
        loss = loss * jnp.asarray(weights, loss.dtype)[target.astype(jnp.int32)]
    if poly:
        loss = loss + poly * (1.0 - jnp.exp(-loss))
    if top_share is not None:
        loss, _ = jax.lax.top_k(loss, int(top_share * loss.shape[1]))
    return loss.mean()


def semantic_scal(logits: jax.Array, target: jax.Array) -> jax.Array:
    """MonoScene's class affinity: the three ratios of each class that occurs, averaged over these classes."""
    known = target != IGNORED
    probabilities = jax.nn.softmax(logits, axis=-1) * known[..., None]
    terms, present = [], []
    for index in range(logits.shape[-1]):
        is_class = (target == index) & known
        terms.append(_affinity(probabilities[..., index], is_class, known))
        present.append(jnp.any(is_class).astype(jnp.float32))
    weight = jnp.stack(present)
    return (jnp.stack(terms) * weight).sum() / jnp.maximum(weight.sum(), 1.0)


def geometric_scal(logits: jax.Array, target: jax.Array) -> jax.Array:
    """The three ratios once, for "not empty" (class 0 is empty)."""
    known = target != IGNORED
    filled = 1.0 - jax.nn.softmax(logits, axis=-1)[..., 0]
    return _affinity(filled * known, (target != 0) & known, known)


def _affinity(probability: jax.Array, is_class: jax.Array, known: jax.Array) -> jax.Array:
    hit = jnp.where(is_class, probability, 0.0).sum()
    rejected = jnp.where(known & ~is_class, 1.0 - probability, 0.0).sum()
    ratios = ((hit, probability.sum()), (hit, is_class.sum()), (rejected, (known & ~is_class).sum()))
    return sum((_negative_log_ratio(part, whole) for part, whole in ratios), jnp.float32(0.0))


def _negative_log_ratio(part: jax.Array, whole: jax.Array) -> jax.Array:
    defined = whole > 0
    ratio = part / jnp.where(defined, whole, 1)
    positive = ratio > 0.0
    logarithm = jnp.where(positive, jnp.log(jnp.where(positive, ratio, 1.0)), _LOG_FLOOR)
    return jnp.where(defined, -jnp.maximum(logarithm, _LOG_FLOOR), 0.0)


def dice(logits: jax.Array, target: jax.Array, *, epsilon: float, naive: bool) -> jax.Array:
    """1 - Dice coefficient of "not empty", mean over frames of logits [F, P, classes]; naive: sums, not squares."""
    filled, truth = 1.0 - jax.nn.softmax(logits, axis=-1)[..., 0], (target != 0).astype(logits.dtype)
    both = 2.0 * (filled * truth).sum(axis=1)
    if naive:
        return (1.0 - (both + epsilon) / (filled.sum(axis=1) + truth.sum(axis=1) + epsilon)).mean()
    squares = jnp.square(filled).sum(axis=1) + jnp.square(truth).sum(axis=1) + 2.0 * epsilon
    return (1.0 - both / squares).mean()


def ssim_window() -> np.ndarray:
    """float32 [11, 11]: the Gaussian over which structural similarity compares pictures."""
    offset = np.arange(_SSIM_SIZE) - _SSIM_SIZE // 2
    line = np.exp(-np.square(offset) / (2 * _SSIM_SIGMA ** 2)).astype(np.float32)
    line /= line.sum()
    return np.outer(line, line)


def ssim(prediction: jax.Array, target: jax.Array, *, non_negative: bool = False) -> jax.Array:
    """Structural similarity of each picture, averaged (Wang et al., 2004): pictures [N, H, W, C] -> scalar."""
    line = jnp.asarray(ssim_window().sum(axis=0))

    def blur(image: jax.Array) -> jax.Array:
        for axis in (1, 2):
            count = image.shape[axis] - _SSIM_SIZE + 1
            image = sum((line[tap] * jax.lax.slice_in_dim(image, tap, tap + count, axis=axis)
                         for tap in range(_SSIM_SIZE)), jnp.float32(0.0))
        return image

    mean_p, mean_t = blur(prediction), blur(target)
    # Variances do not depend on an offset; about the middle of [0, 1] their differences cancel less.
    from_p, from_t, about_p, about_t = prediction - 0.5, target - 0.5, mean_p - 0.5, mean_t - 0.5
    var_p = blur(from_p * from_p) - about_p * about_p
    var_t = blur(from_t * from_t) - about_t * about_t
    covariance = blur(from_p * from_t) - about_p * about_t
    contrast = (2.0 * covariance + _SSIM_C2) / (var_p + var_t + _SSIM_C2)
    similarity = (2.0 * mean_p * mean_t + _SSIM_C1) / (mean_p ** 2 + mean_t ** 2 + _SSIM_C1) * contrast
    each = similarity.mean(axis=(1, 2))
    return (jax.nn.relu(each) if non_negative else each).mean()


def feature_distance(features: list[jax.Array], targets: list[jax.Array], *, norm: str, style: bool) -> jax.Array:
    """Sum over levels of the mean squared ("l2") or absolute ("l1") difference of maps, and of their Gram matrices."""
    measure = {"l1": jnp.abs, "l2": jnp.square}[norm]
    pairs = list(zip(features, targets, strict=True))
    total = jnp.stack([measure(ours - theirs).mean() for ours, theirs in pairs]).sum()
    if style:
        total += jnp.stack([jnp.square(_gram(ours) - _gram(theirs)).mean() for ours, theirs in pairs]).sum()
    return total


def _gram(maps: jax.Array) -> jax.Array:
    flat = maps.reshape(maps.shape[0], -1, maps.shape[-1])
    return jnp.einsum("npc,npd->ncd", flat, flat) / (flat.shape[1] * flat.shape[2])


def class_counts(prediction: np.ndarray, truth: np.ndarray, classes: int,
                 counted: np.ndarray | None = None) -> np.ndarray:
    """int64 [1 + classes, 3]: true positives, false positives, false negatives of "not empty" and of each class.

    Args:
      prediction, truth: integers of one shape; what is 255 in the truth does not count.
      counted: bool of that shape, what counts; None for everything.
    """
    mask = truth != IGNORED if counted is None else (truth != IGNORED) & counted
    prediction, truth = prediction[mask], truth[mask]
    pairs = [(prediction > 0, truth > 0)] + [(prediction == index, truth == index) for index in range(classes)]
    return np.array([[(ours & theirs).sum(), (ours & ~theirs).sum(), (~ours & theirs).sum()]
                     for ours, theirs in pairs])


def class_scores(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(precision, recall, IoU of "not empty", mean IoU of classes 1 and up), and the IoU of every class."""
    hit, false, missed = counts.astype(np.float64).T
    each = hit[1:] / (hit[1:] + false[1:] + missed[1:] + 1e-5)
    overall = (hit[0] / (hit[0] + false[0]), hit[0] / (hit[0] + missed[0]), hit[0] / counts[0].sum())
    return np.array([*overall, each[1:].mean()]), each
