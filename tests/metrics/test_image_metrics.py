"""PSNR: worked arithmetic, streaming, parity with the reference."""

import golden_rule
import jax.numpy as jnp
import numpy as np

from muvo_jax.metrics import image, streaming


def test_worked_arithmetic():
    # An error of 0.1 everywhere: mse 0.01, 20 dB. Of 0.01: 40 dB.
    target = jnp.zeros((2, 4, 4, 3))
    prediction = jnp.stack([jnp.full((4, 4, 3), 0.1), jnp.full((4, 4, 3), 0.01)])
    np.testing.assert_allclose(image.frame_psnr_db(prediction, target), [20.0, 40.0], rtol=1e-5)


def test_bytes_are_scaled_and_identity_is_capped():
    target = np.full((1, 2, 2, 3), 51, np.uint8)
    np.testing.assert_allclose(image.frame_psnr_db(jnp.full((1, 2, 2, 3), 0.3), target), [20.0], rtol=1e-4)
    assert image.frame_psnr_db(target.astype(np.float32) / 255, target)[0] == image.PSNR_LIMIT_DB


def mean_of(*values):
    """What is reported of values [B, H] fed one after the other."""
    sums = streaming.DriveSums()
    for part in values:
        sums.add(("",) * len(part), streaming.mean_sums(part))
    return streaming.summary(sums, streaming.mean, 0)["mean"]


def test_frames_are_averaged_in_decibels():
    # mse 1e-2 and 1e-4: the mean of 20 and 40 dB is 30, that of the pooled mse would be 23.
    assert mean_of(np.array([[20.0]]), np.array([[40.0]])) == 30.0


def test_the_pixels_of_a_mask_are_pooled_over_frames():
    """One frame shows one such pixel, mse 1e-2, the other three, mse 1e-4: 10 log10 of 4 / (1e-2 + 3e-4)."""
    target, mask = np.zeros((1, 2, 2, 2, 3), np.uint8), np.array([[[[1, 0], [0, 0]], [[1, 1], [1, 0]]]], bool)
    prediction = np.stack([np.full((2, 2, 3), value, np.float32) for value in (0.1, 0.01)])[None]
    sums = {name: value.sum() for name, value in image.masked_sums(prediction, target, mask).items()}
    np.testing.assert_allclose(image.masked_psnr_db(sums), 10 * np.log10(4 / (1e-2 + 3e-4)), rtol=1e-5)
    assert np.isnan(image.masked_psnr_db({"error": np.float64(0), "pixels": np.int64(0)}))


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    target, noise = (np.moveaxis(golden_rule.make_input(name, (2, 2, 3, 32, 44), "smooth"), 2, -1)
                     for name in ("rgb_tgt", "rgb_pred"))
    first = image.frame_psnr_db(0.7 * target + 0.3 * noise, target)
    assert golden.error("psnr_per_frame", first) < 1e-5
    assert golden.error("metric_psnr_1batch", first.mean()) < 1e-5
    second = image.frame_psnr_db(0.9 * target, target)
    assert golden.error("metric_psnr_2batches", mean_of(first, second)) < 1e-5
