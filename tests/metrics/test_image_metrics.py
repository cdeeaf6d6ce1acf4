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


def test_frames_are_averaged_in_decibels():
    # mse 1e-2 and 1e-4: the mean of 20 and 40 dB is 30, that of the pooled mse would be 23.
    stream = streaming.StreamingMean.zeros(1).add(np.array([[20.0]])).add(np.array([[40.0]]))
    assert stream.overall() == 30.0


def test_streaming_keeps_steps_apart_and_counts_undefined():
    stream = streaming.StreamingMean.zeros(2).add(np.array([[1.0, np.nan], [3.0, np.nan]]))
    np.testing.assert_array_equal(stream.per_step(), [2.0, np.nan])
    np.testing.assert_array_equal(stream.count, [2, 0])
    np.testing.assert_array_equal(stream.undefined, [0, 2])
    assert stream.overall() == 2.0
    assert np.isnan(streaming.StreamingMean.zeros(3).overall())


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    target, noise = (np.moveaxis(golden_rule.make_input(name, (2, 2, 3, 32, 44), "smooth"), 2, -1)
                     for name in ("rgb_tgt", "rgb_pred"))
    first = image.frame_psnr_db(0.7 * target + 0.3 * noise, target)
    assert golden.error("psnr_per_frame", first) < 1e-5
    assert golden.error("metric_psnr_1batch", first.mean()) < 1e-5
    second = image.frame_psnr_db(0.9 * target, target)
    stream = streaming.StreamingMean.zeros(2).add(first).add(second)
    assert golden.error("metric_psnr_2batches", stream.overall()) < 1e-5
