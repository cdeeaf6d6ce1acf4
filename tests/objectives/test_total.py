"""The sum of all terms: names, weights, checks, and independence of how the batch is split."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.objectives import total

MODEL = presets.tiny().model
LOSS = config_lib.LossConfig(chamfer=0.1, chamfer_points=8)
PREFIX = (4, 2)


def make_case(seed=0):
    """Predictions, batch, observation and keys with random content."""
    generator = np.random.default_rng(seed)
    uniform = lambda *shape: generator.random((*PREFIX, *shape)).astype(np.float32)
    rows, columns = MODEL.range_view.rows, MODEL.range_view.columns
    range_view = uniform(rows, columns, 4) * 20
    range_view[uniform(rows, columns) < 0.3] = (0, 0, 0, -1)
    batch = types.Batch(
        action=2 * uniform(2) - 1, is_first=np.zeros(PREFIX, bool),
        image=generator.integers(0, 256, (*PREFIX, *MODEL.image_size, 3), np.uint8), range_view=range_view,
        occupancy=generator.choice(np.array([0, 1, 255], np.uint8), (*PREFIX, *MODEL.voxels.shape)))
    predictions = types.Predictions({
        "image": {f: uniform(*(side // f for side in MODEL.image_size), 3) for f in (1, 2, 4)},
        "range_view": {f: 20 * uniform(rows // f, columns // f, 4) for f in (1, 2, 4)},
        "occupancy": {f: uniform(*(side // f for side in MODEL.voxels.shape), 2) for f in (1, 2, 4)},
        "action": {1: uniform(2)}})
    gaussian = lambda: types.Gaussian(uniform(8), 0.1 + uniform(8))
    state = types.LatentState(uniform(8), uniform(8))
    observed = types.Observed(state, gaussian(), gaussian())
    return *jax.tree.map(jnp.asarray, (predictions, batch, observed)), jax.random.split(jax.random.key(0), PREFIX[0])


def only(predictions, head):
    return types.Predictions({head: predictions.scales(head)})


@functools.partial(jax.jit, static_argnames=("model", "loss", "axis_name"))
def losses(case, model=MODEL, loss=LOSS, axis_name=None):
    predictions, batch, observed, keys = case
    return total.losses(predictions, batch, observed, model=model, loss=loss, keys=keys, axis_name=axis_name)


def test_every_term_is_named_and_weighted():
    terms = losses(make_case())
    scaled = ("image", "range_xyz", "range_depth", "occupancy_cross_entropy", "occupancy_semantic_scal",
              "occupancy_geometric_scal")
    assert set(terms) == {f"{name}_{f}" for name in scaled for f in (1, 2, 4)} | {"kl", "action", "chamfer_1", "total"}
    expected = terms["action"] + 1e-3 * terms["kl"] + 0.1 * terms["chamfer_1"] + sum(
        0.1 / f * terms[f"{name}_{f}"] for name in scaled for f in (1, 2, 4))
    np.testing.assert_allclose(terms["total"], expected, rtol=1e-5)


def test_a_weight_of_zero_leaves_the_term_out():
    terms = losses(make_case(), loss=dataclasses.replace(LOSS, chamfer=0.0, range_xyz=0.0, occupancy_cross_entropy=0.0))
    assert not [name for name in terms if name.startswith(("chamfer", "range_xyz", "occupancy_cross"))]


def test_heads_decide_which_terms_there_are():
    predictions, batch, observed, keys = make_case()
    model = dataclasses.replace(MODEL, heads=("image",))
    terms = losses((only(predictions, "image"), batch.replace(occupancy=None), observed, keys), model)
    assert set(terms) == {"image_1", "image_2", "image_4", "kl", "total"}


def test_a_perfect_prediction_costs_nothing_where_it_is_scored():
    predictions, batch, observed, keys = make_case()
    predictions |= types.Predictions({"range_view": {f: batch.range_view[..., ::f, ::f, :] for f in (1, 2, 4)},
                                      "action": {1: batch.action}})
    terms = losses((predictions, batch, observed.replace(prior=observed.posterior), keys))
    for name in ("range_xyz_1", "range_depth_2", "action"):
        assert terms[name] == 0.0
    np.testing.assert_allclose(terms["kl"], 0.0, atol=1e-6)


def test_reference_numerics_pulls_the_points_of_holes():
    predictions, batch, observed, keys = make_case()
    hole = batch.range_view[..., 3:] < 0
    filled = {f: jnp.where(hole, 7.0, batch.range_view)[..., ::f, ::f, :] for f in (1, 2, 4)}
    case = (predictions | types.Predictions({"range_view": filled}), batch, observed, keys)
    assert losses(case)["range_xyz_1"] == 0.0
    assert losses(case, dataclasses.replace(MODEL, numerics="reference"))["range_xyz_1"] > 0.0


def test_the_loss_does_not_depend_on_how_devices_share_the_batch():
    # Means of per-part values would differ: holes, unknown voxels and SCAL ratios are uneven.
    case = make_case()
    uneven = case[1].occupancy.at[0].set(255).at[1, 0].set(0)
    case = (case[0], case[1].replace(occupancy=uneven), *case[2:])
    parts = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), case)
    spread = jax.vmap(lambda part: losses(part, axis_name="parts"), axis_name="parts")(parts)
    whole = losses(case)
    for name, value in whole.items():
        np.testing.assert_allclose(spread[name], np.full(2, value), rtol=2e-5, err_msg=name)
    alone = jax.vmap(losses)(parts)
    assert abs(float(alone["occupancy_geometric_scal_1"].mean() - whole["occupancy_geometric_scal_1"])) > 1e-3


def test_a_missing_prediction_target_or_scale_is_named():
    predictions, batch, observed, keys = make_case()
    with pytest.raises(ValueError, match="head 'image', the predictions have"):
        losses((only(predictions, "action"), batch, observed, keys))
    with pytest.raises(ValueError, match="the batch has no occupancy"):
        losses((predictions, batch.replace(occupancy=None), observed, keys))
    with pytest.raises(ValueError, match=r"predicts scales \[1, 2\]"):
        losses((predictions | types.Predictions({"image": {f: predictions.scales("image")[f] for f in (1, 2)}}), batch,
                observed, keys))


def test_terms_and_weights_must_be_the_same_set():
    case = make_case()
    sums = total.loss_sums(*case[:3], model=MODEL, loss=LOSS, keys=case[3])
    weights = total.term_weights(LOSS, MODEL.heads)
    with pytest.raises(ValueError, match=r"computed but without a weight \['kl'\]"):
        total.combine(sums, {name: weight for name, weight in weights.items() if name != "kl"})
    with pytest.raises(ValueError, match=r"weighted but not computed \['depth'\]"):
        total.combine(sums, weights | {"depth": 1.0})
