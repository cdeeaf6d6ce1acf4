"""Terms of the optional heads on maps that can be worked out by hand; the parity files have the reference's numbers."""

import dataclasses

import golden_rule
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import types
from muvo_jax.interop import reference_preprocess
from muvo_jax.interop.parity import golden
from muvo_jax.nn import resnet
from muvo_jax.objectives import classification, instances, perceptual, similarity, total

MODEL, LOSS = config_lib.ModelConfig(), config_lib.LossConfig()
ROWS, COLUMNS = 8, 16


def values(head, predictions, loss=LOSS, axis_name=None, frozen=None, **fields):
    """{term: value} of one head for a batch of these fields."""
    lead = next(iter(fields.values())).shape[:2]
    batch = types.Batch(action=np.zeros((*lead, 2), np.float32), is_first=np.zeros(lead, bool), **fields)
    sums = head_lib.get(head).losses(head_lib.Learned(predictions, batch, MODEL, loss, None, frozen))
    sums = sums if axis_name is None else jax.lax.psum(sums, axis_name)
    return {term: value for name, part in sums.items() for term, value in part.terms(name).items()}


def test_cross_entropy_counts_weights_and_the_worst_pixels():
    logits = jnp.zeros((1, 1, 4, 2)).at[0, 0, 3].set(jnp.array([4.0, 0.0]))
    target = np.array([[[0, 1, 255, 1]]], np.uint8)
    worst = np.log1p(np.exp(4.0))  # class 1 where the logits say class 0
    mean = lambda **options: float(classification.cross_entropy_sums(logits, target, **options).value())
    np.testing.assert_allclose(mean(), (2 * np.log(2) + worst) / 3, rtol=1e-6)  # 255 does not count
    np.testing.assert_allclose(mean(weights=(1.0, 3.0)), (4 * np.log(2) + 3 * worst) / 3, rtol=1e-6)
    np.testing.assert_allclose(mean(top_share=0.25), worst, rtol=1e-6)
    with pytest.raises(ValueError, match="3 class weights for 2 classes"):
        mean(weights=(1.0, 1.0, 1.0))


def test_labels_that_are_no_class_do_not_count():
    logits = jax.random.normal(jax.random.key(0), (1, 1, 5, 4))
    score = jax.jit(jax.value_and_grad(
        lambda logits, target: classification.cross_entropy_sums(logits, target, weights=(1.0, 2.0, 3.0, 4.0)).value()))
    for target in (np.uint8([0, 4, 2, 254, 3]), np.int32([0, 4, 2, -1, 3])):
        unlabelled = np.where(target < 4, target, 255).astype(np.uint8)
        unlabelled[3] = 255
        expected = score(logits, unlabelled[None, None])
        assert all(np.isfinite(value).all() for value in jax.tree.leaves(expected))
        jax.tree.map(np.testing.assert_array_equal, score(logits, target[None, None]), expected)


def test_instances_have_a_centre_and_each_cell_knows_the_way(strict_dtypes):
    numbers = np.zeros((1, 6, 8), np.int32)
    numbers[0, 1:4, 2:5], numbers[0, 5, 7] = 1, 2
    centre, offset, inside = jax.jit(lambda numbers: instances.targets(numbers, 2.0))(numbers)
    assert centre[0, 2, 3, 0] == centre[0, 5, 7, 0] == 1.0
    np.testing.assert_allclose(centre[0, 2, 4, 0], np.exp(-1 / 4), rtol=1e-6)
    np.testing.assert_array_equal(offset[0, 1, 2], (1, 1))
    np.testing.assert_array_equal(offset[0, 5, 7], (0, 0))
    np.testing.assert_array_equal(inside, numbers > 0)


def test_structural_similarity_needs_pictures_as_large_as_its_window():
    picture = jax.random.uniform(jax.random.key(0), (2, 16, 20, 3))
    with pytest.raises(ValueError, match="at least 11 on a side"):
        similarity.frame_similarity(picture[:, :8], picture[:, :8])


