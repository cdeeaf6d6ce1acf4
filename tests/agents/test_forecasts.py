"""Scores of sampled futures: a world that is known exactly, and one that is guessed, stand in for the model's parts."""

import types as python_types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import evaluation_report, presets
from muvo_jax.agents import forecasts
from muvo_jax.metrics import occupancy
from muvo_jax.model import world_model
from muvo_jax.types import Batch

CONTEXT, HORIZON, BRANCHES, WINDOWS = 2, 3, 4, 3
MODEL = world_model.WorldModel(presets.tiny().model)


@pytest.fixture
def batch():
    config, random, lead = MODEL.config, np.random.default_rng(0), (WINDOWS, CONTEXT + HORIZON)
    view = np.full((*lead, config.range_view.rows, config.range_view.columns, 4), 5.0, np.float32)
    view[..., :4, :, 3] = -1.0  # nothing returned
    return Batch(action=np.zeros((*lead, 2), np.float32), is_first=np.zeros(lead, bool), range_view=view,
                 image=random.integers(0, 256, (*lead, *config.image_size, 3), np.uint8),
                 occupancy=random.choice(np.array([0, 1, 255], np.uint8), (*lead, *config.voxels.shape)))


def believing(monkeypatch, wrong):
    """The model's parts: futures of window w have the features (w, +-wrong / 5), and sees the truth, but for `wrong`
    metres of range and, where `wrong` is not 0, voxels that it gives even odds."""
    signs = jnp.where(jnp.arange(BRANCHES) % 2 == 0, 1.0, -1.0)

    def imagine(model, variables, key, batch, actions, branches):
        window = jnp.broadcast_to(batch.action[:, :1, None, :1] * 1e3, (1, branches, HORIZON, 1))
        spread = jnp.broadcast_to(0.2 * wrong * signs.reshape(1, -1, 1, 1), window.shape)
        return python_types.SimpleNamespace(states=batch, features=jnp.concatenate([window, spread], axis=-1))

    def decode(model, variables, batch, heads, memory):
        truth = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[:, None], BRANCHES, axis=1),
                             batch.time_slice(CONTEXT, CONTEXT + HORIZON))
        odds = jnp.where(wrong == 0.0, 1e3, 0.0) * jnp.where(truth.occupancy == 1, 1.0, -1.0)
        return python_types.SimpleNamespace(
            occupancy=jnp.stack([jnp.zeros_like(odds), odds], axis=-1), image=truth.image / 255.0,
            range_view=truth.range_view + wrong * signs.reshape(1, -1, 1, 1, 1, 1))

    observe = lambda model, variables, key, batch, sampled: python_types.SimpleNamespace(last=held[0], memory=None)
    held = [None]
    real = forecasts._of_window.__wrapped__

    def of_window(model, variables, key, batch, *numbers):
        held[0] = batch
        return real(model, variables, key, batch, *numbers)

    monkeypatch.setattr(forecasts, "_of_window", of_window)
    monkeypatch.setattr(world_model.WorldModel, "policy_features", lambda self, features: features)
    for name, part in (("observe", observe), ("imagine", imagine), ("decode", decode)):
        monkeypatch.setattr(forecasts.rollout, name, part)


def measured(batch):
    batch.action[:] = np.arange(WINDOWS, dtype=np.float32).reshape(-1, 1, 1) * 1e-3
    return forecasts.measure(MODEL, {}, jax.random.key(0), [(batch, WINDOWS)], context=CONTEXT, horizon=HORIZON,
                             branches=BRANCHES)


def test_a_known_future_is_trusted_and_has_no_error(batch, monkeypatch):
    believing(monkeypatch, wrong=0.0)
    found = measured(batch)
    scores = found["per_step"]
    assert scores["trust"] == [1.0] * HORIZON and found["trust_horizon"] == HORIZON
    for name in ("brier", "crps_m", "range_error_m"):
        np.testing.assert_allclose(scores[name], 0.0, atol=1e-6)
    np.testing.assert_allclose(scores["best_psnr_db"], 100.0, rtol=1e-4)  # no better than that is told
    curve = found["reliability"]
    known = np.asarray(batch.occupancy)[:, CONTEXT:][..., occupancy.above_road(MODEL.config.voxels)] != 255
    assert sum(curve["count"]) == known.sum() == curve["count"][0] + curve["count"][-1]
    assert curve["calibration_error"] == pytest.approx(0.0, abs=1e-6)


def test_futures_that_differ_are_trusted_by_so_much_less(batch, monkeypatch):
    """Two metres too far and too near: each future is 2 m off; of them together the mean is right."""
    believing(monkeypatch, wrong=2.0)
    found = measured(batch)
    scores = found["per_step"]
    among, total = np.var([0.4, -0.4, 0.4, -0.4], ddof=1), np.var([0.4, -0.4]) + np.var(np.arange(WINDOWS))
    np.testing.assert_allclose(scores["trust"], 1.0 - among / total, rtol=1e-5)
    np.testing.assert_allclose(scores["range_error_m"], 2.0, rtol=1e-5)
    np.testing.assert_allclose(scores["crps_m"], 2.0 - 4.0 * (4 / 6) / 2.0, rtol=1e-5)  # 4 of 6 pairs are 4 m apart
    np.testing.assert_allclose(scores["brier"], 0.25, rtol=1e-5)
    page = "\n".join(evaluation_report.uncertainty_table(found))
    assert "4 futures of each of 3 windows" in page and "| CRPS of ranges (m) | 0.667 | 0.667 | 0.667 |" in page


def test_one_future_and_no_window_are_refused(batch):
    with pytest.raises(ValueError, match="got 1 branches, expected at least 2"):
        forecasts.measure(MODEL, {}, jax.random.key(0), [(batch, 1)], context=2, horizon=3, branches=1)
    with pytest.raises(ValueError, match="got no window"):
        forecasts.measure(MODEL, {}, jax.random.key(0), [], context=2, horizon=3, branches=2)
