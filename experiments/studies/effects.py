"""What a study says of the paper's claims: differences of pairs of runs under one seed, with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from experiments.studies import tables

CONFIRMED, CONTRADICTED, UNDECIDED = "confirmed", "contradicted", "undecided"
TOO_SHORT = "too short to tell"


def value(run: Mapping[str, Any] | None, split: str, metric: str) -> float:
    """A run's score; NaN where there is none."""
    found = ((run or {}).get("scores", {}).get(split, {}).get(metric) or {}).get("mean")
    return math.nan if found is None else float(found)


def mean_and_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean and Student's 95 % interval of values [N]; the interval is NaN for fewer than two."""
    if len(values) < 2:
        return (float(values.mean()) if len(values) else math.nan), math.nan, math.nan
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return float(values.mean()), float(values.mean() - half), float(values.mean() + half)


def verdict(low: float, high: float, says: str, margin: float) -> str:
    """What the interval [low, high] of an effect, positive where the claim's first arm is better, does to a claim.

    Args:
      says: see tables.Claim.
      margin: differences below it count as none.
    """
    if math.isnan(low):
        return UNDECIDED
    yes, no = {"better": (low > 0.0, high < 0.0), "par": (low > -margin, high < -margin),
               "same": (low > -margin and high < margin, low > margin or high < -margin)}[says]
    return CONFIRMED if yes else CONTRADICTED if no else UNDECIDED


def pairs_needed(differences: np.ndarray, says: str, margin: float) -> int | None:
    """Of how many pairs Student's interval would tell, if the effect and its scatter are as they seem; None where that
    cannot be said."""
    if len(differences) < 2 or not (scatter := differences.std(ddof=1)):
        return None
    mean = differences.mean()
    distance = {"better": abs(mean), "par": abs(mean + margin), "same": abs(margin - abs(mean))}[says]
    if not distance:
        return None
    count = max(2, math.ceil((stats.norm.ppf(0.975) * scatter / distance) ** 2))  # of many, where t is normal
    while stats.t.ppf(0.975, count - 1) * scatter / math.sqrt(count) > distance:
        count += 1
    return count


def lead(run: Mapping[str, Any], split: str, metric: str) -> float:
    """How far a run is ahead of the training mean beyond the margin; infinite where that has no such score."""
    metric = tables.OF_WHAT_IS_LEARNED[metric]
    baseline = value({"scores": run["baselines"].get("training_mean", {})}, split, metric)
    if math.isnan(baseline):
        return math.inf
    ahead = value(run, split, metric) - baseline
    if math.isnan(ahead):  # such as the distance of points where none is predicted
        return -math.inf
    return (-ahead if metric in tables.LOWER_IS_BETTER else ahead) - tables.MARGINS[metric]


