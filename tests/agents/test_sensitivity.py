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
    score = lambda head, decoded, true: sensitivity.score(
        head, [sensitivity.values(head, value) for value in decoded], true)
    assert score("image", predicted, shown) == pytest.approx({"gain": 0.5, "correlation": 1.0}, rel=1e-4)

    ranges = np.array([[10.0, 20.0, -1.0], [12.0, 16.0, 8.0]])  # where one plan has no return, nothing is compared
    views = [np.stack([np.zeros(3)] * 3 + [row], axis=-1) for row in ranges]
    halved = [np.stack([np.zeros(3)] * 3 + [0.5 * row * [1, 1, 30]], axis=-1) for row in ranges]
    assert score("range_view", halved, views)["gain"] == pytest.approx(0.5)

    speeds = [np.array([[0.0, 0.0, 0.0, speed]]) for speed in (2.0, 6.0)]
    assert score("ego_motion", [speeds[0], 0.75 * speeds[1]], speeds)["gain"] == pytest.approx(0.625)

    voxels = [np.array([0, 1, 255], np.uint8), np.array([1, 1, 0], np.uint8)]
    sure = [np.array([[40.0, 0.0], [0.0, 40.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 40.0], [40.0, 0.0]])]
    assert score("occupancy", sure, voxels)["gain"] == pytest.approx(0.5)  # 0 -> 1/2, of 0 -> 1


def test_a_world_that_shows_its_speed_is_answered_for_every_contrast():
    """The road of the closed loop gets brighter with speed: steering changes nothing there, and so has no score."""
    model = world_model.WorldModel(dataclasses.replace(worlds.CONFIG, heads=("image",)))
    truth = lambda state: {"image": np.full((*worlds.CONFIG.image_size, 3), 10 * min(state[1], 20.0), np.uint8)}
    brighter = lambda states, action, steps: {"image": np.stack([np.full(
        (steps, *worlds.CONFIG.image_size, 3), min(10 * state[1], 200) / 255 + action[0]) for state in states])}
    measure = lambda seeds, horizons=(1, 2): sensitivity.measure(
        road(), truth, model, worlds.variables(), jax.random.key(0), seeds, horizons=horizons, context=1,
        moved=brighter)
    with pytest.raises(ValueError, match="got 0 seeds"):
        measure([])
    with pytest.raises(ValueError, match=r"horizons \[\]"):
        measure([0], ())
    scores = measure([0, 1])
    assert scores.keys() == {1, 2}
    assert scores[2].keys() == sensitivity.CONTRASTS.keys() and scores[2]["left or right"].keys() == {"image"}
    pedals = {horizon: answers["brake or accelerate"]["image"] for horizon, answers in scores.items()}
    assert np.isfinite(pedals[2]["model"]["gain"])
    assert np.isnan(scores[1]["left or right"]["image"]["model"]["gain"])
    # Half a pedal more or less is 0.5 m/s a step, 5 grey levels: after one step 10 / 255, where `brighter` says 1.
    assert pedals[1]["warp_last"]["gain"] == pytest.approx(25.5, rel=0.1)
    assert pedals[2]["warp_last"]["gain"] < pedals[1]["warp_last"]["gain"]
