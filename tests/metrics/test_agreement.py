"""Scores agree with those of the libraries that everybody compares with: scikit-image, SciPy, scikit-learn."""

import numpy as np
import pytest
from scipy import spatial
from skimage import metrics as image_metrics
from sklearn import metrics as class_metrics

from muvo_jax.metrics import image, occupancy, points
from muvo_jax.objectives import similarity

TOLERANCE = 1e-5


def pictures(seed, noise):
    """uint8 truth [2, 3, 32, 48, 3] of soft blobs, and a prediction in [0, 1] beside it."""
    generator = np.random.default_rng(seed)
    coarse = generator.uniform(0.0, 1.0, (2, 3, 8, 12, 3)).repeat(4, axis=2).repeat(4, axis=3)
    truth = (255.0 * coarse).round().astype(np.uint8)
    return np.clip(coarse + generator.normal(0.0, noise, coarse.shape), 0.0, 1.0).astype(np.float32), truth


@pytest.mark.parametrize("noise", [0.005, 0.05, 0.4])
def test_psnr_of_scikit_image(noise):
    prediction, truth = pictures(0, noise)
    found = np.asarray(image.frame_psnr_db(prediction, truth))
    expected = [[image_metrics.peak_signal_noise_ratio(one_truth / 255.0, one.astype(np.float64), data_range=1.0)
                 for one, one_truth in zip(*pair, strict=True)] for pair in zip(prediction, truth, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=TOLERANCE)


@pytest.mark.parametrize("noise", [0.005, 0.05, 0.4])
def test_structural_similarity_of_scikit_image(noise):
    """With the Gaussian window and the population's moments of Wang et al.; scikit-image's default is another."""
    prediction, truth = pictures(1, noise)
    target = (truth / 255.0).astype(np.float32)
    found = np.asarray(similarity.frame_similarity(prediction[0], target[0]))
    expected = [[image_metrics.structural_similarity(
        one_truth[..., channel].astype(np.float64), one[..., channel].astype(np.float64), data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False) for channel in range(3)]
        for one, one_truth in zip(prediction[0], target[0], strict=True)]
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)


def test_chamfer_of_nearest_neighbours():
    """SciPy's k-d trees on the returns alone, and scikit-learn's distances of every pair, without any tree."""
    generator = np.random.default_rng(2)
    prediction, truth = (generator.normal(0.0, 10.0, (1, 2, 16, 32, 4)).astype(np.float32) for _ in range(2))
    found = points.frame_chamfer_m(prediction, truth, return_threshold_m=1.0, points=0, seed=(0,))
    for step in range(2):
        clouds = [view[0, step][view[0, step, ..., 3] > above_m][:, :3].astype(np.float64)
                  for view, above_m in ((prediction, 1.0), (truth, 0.0))]
        ways = [(clouds[0], clouds[1]), (clouds[1], clouds[0])]
        by_trees = [spatial.cKDTree(targets).query(queries)[0].mean() for queries, targets in ways]
        by_pairs = [class_metrics.pairwise_distances(queries, targets).min(axis=1).mean() for queries, targets in ways]
        assert found[0, step] == pytest.approx(sum(by_trees) / 2, rel=TOLERANCE)
        assert found[0, step] == pytest.approx(sum(by_pairs) / 2, rel=TOLERANCE)


@pytest.mark.parametrize("unknown_is_empty", [False, True])
def test_voxel_scores_of_scikit_learn(unknown_is_empty):
    generator = np.random.default_rng(3)
    target = generator.choice(np.array([0, 1, 255], np.uint8), (2, 3, 8, 8, 4), p=[0.5, 0.2, 0.3])
    occupied = np.where(generator.random(target.shape) < 0.7, target == 1, generator.random(target.shape) < 0.3)
    sums = {name: value.sum() for name, value in occupancy.counts(
        occupied, target, unknown_is_empty=unknown_is_empty).items()}
    counted = np.ones(target.shape, bool) if unknown_is_empty else target != 255
    labels = (target == 1)[counted], occupied[counted]
    expected = {"iou_occ": class_metrics.jaccard_score(*labels),
                "iou_empty": class_metrics.jaccard_score(*labels, pos_label=False),
                "precision": class_metrics.precision_score(*labels), "recall": class_metrics.recall_score(*labels)}
    for name, score in occupancy.SCORES.items():
        assert float(score(sums)) == pytest.approx(expected[name], rel=TOLERANCE)
