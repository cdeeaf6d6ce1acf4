"""Optional Chamfer term: worked arithmetic, undefined frames, keyed subsets, parity with the reference."""

import golden_rule
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.objectives import chamfer


def frames(*pixels):
    """Range view [1, 1, 1, W, 4] from (x, y, z, range) pixels."""
    return jnp.array(pixels, jnp.float32).reshape(1, 1, 1, -1, 4)


def sums_of(prediction, target, points=8, seed=0):
    return chamfer.chamfer_sums(prediction, target, jax.random.split(jax.random.key(seed), prediction.shape[:2]),
                                points=points, return_threshold_m=1.0, scale_m=50.0)


def test_worked_arithmetic():
    # Prediction {0, 3}, truth {0, 1} on the x axis, a hole on either side: (0 + 2) / 2 + (0 + 1) / 2 = 1.5 m
    prediction = frames((0, 0, 0, 9), (3, 0, 0, 9), (99, 0, 0, 0.5))
    target = frames((0, 0, 0, 9), (1, 0, 0, 9), (0, 0, 0, -1))
    np.testing.assert_allclose(sums_of(prediction, target).value(), 1.5 / 50, rtol=1e-6)


def test_frames_without_returns_do_not_count():
    hole, point = (0, 0, 0, -1), (5, 0, 0, 5)
    target = jnp.concatenate([frames(hole), frames(point)], axis=1)
    prediction = jnp.concatenate([frames((1, 0, 0, 2)), frames((6, 0, 0, 6))], axis=1)
    sums = sums_of(prediction, target)
    assert sums.count == 1
    np.testing.assert_allclose(sums.value(), 2 / 50, rtol=1e-6)
    gradient = jax.grad(lambda x: sums_of(x, target).value())(prediction)
    assert np.isfinite(gradient).all()
    assert float(sums_of(frames(hole), frames(hole)).value()) == 0.0


def test_subsets_are_keyed_and_drawn_from_returns():
    generator = np.random.default_rng(0)
    cloud = jnp.asarray(generator.normal(size=(1, 1, 8, 8, 4)), jnp.float32).at[..., 3].set(9.0)
    target = cloud.at[..., :4, :, :].set(jnp.array([0.0, 0.0, 0.0, -1.0]).reshape(1, 1, 1, 1, 4))
    value = lambda seed: float(sums_of(cloud, target, points=4, seed=seed).value())
    assert value(0) == value(0)
    assert value(0) != value(1)
    assert sums_of(cloud, target, points=4).count == 1


def test_parity_with_the_reference():
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    prediction, target = (jnp.asarray(30 * golden_rule.make_input(name, (2, 2, 400, 3), "pm1")
                                      * np.float32([1, 1, 0.2])) for name in ("cd_pred", "cd_tgt"))
    everything = jnp.ones(400, bool)

    def loss(prediction):
        distance, _ = jax.vmap(jax.vmap(lambda a, b: chamfer.frame_chamfer(a, everything, b, everything)))(
            prediction, target)
        return distance.mean()

    value, gradient = jax.value_and_grad(loss)(prediction)
    assert golden.error("cd_loss/loss", value) < 1e-5
    assert golden.error("cd_loss/grad", gradient) < 1e-4
