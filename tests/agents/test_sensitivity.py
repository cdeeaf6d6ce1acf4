"""Responses to actions: what is compared, and that a model is asked with the same noise under both plans."""

import dataclasses

import jax
import numpy as np
import pytest
import worlds
from test_closed_loop import road

from muvo_jax.agents import sensitivity
from muvo_jax.model import world_model


def test_the_response_of_each_head_by_hand():
    shown = [np.full((1, 2, 4, 4, 3), value, np.uint8) for value in (51, 102)]
    predicted = [np.full((1, 2, 4, 4, 3), value, np.float32) for value in (0.6, 0.7)]
    assert sensitivity.score("image", predicted, shown) == pytest.approx({"gain": 0.5, "correlation": 1.0}, rel=1e-4)

    ranges = np.array([[10.0, 20.0, -1.0], [12.0, 16.0, 8.0]])  # where one plan has no return, nothing is compared
    views = [np.stack([np.zeros(3)] * 3 + [row], axis=-1) for row in ranges]
    halved = [np.stack([np.zeros(3)] * 3 + [0.5 * row * [1, 1, 30]], axis=-1) for row in ranges]
    assert sensitivity.score("range_view", halved, views)["gain"] == pytest.approx(0.5)

    speeds = [np.array([[0.0, 0.0, 0.0, speed]]) for speed in (2.0, 6.0)]
    assert sensitivity.score("ego_motion", [speeds[0], 0.75 * speeds[1]], speeds)["gain"] == pytest.approx(0.625)

    voxels = [np.array([0, 1, 255], np.uint8), np.array([1, 1, 0], np.uint8)]
    sure = [np.array([[40.0, 0.0], [0.0, 40.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 40.0], [40.0, 0.0]])]
    assert sensitivity.score("occupancy", sure, voxels)["gain"] == pytest.approx(0.5)  # 0 -> 1/2, of 0 -> 1


def test_a_world_that_shows_its_speed_is_answered_for_every_contrast():
    """The road of the closed loop gets brighter with speed: steering changes nothing there, and so has no score."""
    model = world_model.WorldModel(dataclasses.replace(worlds.CONFIG, heads=("image",)))
    truth = lambda state: {"image": np.full((*worlds.CONFIG.image_size, 3), 10 * min(state[1], 20.0), np.uint8)}
    measure = lambda seeds: sensitivity.measure(road(), truth, model, worlds.variables(), jax.random.key(0), seeds,
                                                horizon=2, context=1)
    with pytest.raises(ValueError, match="got 0 seeds"):
        measure([])
    scores = measure([0, 1])
    assert scores.keys() == sensitivity.CONTRASTS.keys() and scores["left or right"].keys() == {"image"}
    assert np.isfinite(scores["brake or accelerate"]["image"]["gain"])
    assert np.isnan(scores["left or right"]["image"]["gain"])
