"""How far the sampled futures of a model can be trusted, measured on recorded windows: `evaluate --uncertainty`."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import uncertainty
from muvo_jax.metrics import occupancy
from muvo_jax.model import rollout, world_model
from muvo_jax.types import Array, Batch, Variables

BINS = 10  # of the reliability curve
# Each step's mean, what it is called, its unit, and the decimals that say something.
SCORES = {"trust": ("trust", "", 3), "brier": ("Brier score of voxels above the road", "", 4),
          "crps_m": ("CRPS of ranges", "m", 3), "range_error_m": ("mean error of one future's ranges", "m", 3),
          "best_psnr_db": ("PSNR of the best future", "dB", 2), "mean_psnr_db": ("PSNR of a future", "dB", 2)}


def measure(model: world_model.WorldModel, variables: Variables, key: Array, batches: Iterable[tuple[Batch, int]], *,
            context: int, horizon: int, branches: int) -> dict[str, Any]:
    """Scores of `branches` sampled futures of each window against what was recorded.

    Args:
      model, variables: what is judged.
      key: typed key; window number n of all draws from fold_in(key, n).
      batches: windows [B, context + horizon, ...], and how many of them are no filling.
      context, horizon: frames that are observed and imagined.
      branches: futures of each window, at least 2.

    Returns:
      {"branches", "windows", "per_step": {score of SCORES: [horizon] floats}, "trust_horizon": steps whose trust is at
      least a half, "reliability": {"confidence", "frequency", "count": [BINS], "calibration_error"}}. Scores of heads
      that the model lacks are missing; what is undefined is NaN, such as the trust of a single window.

    Raises:
      ValueError: for fewer than two branches, or no window.
    """
    if branches < 2:
        raise ValueError(f"forecasts: got {branches} branches, expected at least 2: one future cannot disagree.")
    sums: dict[str, np.ndarray] = {}
    features, done = [], 0
    for batch, count in batches:
        for row in range(count):  # one window at a time: its futures are decoded together
            seen, found = _of_window(model, variables, jax.random.fold_in(key, done), batch[row:row + 1], context,
                                     horizon, branches)
            features.append(np.asarray(seen))
            sums = {name: sums.get(name, 0.0) + np.asarray(value, np.float64) for name, value in found.items()}
            done += 1
    if not done:
        raise ValueError("forecasts: got no window.")
    trust = np.full(horizon, np.nan)
    if done > 1:
        trust = np.asarray(uncertainty.trust(jnp.asarray(np.concatenate(features)))).mean(axis=0)
    per_step = {"trust": trust}
    share = lambda name, count: sums[name] / np.where(sums[count] > 0, sums[count], np.nan)
    result: dict[str, Any] = {"branches": branches, "windows": done}
    if "known" in sums:
        per_step["brier"] = share("square", "known")
        curve = uncertainty.Reliability(jnp.asarray(share("confidence", "count")),
                                        jnp.asarray(share("frequency", "count")), jnp.asarray(sums["count"]))
        result["reliability"] = {"confidence": curve.confidence.tolist(), "frequency": curve.frequency.tolist(),
                                 "count": curve.count.tolist(), "calibration_error": float(curve.calibration_error)}
    if "returned" in sums:
        per_step |= {"crps_m": share("crps_m", "returned"), "range_error_m": share("range_error_m", "returned")}
    if "best_psnr_db" in sums:
        per_step |= {name: sums[name] / done for name in ("best_psnr_db", "mean_psnr_db")}
    return result | {"per_step": {name: value.tolist() for name, value in per_step.items()},
                     "trust_horizon": int(uncertainty.trust_horizon(jnp.asarray(trust)))
                     if np.isfinite(trust).all() else math.nan}


@functools.partial(jax.jit, static_argnames=("model", "context", "horizon", "branches"))
def _of_window(model, variables, key, batch, context, horizon, branches):
    """Features [1, N, H, F] of the futures, and sums over what was recorded: {name: [H] or [BINS]}."""
    observed = rollout.observe(model, variables, key, batch.time_slice(0, context), sampled=False)
    actions = jnp.asarray(batch.action)[:, context - 1:context + horizon - 1]
    dream = rollout.imagine(model, variables, key, observed.last, actions, branches=branches)
    heads = tuple(name for name in ("image", "range_view", "occupancy") if name in model.config.heads)
    shown = rollout.decode(model, variables, dream.states, heads, memory=observed.memory)
    truth = batch.time_slice(context, context + horizon)
    sums: dict[str, Array] = {}
    if "occupancy" in heads:
        above = occupancy.above_road(model.config.voxels)
        target = jnp.asarray(truth.occupancy)[0][..., above]
        probability = uncertainty.branch_probability(shown.occupancy[..., above, :])[0]
        known = (target != uncertainty.OCCUPANCY_UNKNOWN).sum(axis=(1, 2, 3))
        brier = jax.vmap(uncertainty.brier_score)(probability, target)
        curve = uncertainty.reliability(probability, target, BINS)
        total = lambda mean: jnp.where(curve.count > 0, mean * curve.count, 0.0)
        sums |= {"square": jnp.where(known > 0, brier * known, 0.0), "known": known, "count": curve.count,
                 "confidence": total(curve.confidence), "frequency": total(curve.frequency)}
    if "range_view" in heads:
        target_m, ranges_m = jnp.asarray(truth.range_view)[0, ..., 3], shown.range_view[0, ..., 3]
        returned = target_m > 0.0
        of_returns = lambda error: jnp.where(returned, error, 0.0).sum(axis=(1, 2))
        sums |= {"crps_m": of_returns(uncertainty.crps(ranges_m, target_m)), "returned": returned.sum(axis=(1, 2)),
                 "range_error_m": of_returns(jnp.abs(ranges_m[0] - target_m))}
    if "image" in heads:
        image = jnp.asarray(truth.image).astype(jnp.float32) / 255.0
        square = jnp.square(jnp.clip(shown.image, 0.0, 1.0) - image[:, None]).mean(axis=(-3, -2, -1))
        best, mean = uncertainty.best_of(10.0 * jnp.log10(jnp.maximum(square, 1e-10)))
        sums |= {"best_psnr_db": -best[0], "mean_psnr_db": -mean[0]}
    return model.policy_features(dream.features), sums