def test_optional_heads_do_not_depend_on_how_devices_share_the_batch():
    random = np.random.default_rng(0)
    lead = (4, 1)
    maps = {"image_classes": random.integers(0, 3, (*lead, ROWS, COLUMNS)).astype(np.uint8),
            "birds_eye_classes": random.integers(0, 8, (*lead, ROWS, COLUMNS)).astype(np.uint8),
            "birds_eye_instances": random.integers(0, 3, (*lead, ROWS, COLUMNS)).astype(np.int32),
            "occupancy": random.integers(0, 2, (*lead, ROWS, COLUMNS, 4)).astype(np.uint8)}
    maps["image_classes"][0], maps["birds_eye_instances"][0] = 255, 0  # unevenly spread
    draw = lambda *shape: {f: random.normal(size=(*lead, *(side // f for side in shape[:-1]), shape[-1])
                                            ).astype(np.float32) for f in (1, 2, 4)}
    loss = dataclasses.replace(LOSS, occupancy_dice=0.1)
    case = ({"semantic_image": draw(ROWS, COLUMNS, 3), "birds_eye": draw(ROWS, COLUMNS, 11),
             "occupancy": draw(ROWS, COLUMNS, 4, 2)}, maps)

    def every(case, axis_name=None):
        predictions, maps = case
        fields = {"semantic_image": ("image_classes",), "birds_eye": ("birds_eye_classes", "birds_eye_instances"),
                  "occupancy": ("occupancy",)}
        return {term: value for head, names in fields.items()
                for term, value in values(head, predictions[head], loss, axis_name,
                                          **{name: maps[name] for name in names}).items()}

    whole = jax.jit(every)(case)
    assert set(whole) == {term for head in case[0] for term in head_lib.get(head).weights(loss)}
    parts = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), case)
    spread = jax.jit(jax.vmap(lambda part: every(part, "parts"), axis_name="parts"))(parts)
    for name, value in whole.items():
        np.testing.assert_allclose(spread[name], np.full(2, value), rtol=2e-5, err_msg=name)


def test_depth_is_learned_in_units_of_the_range_where_nothing_is_too():
    depth_m = np.full((1, 1, ROWS, COLUMNS), -1.0, np.float32)
    depth_m[0, 0, 0, 0] = 99.0
    predictions = {f: jnp.full((1, 1, ROWS // f, COLUMNS // f, 1), -1.0) for f in (1, 2, 4)}
    got = values("depth", predictions, depth_m=depth_m)
    np.testing.assert_allclose(got["depth_1"], 100.0 / 50.0 / (ROWS * COLUMNS), rtol=1e-6)


def test_image_terms_with_road_users_once_more_are_the_references():
    """Golden entries rgb_1, rgb_2, rgb_4 (RGB_INSTANCE): 0.1/f * (L1 + 0.5 * L1 where vehicles and pedestrians are)."""
    stored, draw = golden_rule.Golden("p5_losses_all_1d.npz"), golden.Settings(golden_rule.FOLDER).draw
    image = reference_preprocess.crop(draw("full_image", (1, 2, 3, 600, 960), "image_u8"))
    mask = reference_preprocess.crop(draw("pre_imask", (1, 2, 1, 600, 960), "mask"))[:, :, 0]
    predictions = {f: np.moveaxis(draw(f"o_rgb_{f}", (1, 2, 3, 320 // f, 832 // f), "smooth"), 2, -1)
                   for f in (1, 2, 4)}
    batch = types.Batch(action=np.zeros((1, 2, 2), np.float32), is_first=np.zeros((1, 2), bool),
                        image=np.moveaxis(image, 2, -1), image_instance_mask=mask)
    gaussian = types.Gaussian(jnp.zeros((1, 2, 4)), jnp.ones((1, 2, 4)))
    observed = types.Observed(types.LatentState(gaussian.mean, gaussian.mean), gaussian, gaussian)
    model = dataclasses.replace(MODEL, heads=("image",))
    loss = dataclasses.replace(LOSS, image=0.1, image_instance=0.05)
    predicted = types.Predictions({"image": predictions})
    keys = jax.random.split(jax.random.key(0), 1)
    every = lambda batch: total.losses(predicted, batch, observed, model=model, loss=loss, keys=keys)
    got, expected = jax.jit(every)(batch), 0.0
    for f in (1, 2, 4):
        rgb = (0.1 * got[f"image_{f}"] + 0.05 * got[f"image_instance_{f}"]) / f
        assert stored.error(f"loss/rgb_{f}", rgb) < 1e-5
        expected += rgb
    np.testing.assert_allclose(got["total"], expected, rtol=1e-6)
    with pytest.raises(ValueError, match=r"loss\.image_instance is on, but the batch has no image_instance_mask"):
        every(batch.replace(image_instance_mask=None))


def test_the_perceptual_term_needs_a_frozen_network_and_vanishes_for_equal_pictures():
    image = np.random.default_rng(1).integers(0, 256, (1, 1, 32, 32, 3)).astype(np.uint8)
    loss = dataclasses.replace(LOSS, image_perceptual=0.1)
    exact = {f: jnp.asarray(image.reshape(1, 1, 32 // f, f, 32 // f, f, 3).mean(axis=(3, 5)) / 255.0, jnp.float32)
             for f in (1, 2, 4)}
    with pytest.raises(ValueError, match="--perceptual-from=RUN"):
        values("image", exact, loss, image=image)
    network = resnet.ResNet18(4, (1, 2))
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), jnp.zeros((1, 32, 32, 3)), perceptual.norm.Mode()))
    weights = jax.tree.map(lambda leaf: np.full(leaf.shape, 0.1, np.float32), shapes)
    frozen = perceptual.FrozenEncoder(network, weights, "made up")
    term = jax.jit(lambda picture: values("image", picture, loss, frozen=frozen, image=image)["image_perceptual_1"])
    assert term(exact) < 1e-8 < term({f: 0.5 * picture for f, picture in exact.items()})