def updates_needed(runs: Sequence[Mapping[str, Any]], split: str, metric: str) -> int | None:
    """At how many updates the mean of runs would lead by the margin, if each doubling brings what the last one did.

    None where their curves do not say.
    """
    metric = tables.OF_WHAT_IS_LEARNED[metric]
    sign, gains = (-1.0 if metric in tables.LOWER_IS_BETTER else 1.0), []
    for run in runs:
        curve = {step: at for step, at in run["curves"].get(split, {}).get(metric, []) if at is not None}
        last = max(curve, default=0)
        if last // 2 in curve:
            gains.append(sign * (curve[last] - curve[last // 2]))
    leads = [ahead for ahead in (lead(run, split, metric) for run in runs) if math.isfinite(ahead)]
    gain, missing = np.nanmean(gains or [0.0]), -np.mean(leads or [-math.inf])
    doublings = missing / gain if gain > 0.0 else math.inf
    return None if not doublings <= 10.0 else int(round(runs[0]["steps"] * 2.0**doublings, -2))


def differences(claim: tables.Claim, runs: Mapping[str, Mapping[str, Any]], split: str, metric: str,
                suffix: str = "") -> np.ndarray:
    """[N], of pairs of runs under one seed, positive where the claim's first arm is better.

    Where pairs share an arm, their mean is one difference for each seed: they scatter together, and an interval over
    all of them would be too narrow.
    """
    score = lambda label, seed: value(runs.get(label + suffix, {}).get(seed), split, metric)
    seeds = dict.fromkeys(seed for first, _ in claim.pairs for seed in runs.get(first + suffix, {}))
    found = np.array([[score(first, seed) - score(second, seed) for first, second in claim.pairs] for seed in seeds])
    arms = [label for pair in claim.pairs for label in pair]
    if len(set(arms)) < len(arms):
        found = found[np.isfinite(found).all(axis=-1)].mean(axis=-1) if len(found) else found
    signed = found[np.isfinite(found)]
    return -signed if metric in tables.LOWER_IS_BETTER else signed


def of_claims(study: tables.Study, runs: Mapping[str, Mapping[str, Any]], suffix: str = "") -> list[dict[str, Any]]:
    """A row for each claim, metric and split.

    Args:
      runs: label -> seed -> what queue.read returned; a missing run is left out of the pairs.
      suffix: of the labels, "+memory" for the runs with memory.

    Returns:
      rows {"claim", "metric", "split", "pairs", "effect", "interval", "verdict", "pairs_needed", "updates_needed"}; the
      effect is positive where the claim's first arm is better. Where no run without memory that is compared is ahead of
      the training mean by the margin, the verdict is TOO_SHORT, and updates_needed says how many might do.
    """
    rows = []
    for claim in study.claims:
        for metric in claim.metrics:
            for split in claim.splits:
                signed = differences(claim, runs, split, metric, suffix)
                mean, low, high = mean_and_interval(signed)
                margin, said, updates = tables.MARGINS[metric], UNDECIDED, None
                compared = [run for pair in claim.pairs for label in pair
                            for run in runs.get(label + suffix, {}).values()]
                if not suffix and compared and not any(lead(run, split, metric) > 0.0 for run in compared):
                    said, updates = TOO_SHORT, updates_needed(compared, split, metric)
                else:
                    said = verdict(low, high, claim.says, margin)
                rows.append({"claim": claim.text, "metric": metric, "split": split, "pairs": len(signed),
                             "effect": mean, "interval": [low, high], "verdict": said, "updates_needed": updates,
                             "pairs_needed": pairs_needed(signed, claim.says, margin)})
    return [row for row in rows if row["pairs"]] + (_order(study, runs, suffix) if study.order_kept else [])


def _order(study: tables.Study, runs: Mapping[str, Mapping[str, Any]], suffix: str) -> list[dict[str, Any]]:
    """Whether another domain costs image quality, and whether the arms keep their order there."""
    metric, (known, other) = tables.PSNR, tables.SPLITS
    both = {label: np.array([[value(run, split, metric) for split in (known, other)] for run in seeds.values()])
            for label, seeds in runs.items() if label.endswith(suffix) and ("+" in label) == bool(suffix)}
    means = np.array([np.nanmean(table, axis=0) for table in both.values() if np.isfinite(table).all(1).any()])
    if len(means) < 3:
        return []
    drop = np.concatenate([table[np.isfinite(table).all(1)] @ np.array([1.0, -1.0]) for table in both.values()])
    mean, low, high = mean_and_interval(drop)
    rank = stats.spearmanr(means[:, 0], means[:, 1])
    width = 1.96 / math.sqrt(max(len(means) - 3, 1))  # of Fisher's z
    limits = [float(np.tanh(np.arctanh(np.clip(rank.statistic, -0.999, 0.999)) + sign * width)) for sign in (-1, 1)]
    every = [run for label in both for run in runs[label].values()]
    told = bool(suffix) or any(lead(run, known, metric) > 0.0 for run in every)
    updates = None if told else updates_needed(every, known, metric)
    judged = lambda low, high: verdict(low, high, "better", 0.0) if told else TOO_SHORT
    rows = [("another domain lowers PSNR", len(drop), mean, [low, high], judged(low, high)),
            ("another domain keeps the order of the arms (Spearman correlation)", len(means), float(rank.statistic),
             limits, judged(*limits))]
    return [{"claim": claim, "metric": metric, "split": f"{known} to {other}", "pairs": count, "effect": effect,
             "interval": interval, "verdict": said, "pairs_needed": None, "updates_needed": updates}
            for claim, count, effect, interval, said in rows]


def best_and_worst(study: tables.Study, runs: Mapping[str, Mapping[str, Any]]) -> tuple[str, str] | None:
    """The arms without memory that the study's first metric ranks first and last on the first split.

    None where fewer than two arms are complete.
    """
    metric = study.metrics[0]
    means = {arm.name: np.mean([value(run, tables.SPLITS[0], metric) for run in runs.get(arm.name, {}).values()])
             for arm in study.arms if runs.get(arm.name)}
    ranked = sorted((name for name in means if math.isfinite(means[name])), key=lambda name: means[name],
                    reverse=metric not in tables.LOWER_IS_BETTER)
    return (ranked[0], ranked[-1]) if len(ranked) > 1 else None
