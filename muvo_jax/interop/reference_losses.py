"""Terms of the reference as it takes and reduces them, and its metrics of occupancy by class, for parity.

Class logits are [..., classes] with integer targets [...]; pictures are [N, H, W, C] in [0, 1].
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.objectives import classification, perceptual, similarity

IGNORED = 255
_LOG_FLOOR = -100.0


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
    return classification.cross_entropy_sums(
        logits[None], target[None], weights=weights or (), top_share=1.0 if top_share is None else top_share,
        poly=poly).value()


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
    return classification.dice_sums(filled, truth, epsilon=epsilon, naive=naive).value()


ssim_window = similarity.window


def ssim(prediction: jax.Array, target: jax.Array, *, non_negative: bool = False) -> jax.Array:
    """Structural similarity of pictures [N, H, W, C] and channels, averaged; non_negative: negative ones count as 0."""
    each = similarity.frame_similarity(prediction, target)
    return (jax.nn.relu(each) if non_negative else each).mean()


feature_distance = perceptual.feature_distance


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
