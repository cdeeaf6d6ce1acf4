"""Occupancy terms: worked arithmetic, degenerate grids, parity with the reference."""

import chex
import golden_rule
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax.objectives import scal

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def logits_of(probability):
    """Logits (empty, occupied) whose softmax gives these probabilities of "occupied"."""
    probability = jnp.asarray(probability, jnp.float32)
    return jnp.stack([jnp.log1p(-probability), jnp.log(probability)], axis=-1)


def test_worked_arithmetic():
    # Voxels: occupied at 0.8, occupied at 0.4, empty at 0.2, unknown at 0.9.
    sums = scal.occupancy_sums(logits_of([0.8, 0.4, 0.2, 0.9]), jnp.array([1, 1, 0, 255], jnp.uint8))
    np.testing.assert_allclose([sums.true_occupied, sums.false_occupied, sums.true_empty, sums.false_empty],
                               [1.2, 0.2, 0.8, 0.8], rtol=1e-5)
    # precision 1.2 / 1.4, recall 1.2 / 2, specificity 0.8 / 1
    geometric = -np.log(1.2 / 1.4) - np.log(0.6) - np.log(0.8)
    np.testing.assert_allclose(scal.geometric_scal(sums), geometric, rtol=1e-5)
    # of "empty": precision 0.8 / 1.6, recall 0.8 / 1, specificity 1.2 / 2
    empty = -np.log(0.5) - np.log(0.8) - np.log(0.6)
    np.testing.assert_allclose(scal.semantic_scal(sums), (geometric + empty) / 2, rtol=1e-5)
    np.testing.assert_allclose(scal.cross_entropy(sums), -(np.log(0.8) + np.log(0.4) + np.log(0.8)) / 3, rtol=1e-5)


def test_unknown_counts_as_empty_where_asked():
    logits = logits_of([0.8, 0.4, 0.2, 0.9])
    as_empty = scal.occupancy_sums(logits, jnp.array([1, 1, 0, 255], jnp.uint8), True)
    chex.assert_trees_all_close(as_empty, scal.occupancy_sums(logits, jnp.array([1, 1, 0, 0], jnp.uint8)))


@pytest.mark.parametrize("value", [0, 1, 255])
@pytest.mark.parametrize("margin", [0.0, 200.0, -200.0])
def test_grids_of_one_kind_stay_finite(value, margin):
    target = jnp.full((5,), value, jnp.uint8)
    logits = jnp.stack([jnp.zeros(5), jnp.full((5,), margin)], axis=-1)

    def every_term(x):
        sums = scal.occupancy_sums(x, target)
        return jnp.stack([scal.cross_entropy(sums), scal.semantic_scal(sums), scal.geometric_scal(sums)])

    chex.assert_tree_all_finite((every_term(logits), jax.jacobian(every_term)(logits)))
    if value == 255:
        np.testing.assert_array_equal(every_term(logits), np.zeros(3))


def test_no_ratio_without_denominator():
    # All empty, p = 0.3: class empty has precision 1 and recall 0.7, no specificity; "not empty" has specificity 0.7
    # and precision 0, whose logarithm is held at -100.
    sums = scal.occupancy_sums(logits_of([0.3, 0.3]), jnp.zeros(2, jnp.uint8))
    np.testing.assert_allclose(scal.semantic_scal(sums), -np.log(0.7), rtol=1e-5)
    np.testing.assert_allclose(scal.geometric_scal(sums), 100.0 - np.log(0.7), rtol=1e-5)


def test_sums_of_parts_add_up_to_the_whole():
    key = jax.random.key(0)
    logits = jax.random.normal(key, (6, 4, 4, 2))
    target = jax.random.choice(key, jnp.array([0, 1, 255], jnp.uint8), (6, 4, 4))
    whole = scal.occupancy_sums(logits, target)
    parts = [scal.occupancy_sums(logits[i:i + 2], target[i:i + 2]) for i in (0, 2, 4)]
    chex.assert_trees_all_close(jax.tree.map(lambda *leaves: sum(leaves), *parts), whole, rtol=1e-5)


@pytest.mark.parametrize("entry, finish, kind", [
    ("sem_scal_c2", scal.semantic_scal, "voxel2"), ("sem_scal_c2_ign", scal.semantic_scal, "voxel2_ign"),
    ("sem_scal_c2_allempty", scal.semantic_scal, None), ("geo_scal_c2", scal.geometric_scal, "voxel2"),
    ("geo_scal_c2_ign", scal.geometric_scal, "voxel2_ign"), ("voxel_ce_c2_plain", scal.cross_entropy, "voxel2")])
def test_parity_with_the_reference(entry, finish, kind):
    golden = golden_rule.Golden("p1_losses_metrics.npz")
    prediction = 3 * golden_rule.make_input("vox_pred2", (1, 2, 2, 24, 24, 8), "pm1")
    shape = (1, 2, 1, 24, 24, 8)
    target = golden_rule.make_input("vox_tgt2", shape, kind) if kind else np.zeros(shape, np.uint8)
    loss, gradient = jax.value_and_grad(lambda x: finish(scal.occupancy_sums(x, jnp.asarray(target[:, :, 0]))))(
        jnp.moveaxis(jnp.asarray(prediction), 2, -1))
    assert golden.error(entry + "/loss", loss) < 1e-5
    assert golden.error(entry + "/grad", np.moveaxis(gradient, -1, 2)) < 1e-4
