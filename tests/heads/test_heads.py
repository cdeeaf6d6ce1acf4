"""The heads of the package: whole, and without names that collide."""

import collections
import dataclasses

import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import head as head_lib
from muvo_jax import presets, types
from muvo_jax.viz import sheets

MODEL, LOSS = presets.tiny().model, config_lib.LossConfig()


def test_every_head_is_whole():
    fields = {field.name for field in dataclasses.fields(types.Batch)}
    shapes = dict[str, tuple[int, ...]]()
    for name in config_lib.KNOWN_HEADS:
        head = head_lib.get(name)
        assert head.learns_from(MODEL, dataclasses.replace(LOSS, image_instance=1.0)).keys() <= fields
        assert head.weights(LOSS) and all(isinstance(weight, float) for weight in head.weights(LOSS).values())
        assert head.tokens in ("image", "range_view", "occupancy", "action", None)
        shapes |= head.targets(MODEL)
        if head.frames is not None:
            assert head.frames.field in fields
            assert all(picture.view in sheets.VIEWS and set(picture.legend) <= set(sheets.LEGEND)
                       for picture in head.frames.pictures)
    assert shapes["image"] == (*MODEL.image_size, 3) and shapes["reward"] == ()


@pytest.mark.parametrize("names", [
    lambda head: head.weights(LOSS), lambda head: head.frames.metrics if head.frames else (),
    lambda head: [metric.logged for metric in head.frames.metrics.values() if metric.logged] if head.frames else (),
    lambda head: [picture.name for picture in head.frames.pictures] if head.frames else ()])
def test_no_two_heads_share_a_term_a_metric_or_a_picture(names):
    counted = collections.Counter(name for head in config_lib.KNOWN_HEADS for name in names(head_lib.get(head)))
    assert max(counted.values()) == 1


def test_a_weight_is_that_of_the_config_over_the_scale():
    weights = head_lib.get("image").weights(dataclasses.replace(LOSS, image=0.5, image_instance=0.2))
    assert (weights["image_1"], weights["image_4"], weights["image_instance_2"]) == (0.5, 0.125, 0.1)
    assert head_lib.get("continue").weights(dataclasses.replace(LOSS, continue_=3.0)) == {"continue": 3.0}


def test_decoded_maps_become_what_a_recording_holds():
    logits = np.zeros((1, 1, 2, 2, 11), np.float32)
    logits[0, 0, 1, 0, 5], logits[..., 10] = 3.0, 9.0  # a centre is no class
    classes = head_lib.shown(("birds_eye",))["birds_eye"].of(logits, MODEL)
    assert classes.dtype == np.uint8
    np.testing.assert_array_equal(classes[0, 0], [[0, 0], [5, 0]])
    assert head_lib.shown(("depth",))["depth"].of(np.full((1, 1, 2, 2, 1), 7.0), MODEL).shape == (1, 1, 2, 2)


def test_settings_of_one_term_alone_ask_for_its_field():
    image = head_lib.get("image")
    assert set(image.learns_from(MODEL, LOSS)) == {"image"}
    masked = image.learns_from(MODEL, dataclasses.replace(LOSS, image_instance=0.1))
    assert set(masked) == {"image", "image_instance_mask"}
