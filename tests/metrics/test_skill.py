"""The score by which the best checkpoint is chosen."""

import math

import pytest

from muvo_jax.metrics import skill


def scores(psnr_db, chamfer_m, iou):
    return {"psnr_db": {"mean": psnr_db}, "chamfer_m": {"mean": chamfer_m}, "iou_occ_above_observed": {"mean": iou}}


def test_worked_arithmetic():
    # Half the squared error (3.01 dB), twice the distance, 1 - 0.7 instead of 1 - 0.4: 1/2, -1 and 1/2.
    model, moved = scores(20.0 + 10 * math.log10(2), 1.0, 0.7), scores(20.0, 0.5, 0.4)
    worst = scores(10.0, 5.0, 0.0)
    assert skill.skill({"model": model, "warp_last": moved, "copy_last": worst}) == pytest.approx(0.0)
    assert skill.skill({"model": moved, "warp_last": moved}) == 0.0
    assert skill.skill({"model": model, "copy_last": worst}) > 0.5


def test_what_is_not_predicted_does_not_count_and_what_predicts_nothing_counts_as_bad():
    model = {"psnr_db": {"mean": 20.0}}
    assert skill.skill({"model": model, "copy_last": scores(10.0, 1.0, 0.5)}) == pytest.approx(0.9)
    blind = model | {"chamfer_m": {"mean": math.nan}}  # not a single return
    assert skill.skill({"model": blind, "copy_last": scores(10.0, 1.0, 0.5)}) == pytest.approx((0.9 - 1.0) / 2)
    assert skill.skill({"model": blind, "copy_last": scores(10.0, math.nan, 0.5)}) == pytest.approx(0.9)
    assert math.isnan(skill.skill({"model": model}))
    assert math.isnan(skill.skill({"model": {}, "copy_last": scores(10.0, 1.0, 0.5)}))
